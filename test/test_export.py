"""`diagnose --export`: effects in other tools' files do there what they do here."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from monoforce_ros.discrepancy import EffectEstimate, ExportKind, ParameterEstimate, cli, export_effects
from monoforce_ros.discrepancy.export import effects_to_export, export_target
from monoforce_ros.discrepancy.turning_ratio import turning_ratio
from monoforce_ros.discrepancy.wheel_motion import half_track
from monoforce_ros.effects import CATALOGUE, applied_setup, drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

# With the graphics library that tests of images in the same process need.
mujoco = pytest.importorskip("monoforce_ros.synthetic.graphics").mujoco
STEP = 0.002
MODEL = """<mujoco>
  <option integrator="implicitfast"/>
  {include}
  <worldbody>
    <geom name="ground" type="plane" size="50 50 1" friction="1"/>
    <body name="base" pos="0 0 0.1651">
      {include_base}
      <freejoint/>
      <inertial pos="0 0 0" mass="50" diaginertia="2 3 4"/>
      {wheels}
    </body>
  </worldbody>
  <actuator>{servos}</actuator>
</mujoco>"""
WHEELS = (("front_left", 0.256, 0.2854), ("rear_left", -0.256, 0.2854), ("front_right", 0.256, -0.2854),
          ("rear_right", -0.256, -0.2854))  # fmt: skip


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def estimate(name, spread=0.1, **values):
    units = {parameter.name: parameter.unit for parameter in CATALOGUE[name].parameters}
    return EffectEstimate(
        name, {k: ParameterEstimate(v, v - spread * abs(v), v + spread * abs(v), units[k]) for k, v in values.items()}
    )


def model_with(tmp_path, husky, *effects):
    """A Husky on level ground in MuJoCo that includes the exported fragments, and the exports."""
    (exported,) = export_effects([str(tmp_path / "effects.xml")], husky, effects)
    names = {file.name: file for file in exported.files}
    text = names["effects.xml"].read_text()
    tyre = 'class="monoforce_tyre"' if "monoforce_tyre" in text else 'friction="0.8" priority="1"'
    plain = 'gainprm="100" biastype="affine" biasprm="0 0 -100"'
    wheels = "".join(
        f'<body name="{name}" pos="{x} {y} 0"><joint name="{name}" axis="0 1 0"/>'
        f'<geom {tyre} type="cylinder" size="0.1651 0.05" euler="90 0 0" mass="1"/></body>'
        for name, x, y in WHEELS
    )
    servos = "".join(
        f'<general name="{name}" joint="{name}" '
        + (f'class="monoforce_drive_{"left" if y > 0 else "right"}"/>' if "monoforce_drive" in text else f"{plain}/>")
        for name, _, y in WHEELS
    )
    model = MODEL.format(
        include='<include file="effects.xml"/>',
        include_base='<include file="effects_base.xml"/>' if "effects_base.xml" in names else "",
        wheels=wheels,
        servos=servos,
    )
    (tmp_path / "model.xml").write_text(model)
    return mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")), exported


def driven(model, seconds, left, right, speed=0.0):
    """Forward speed and yaw rate of the base over time, with wheels commanded in m/s; ``speed`` at the start."""
    data = mujoco.MjData(model)
    data.qvel[0] = speed
    for name, _, y in WHEELS:
        if speed:
            data.qvel[model.joint(name).dofadr[0]] = speed / 0.1651
        data.ctrl[model.actuator(name).id] = (left if y > 0 else right) / 0.1651
    found = []
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
        found.append((data.qvel[0], data.qvel[5]))
    return np.array(found)


def predicted(husky, effects, seconds, left, right, speed=0.0):
    """The same by the rollout with the same effects."""
    values = tuple((e.name, {k: p.value for k, p in e.parameters.items()}) for e in effects)
    robot = replace(husky, effects=values)
    half = 0.2854
    twist = torch.tensor([[(left + right) / 2, (right - left) / (2 * half)]]).expand(round(seconds / 0.01), 2)[None]
    # The commands begin with the window, as they do in MuJoCo.
    commands = torch.cat([torch.zeros(1, 200, 2), twist], dim=1)
    speeds = drive_speeds(robot, commands, 0.01, history=200)
    state = replace(State.at_rest(0.13), velocity=torch.tensor([[speed, 0.0, 0.0]]))
    result = rollout(TerrainMap.flat(Grid.square(20.0, 1.0)), robot, speeds, state, with_forces=False)
    return np.stack([result.velocity[0, :, 0].numpy(), result.angular_velocity[0, :, 2].numpy()], axis=1)


def test_a_speed_limit_does_the_same_in_mujoco(husky, tmp_path):
    limit = estimate("actuator_saturation", limit=0.4)
    model, _ = model_with(tmp_path, husky, limit)
    there, here = driven(model, 2.0, 0.9, 0.9)[-1, 0], predicted(husky, (limit,), 2.0, 0.9, 0.9)[-1, 0]
    assert there == pytest.approx(0.4, rel=0.03) and here == pytest.approx(0.4, rel=0.03)
    # The file says how to use it.
    assert '<general class="monoforce_drive_left or monoforce_drive_right"' in (tmp_path / "effects.xml").read_text()


def test_unequal_sides_and_a_gain_do_the_same_in_mujoco(husky, tmp_path):
    effects = (estimate("drive_asymmetry", difference=0.2), estimate("drive_gain", gain=0.8))
    model, _ = model_with(tmp_path, husky, *effects)
    # Wheels off the ground: the speeds that the servos reach are those of the drives here.
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5 / 0.1651
    for _ in range(1000):
        mujoco.mj_step(model, data)
    there = {name: 0.1651 * data.qvel[model.joint(name).dofadr[0]] for name, _, _ in WHEELS}
    robot = replace(husky, effects=(("drive_asymmetry", {"difference": 0.2}), ("drive_gain", {"gain": 0.8})))
    here = drive_speeds(robot, torch.tensor([[[0.5, 0.0]] * 10]), 0.01)[0, -1]
    for name, _, _ in WHEELS:
        assert there[name] == pytest.approx(float(here[0 if "left" in name else 1]), rel=0.02)


@pytest.mark.parametrize("lags", [{"time_constant": 0.25}, {"time_constant": 0.08, "second_time_constant": 0.3}])
def test_delay_and_lag_do_the_same_in_mujoco(lags, husky, tmp_path):
    effects = (estimate("command_delay", delay=0.3), estimate("actuator_lag", **lags))
    model, _ = model_with(tmp_path, husky, *effects)
    # Wheels off the ground, as the drives of the rollout know no inertia.
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5 / 0.1651
    there = []
    for _ in range(750):
        mujoco.mj_step(model, data)
        there.append(0.1651 * data.qvel[model.joint("front_left").dofadr[0]])
    robot = replace(husky, effects=tuple((e.name, {k: p.value for k, p in e.parameters.items()}) for e in effects))
    commands = torch.zeros(1, 350, 2)
    commands[0, 200:, 0] = 0.5
    here = drive_speeds(robot, commands, 0.01, history=200)[0, :, 0].numpy()
    np.testing.assert_allclose(np.array(there)[4::5], here[:150], atol=0.02)
    assert np.abs(here).max() > 0.45


def test_friction_does_the_same_in_mujoco(husky, tmp_path):
    ice = estimate("friction_scale", factor=0.25)
    model, exported = model_with(tmp_path, husky, ice)
    # Locked wheels at 1 m/s: the robot slides with the deceleration of its friction.
    there = driven(model, 0.3, 0.0, 0.0, speed=1.0)[:, 0]
    here = predicted(husky, (ice,), 0.3, 0.0, 0.0, speed=1.0)[:, 0]
    braked = [(values[0] - values[-1]) / 0.3 for values in (there, here)]
    assert braked[0] == pytest.approx(0.25 * 0.8 * 9.81, rel=0.1)
    assert braked[0] == pytest.approx(braked[1], rel=0.15)
    assert "friction_scale factor: 0.25, 0.225 to 0.275" in exported.files[0].read_text()


def test_a_payload_does_the_same_in_mujoco(husky, tmp_path):
    load = estimate("payload", mass=20.0, x=-0.3, y=0.1)
    model, _ = model_with(tmp_path, husky, load)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bare = (50.0 + 4.0, np.zeros(2))
    base = model.body("base").id
    assert model.body_subtreemass[base] == pytest.approx(bare[0] + 20.0)
    terrain = TerrainMap.flat(Grid.square(2.0, 1.0))
    loaded = replace(husky, effects=(("payload", {"mass": 20.0, "x": -0.3, "y": 0.1}),))
    setup = applied_setup(terrain, loaded)
    assert float(setup.robot.mass) - float(husky.mass) == pytest.approx(20.0)
    # The moment that the load adds about the base frame's origin, in both.
    there = model.body_subtreemass[base] * data.subtree_com[base][:2]
    here = float(setup.robot.mass) * setup.robot.centre_of_mass[:2].numpy()
    here = here - float(husky.mass) * husky.centre_of_mass[:2].numpy()
    np.testing.assert_allclose(there, here, atol=1e-3)


def test_forces_drag_and_tilt_do_the_same_in_mujoco(husky, tmp_path):
    effects = (
        estimate("constant_force", x=30.0, y=-60.0),
        estimate("viscous_drag", coefficient=150.0),
        estimate("gravity_tilt", about_x=0.05, about_y=-0.1),
    )
    model, _ = model_with(tmp_path, husky, *effects)
    mass = float(model.body_subtreemass[model.body("base").id])
    # In the air, so that nothing else acts.
    model.geom_contype[:] = 0
    data = mujoco.MjData(model)
    data.qvel[:2] = [0.8, 0.3]
    mujoco.mj_forward(model, data)
    tilt = np.array([0.05, -0.1])
    gravity = 9.81 * np.array([-np.sin(tilt[1]), np.sin(tilt[0]) * np.cos(tilt[1])])
    expected = (np.array([30.0, -60.0]) - 150.0 * np.array([0.8, 0.3])) / mass + gravity
    np.testing.assert_allclose(data.qacc[:2], expected, atol=0.02)
    # Nothing turns the base: the drag is one on its translation.
    assert abs(data.qacc[5]) < 1e-6


def test_drives_give_way_as_soft_servos_do_in_mujoco(husky, tmp_path):
    """The gain that the export names: N r² / c for wheels of load N and radius r."""
    loss, mass = 0.15, 54.0
    gain = mass / 4 * 9.81 * 0.1651**2 / loss
    robot = replace(husky, mass=torch.tensor(mass), centre_of_mass=torch.zeros(3))
    compliance = estimate("drive_compliance", speed_loss=loss)
    for force in (-160.0, 100.0):
        pull = estimate("constant_force", x=force, y=0.0)
        there, here = [], []
        for servo_gain, effects in ((50 * gain, (pull,)), (gain, (pull, compliance))):
            model, _ = model_with(tmp_path, husky, pull)
            servos = [model.actuator(name).id for name, _, _ in WHEELS]
            model.actuator_gainprm[servos, 0], model.actuator_biasprm[servos, 2] = servo_gain, -servo_gain
            there.append(driven(model, 4.0, 0.8, 0.8)[-500:, 0].mean())
            here.append(predicted(robot, effects, 4.0, 0.8, 0.8)[-100:, 0].mean())
        assert here[1] - here[0] == pytest.approx(there[1] - there[0], rel=0.05)
        assert abs(there[1] - there[0]) > 0.02


def test_what_mujoco_cannot_express_is_said(husky, tmp_path):
    effects = (
        estimate("actuator_deadband", width=0.1),
        estimate("pose_clock_offset", offset=0.4),
        estimate("sensor_lever_arm", x=0.3, y=0.1),
        estimate("turning_scrub", track_width_factor=1.5),
    )
    model, exported = model_with(tmp_path, husky, *effects)
    assert [text.split(":")[0] for text in exported.not_exported] == [
        "actuator_deadband", "pose_clock_offset", "turning_scrub",
    ]  # fmt: skip
    text = exported.files[0].read_text()
    assert all(said in text for said in exported.not_exported)
    np.testing.assert_allclose(model.site("monoforce_localisation").pos, [0.3, 0.1, 0.0])


def test_parameters_of_ros2_control_cancel_the_effects(husky, tmp_path):
    effects = (estimate("drive_gain", gain=0.9), estimate("drive_asymmetry", difference=0.1),
               estimate("command_delay", delay=0.3))  # fmt: skip
    target = tmp_path / "husky.diff_drive.yaml"
    (exported,) = export_effects([str(target)], husky, effects)
    parameters = yaml.safe_load(target.read_text())["diff_drive_controller"]["ros__parameters"]
    # The controller as documented: wheel speeds from a twist with both multipliers.
    speed, yaw_rate = 0.5, 0.6
    separation = 0.5708
    left = (speed - yaw_rate * separation / 2) / parameters["left_wheel_radius_multiplier"]
    right = (speed + yaw_rate * separation / 2) / parameters["right_wheel_radius_multiplier"]
    # The effects, applied to these wheel speeds, give the twist that was asked for.
    robot = replace(husky, effects=tuple((e.name, {k: p.value for k, p in e.parameters.items()}) for e in effects[:2]))
    half = 0.5 * 0.5708
    twist = torch.tensor([[[(left + right) / 2, (right - left) / (2 * half)]] * 10])
    done = drive_speeds(robot, twist, 0.01)[0, -1]
    assert float(done.mean()) == pytest.approx(speed, rel=1e-3)
    assert float(done[1] - done[0]) / (2 * half) == pytest.approx(yaw_rate, rel=0.01)
    assert exported.not_exported[0].startswith("command_delay")
    assert "0.9, 0.81 to 0.99" in target.read_text() and "Not exported: command_delay" in target.read_text()


@pytest.mark.parametrize("factor", [0.78, 1.2, 1.6])
def test_the_exported_separation_makes_a_skid_steered_robot_turn_as_commanded(husky, tmp_path, factor):
    target = tmp_path / "husky.diff_drive.yaml"
    export_effects([str(target)], husky, (estimate("turning_scrub", track_width_factor=factor),))
    exported = yaml.safe_load(target.read_text())["diff_drive_controller"]["ros__parameters"]
    multiplier = exported["wheel_separation_multiplier"]
    robot = replace(husky, effects=(("turning_scrub", {"track_width_factor": factor}),))
    # A healthy one turns by 0.55 of the command; what turns less needs more.
    before = turning_ratio(robot)
    assert before < 0.75 and multiplier > 1.3
    assert turning_ratio(robot, multiplier) == pytest.approx(1.0, abs=0.02)


def test_parameters_of_nav2_respect_the_effects(husky, tmp_path):
    effects = (estimate("actuator_saturation", limit=0.4), estimate("actuator_deadband", width=0.1),
               estimate("command_delay", delay=0.3), estimate("friction_scale", factor=0.25),
               estimate("payload", mass=20.0))  # fmt: skip
    target = tmp_path / "parameters.yaml"
    (exported,) = export_effects([f"nav2:{target}"], husky, effects)
    content = yaml.safe_load(target.read_text())
    smoother = content["velocity_smoother"]["ros__parameters"]
    assert smoother["max_velocity"] == [0.4, 0.0, pytest.approx(0.4 / 0.2854, abs=1e-3)]
    assert smoother["min_velocity"][0] == -0.4
    assert smoother["deadband_velocity"] == [0.1, 0.0, pytest.approx(0.1 / 0.2854, abs=1e-3)]
    mppi = content["controller_server"]["ros__parameters"]["FollowPath"]
    assert mppi["vx_max"] == 0.4 and mppi["model_delay_vx"] == 0.3 and mppi["model_delay_wz"] == 0.3
    assert mppi["ax_max"] == pytest.approx(0.25 * 0.8 * 9.81, abs=1e-2)
    assert [text.split(":")[0] for text in exported.not_exported] == ["payload"]


def controller_of(tmp_path, robot, *effects, name="diff_drive_controller"):
    target = tmp_path / "robot.diff_drive.yaml"
    (exported,) = export_effects([str(target)], robot, effects)
    content = yaml.safe_load(target.read_text())
    return (content or {}).get(name, {}).get("ros__parameters", {}), exported, target.read_text()


def test_exported_limits_are_those_of_the_base_that_the_multipliers_correct(husky, tmp_path):
    effects = (
        estimate("drive_gain", gain=0.8),
        estimate("drive_asymmetry", difference=0.1),
        estimate("actuator_saturation", limit=0.5),
        estimate("turning_scrub", track_width_factor=1.2),
    )
    parameters, _, _ = controller_of(tmp_path, husky, *effects)
    # A twist at each limit, through the controller: no drive is commanded more than it follows, and one is nearly.
    half, separation = 0.2854, parameters["wheel_separation_multiplier"]
    for speed, yaw_rate in ((parameters["linear.x.max_velocity"], 0.0), (0.0, parameters["angular.z.max_velocity"])):
        left = (speed - yaw_rate * separation * half) / parameters["left_wheel_radius_multiplier"]
        right = (speed + yaw_rate * separation * half) / parameters["right_wheel_radius_multiplier"]
        assert max(abs(left), abs(right)) == pytest.approx(0.5, rel=1e-3)
    target = tmp_path / "x.nav2.yaml"
    export_effects([str(target)], husky, effects)
    smoother = yaml.safe_load(target.read_text())["velocity_smoother"]["ros__parameters"]
    assert smoother["max_velocity"][0] == pytest.approx(parameters["linear.x.max_velocity"])
    assert smoother["max_velocity"][2] == pytest.approx(parameters["angular.z.max_velocity"])
    assert "For a base whose controller has the parameters" in target.read_text()


def test_limits_of_the_twist_have_parameters(husky, tmp_path):
    effects = (estimate("yaw_rate_limit", limit=0.7), estimate("acceleration_limit", limit=0.9),
               estimate("yaw_acceleration_limit", limit=1.4))  # fmt: skip
    parameters, exported, _ = controller_of(tmp_path, husky, *effects)
    assert not exported.not_exported
    assert parameters["angular.z.max_velocity"] == 0.7 and "linear.x.max_velocity" not in parameters
    assert parameters["linear.x.max_acceleration"] == 0.9 and parameters["linear.x.max_deceleration"] == -0.9
    assert parameters["angular.z.max_acceleration_reverse"] == -1.4
    target = tmp_path / "x.nav2.yaml"
    (exported,) = export_effects([str(target)], husky, (*effects, estimate("friction_scale", factor=0.5)))
    assert not exported.not_exported
    content = yaml.safe_load(target.read_text())
    smoother = content["velocity_smoother"]["ros__parameters"]
    # Of the speed nothing was found: it stays Nav2's.
    assert "vx_max" not in content["controller_server"]["ros__parameters"]["FollowPath"]
    assert smoother["max_velocity"] == [0.5, 0.0, 0.7] and smoother["max_accel"] == [0.9, 0.0, 1.4]
    assert smoother["max_decel"] == [-0.9, 0.0, -1.4]
    mppi = content["controller_server"]["ros__parameters"]["FollowPath"]
    # The smaller of grip and ramp.
    assert mppi["ax_max"] == 0.9 and mppi["az_max"] == 1.4 and mppi["wz_max"] == 0.7


def test_motors_of_a_largest_torque_limit_accelerations_and_those_of_turns_by_what_the_scrub_leaves(husky, tmp_path):
    effects = (estimate("drive_torque_limit", acceleration=1.6, scrub=0.4), estimate("yaw_acceleration_limit", limit=9))
    turning = 0.6 * 1.6 / half_track(husky)
    parameters, exported, text = controller_of(tmp_path, husky, *effects)
    assert not exported.not_exported and "acceleration_limit 9" not in text.split("linear.x")[0]
    assert parameters["linear.x.max_acceleration"] == 1.6
    assert parameters["angular.z.max_acceleration"] == pytest.approx(turning, abs=1e-4)
    target = tmp_path / "x.nav2.yaml"
    (exported,) = export_effects([str(target)], husky, effects)
    content = yaml.safe_load(target.read_text())
    assert not exported.not_exported
    smoother = content["velocity_smoother"]["ros__parameters"]
    assert smoother["max_accel"] == [1.6, 0.0, pytest.approx(turning, abs=1e-4)]
    mppi = content["controller_server"]["ros__parameters"]["FollowPath"]
    assert mppi["ax_max"] == 1.6 and mppi["az_max"] == pytest.approx(turning, abs=1e-3)


@pytest.mark.parametrize("kind", ["diff_drive", "nav2"])
@pytest.mark.parametrize("central", [False, True])
def test_a_robot_without_top_speed_or_with_one_drive_is_exported(husky, tmp_path, kind, central):
    robot = replace(husky, maximum_speed=float("inf"), maximum_yaw_rate=float("inf"))
    if central:
        one = replace(robot, drive_names=("middle",), drive_offsets=torch.zeros(1))
        robot = replace(one, point_drives=one.point_drives.clamp(max=0))
    for effects in (
        (estimate("turning_scrub", track_width_factor=1.3),),
        (estimate("acceleration_limit", limit=1.0), estimate("actuator_deadband", width=0.1)),
        (estimate("actuator_saturation", limit=0.4), estimate("drive_gain", gain=0.9)),
        (estimate("yaw_rate_limit", limit=0.4),),
        (estimate("drive_torque_limit", acceleration=1.6, scrub=0.4),),
    ):
        target = tmp_path / f"{effects[0].name}.out"
        export_effects([f"{kind}:{target}"], robot, effects)
        text = target.read_text()
        yaml.safe_load(text)
        assert " inf" not in text.lower() and " nan" not in text.lower() and "[inf" not in text


def test_a_car_gets_the_parameters_of_a_steering_controller(tmp_path):
    car = load_robot("rally_car")
    effects = (estimate("drive_gain", gain=0.9), estimate("actuator_saturation", limit=5.0),
               estimate("steering_offset", offset=0.05))  # fmt: skip
    parameters, exported, text = controller_of(tmp_path, car, *effects, name="ackermann_steering_controller")
    assert parameters == {"traction_wheels_radius": pytest.approx(0.9 * 0.095, abs=1e-4)}
    assert [said.split(":")[0] for said in exported.not_exported] == ["actuator_saturation", "steering_offset"]
    assert "diff_drive_controller" not in text and "wheel_separation" not in text
    target = tmp_path / "x.nav2.yaml"
    export_effects([str(target)], car, effects)
    mppi = yaml.safe_load(target.read_text())["controller_server"]["ros__parameters"]["FollowPath"]
    # The fastest turn of a car is the sharpest one at its largest speed.
    assert mppi["vx_max"] == pytest.approx(4.5) and mppi["wz_max"] == pytest.approx(4.5 * 0.597, rel=1e-3)


def test_values_of_the_robot_file_have_its_interval_or_none(husky, tmp_path):
    known = replace(husky, effects=(("drive_gain", {"gain": 0.9}), ("actuator_saturation", {"limit": 0.6})),
                    effect_intervals=(("drive_gain", {"gain": (0.85, 0.95)}),))  # fmt: skip
    _, _, text = controller_of(tmp_path, known)
    assert "drive_gain 0.9, 0.85 to 0.95" in text
    assert "0.6 m/s, from the robot's file, which has no interval" in text and "0.6 to 0.6" not in text


@pytest.mark.parametrize("kind", ["mujoco", "diff_drive", "nav2"])
def test_every_effect_is_exported_or_said(husky, tmp_path, kind):
    for name, effect in CATALOGUE.items():
        values = (effect.first_values(husky) if effect.identified else None) or [
            {p.name: p.neutral + p.scale for p in effect.parameters[:2]}
        ]
        # Estimates at a bound of their parameter are no result, and are not exported.
        bounds = {p.name: (p.low, p.high) for p in effect.parameters}
        values = [
            {key: 0.9 * value if value in bounds[key] else value for key, value in entry.items()} for entry in values
        ]
        (exported,) = export_effects([f"{kind}:{tmp_path / name}.out"], husky, (estimate(name, **values[-1]),))
        said = any(text.startswith(f"{name}: ") for text in exported.not_exported)
        text = "".join(file.read_text() for file in exported.files)
        first = next(iter(values[-1].values()))
        assert said or f"{first:.4g}" in text, name


def test_the_corrected_robot_is_exported(husky):
    known = replace(husky, effects=(("turning_scrub", {"track_width_factor": 1.4}), ("drive_gain", {"gain": 0.9})))
    bound = estimate("friction_scale", factor=0.02)
    chosen = {e.name: e for e in effects_to_export(known, (estimate("drive_gain", gain=0.8), bound))}
    assert list(chosen) == ["turning_scrub", "drive_gain"]
    assert chosen["drive_gain"].parameters["gain"].value == 0.8


def test_targets_say_their_kind(capsys, tmp_path):
    assert export_target("a/husky.xml")[0] is ExportKind.MUJOCO
    assert export_target("husky.nav2.yaml")[0] is ExportKind.NAV2
    assert export_target("diff_drive:x.yaml")[1].name == "x.yaml"
    for wrong in ("husky.yaml", "urdf:husky.urdf", ".xml", "mujoco:"):
        with pytest.raises(ValueError, match=r"--export: got .*, expected mujoco:FILE"):
            export_target(wrong)
    with pytest.raises(SystemExit) as ended:
        cli.main([str(tmp_path), "--out", str(tmp_path / "o"), "--export", "husky.yaml"])
    assert ended.value.code == 2 and "expected mujoco:FILE" in capsys.readouterr().err
