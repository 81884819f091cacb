"""Values of effects that were injected into a drive of our own physics are recovered from its motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy import commissioning
from monoforce_ros.discrepancy.areas import shows_vegetation
from monoforce_ros.discrepancy.commissioning import commission
from monoforce_ros.discrepancy.cycle_start import explain_aligned
from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows, window_starts
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Windows
from monoforce_ros.discrepancy.fit import first_values, fit_effects, robust
from monoforce_ros.discrepancy.gap import residual_scale
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.trial import Trial
from monoforce_ros.discrepancy.wheels import WheelFinding
from monoforce_ros.effects import CATALOGUE, drive_speeds, identifiable_effects
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")
SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
GRID = Grid.square(40.0, 0.2)
SCALE = np.tile([0.01, 0.01, 0.005], (4, 1))


_LOADS = {
    "constant_force": {"x": 0.0, "y": 120.0},
    "payload": {"mass": 25.0, "x": 0.2, "y": 0.0},
    "viscous_drag": {"coefficient": 300.0},
}
"""Of a robot of 50 kg."""


@pytest.mark.parametrize(
    ("name", "size"),
    # Of a light robot on firm ground a load shows as a shifted centre alone.
    [
        ("constant_force", 0.2),
        ("viscous_drag", 0.2),
        ("constant_force", 10.0),
        ("viscous_drag", 10.0),
        ("payload", 10.0),
    ],
)
def test_forces_and_loads_are_found_on_robots_of_any_mass(name, size):
    """As shares of the mass: 1200 N move a robot of 500 kg as 120 N do one of 50 kg, and 250 kg of load as 25 kg."""
    husky = load_robot("husky")
    robot = replace(husky, mass=size * husky.mass, inertia=size * husky.inertia)
    hidden = {key: value if key == "x" and name == "payload" else size * value for key, value in _LOADS[name].items()}
    data = driven(replace(robot, effects=((name, hidden),)))
    names = [effect.name for effect in identifiable_effects(husky)]
    healthy = NominalModel(SCALE, dict.fromkeys(names, 0.1), segments=5, loss=0.4, loss_spread=0.2)
    found = Search(robot, data, SCALE, nominal=healthy).run(1, exchange=False).best
    assert found.names == (name,)
    estimated = dict(found.effects)[name]
    if name == "payload":
        estimated, hidden = ({"moment": v["mass"] * v["x"]} for v in (estimated, hidden))
    for key, value in hidden.items():
        assert estimated[key] == pytest.approx(value, rel=0.15, abs=0.02 * size * 50.0)


def rough_and_grassy():
    """Bumps of 4 cm, and vegetation up to 0.4 m high on one half."""
    x, y = (torch.from_numpy(values).float() for values in np.meshgrid(GRID.x, GRID.y))
    ground = 0.04 * torch.sin(2.1 * x) * torch.cos(1.7 * y)
    return TerrainMap.from_height(ground, GRID, geometric_height=ground + 0.4 * torch.sigmoid(2.0 * x))


def driven(robot, terrain=None, factor=1.0):
    """Windows of a drive at random commands by a robot with the effects of its file.

    Drives follow ``factor`` times the commands, a scalar or one for each of 2700 steps of 10 ms.
    """
    random = np.random.default_rng(4)
    commanded = np.repeat(random.uniform([-0.3, -1.2], [1.0, 1.2], (18, 2)), 150, axis=0)
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    speeds = speeds * torch.as_tensor(np.broadcast_to(factor, len(commanded)).copy(), dtype=torch.float32)[:, None]
    ground = TerrainMap.flat(Grid.square(2.0, 1.0)) if terrain is None else terrain
    result = rollout(ground, robot, speeds, State.at_rest(0.14), with_forces=False)
    motion = recorded(result, 10**9)
    commands = CommandTrack(10**9 + np.arange(len(commanded)) * 10_000_000, commanded)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    return EvidenceWindows(motion, commands, starts, 2.0, SAMPLES, terrain, None if terrain is None else np.eye(4))


@pytest.mark.parametrize(
    ("name", "parameters", "tolerance"),
    [
        ("yaw_rate_limit", {"limit": 0.5}, 0.03),
        ("acceleration_limit", {"limit": 0.7}, 0.05),
        ("yaw_acceleration_limit", {"limit": 0.9}, 0.05),
        ("drive_torque_limit", {"acceleration": 0.9, "scrub": 0.4}, 0.05),
        ("drive_loss", {"loss": -0.25}, 0.05),
        ("drive_droop", {"loss": 0.15, "recovery": 2.0}, 0.12),
        ("supply_sag", {"sag": 0.3}, 0.08),
        ("rotation_centre", {"x": 0.06}, 0.1),
        ("drive_compliance", {"speed_loss": 0.15}, 0.1),
        ("tyre_slip", {"ratio": 0.3}, 0.1),
        ("friction_anisotropy", {"factor": 0.6}, 0.1),
        ("terrain_softness", {"factor": 6.0}, 0.25),
        ("vegetation_drag", {"coefficient": 2.5e4}, 0.25),
    ],
)
def test_injected_values_are_recovered_from_motion(name, parameters, tolerance):
    husky, terrain = load_robot("husky"), None
    injected = dict(parameters)
    if CATALOGUE[name].stage == "contact" and name not in ("friction_anisotropy", "drive_compliance", "tyre_slip"):
        terrain = rough_and_grassy()
    if name == "vegetation_drag":
        injected["yield_speed"] = 0.5
    data = driven(replace(husky, effects=((name, injected),)), terrain)
    predictions = Predictions(husky, data)
    before, floor = (np.abs(predictions.residuals([effects])[0]).mean() for effects in ((), ((name, injected),)))
    fit = fit_effects(predictions, first_values(CATALOGUE[name], husky), SCALE)
    found = dict(fit.effects)[name]
    for key, value in parameters.items():
        assert found[key] == pytest.approx(value, rel=tolerance), key
    # As good as the injected values, which leave what the restarts of the windows cost.
    after = np.abs(predictions.residuals([fit.effects])[0]).mean()
    assert after < max(0.25 * before, 1.1 * floor)
    assert after < 0.9 * before


def commissioned(robot, terrains):
    """What commissioning finds on a drive of the robot over each terrain."""
    recordings = []
    for terrain in terrains:
        data = driven(robot, terrain)
        smoothed = SmoothedMotion(data.motion, 0.002, 0.001, (slice(0, len(data.motion)),))
        recordings.append(Evidence(smoothed, data.commands, terrain, data.odometry_from_terrain))
    effects, _ = commission(recordings, load_robot("husky"))
    return {effect.name: {key: entry.value for key, entry in effect.parameters.items()} for effect in effects}


def test_commissioning_knows_the_ramps_of_a_base_and_takes_them_for_no_dead_time():
    """Without wheel speeds, too. Begun without ramps, the fit ends at a delay of 0.3 s that nothing improves."""
    ramps = (("acceleration_limit", {"limit": 1.5}), ("yaw_acceleration_limit", {"limit": 2.0}))
    found = commissioned(replace(load_robot("husky"), effects=(*ramps, ("command_delay", {"delay": 0.08}))), [None])
    for name, values in ramps:
        assert found[name]["limit"] == pytest.approx(values["limit"], rel=0.1)
    assert found["command_delay"]["delay"] == pytest.approx(0.08, abs=0.03)
    without = commissioned(replace(load_robot("husky"), effects=(("command_delay", {"delay": 0.08}),)), [None])
    assert not {name for name, _ in ramps} & set(without)


def test_ramps_are_commissioned_where_the_wheels_show_something_else():
    """Wheels of weak motors hardly turn on the spot and look limited in their yaw rate: that alone leads to no ramp."""
    husky = load_robot("husky")
    ramps = (("acceleration_limit", {"limit": 1.5}), ("yaw_acceleration_limit", {"limit": 2.0}))
    data = driven(replace(husky, effects=(*ramps, ("drive_compliance", {"speed_loss": 0.35}))))
    evidence = Evidence(SmoothedMotion(data.motion, 0.002, 0.001, (slice(0, len(data.motion)),)), data.commands)
    prepared = commissioning._prepare(evidence, husky, SAMPLES, 1.0)
    misled = WheelFinding((("yaw_rate_limit", {"limit": 0.2}),), ({"limit": 0.01},), 0.1, 0.05, 1.0)
    found = dict(commissioning._started(prepared, commissioning.COMMISSIONED, misled).effects)
    for name, values in ramps:
        assert found[name]["limit"] == pytest.approx(values["limit"], rel=0.1)
    assert "yaw_rate_limit" not in found


def test_commissioning_knows_motors_of_a_largest_torque_and_takes_them_for_no_slippery_ground():
    torque = {"acceleration": 1.6, "scrub": 0.4}
    found = commissioned(replace(load_robot("husky"), effects=(("drive_torque_limit", torque),)), [None])
    assert {key: found["drive_torque_limit"][key] for key in torque} == pytest.approx(torque, rel=0.1)
    assert found["friction_scale"]["factor"] == pytest.approx(1.0, abs=0.2)
    assert not {"acceleration_limit", "yaw_acceleration_limit"} & set(found)


def test_commissioning_knows_a_robot_that_stands_against_its_tyres_and_takes_it_for_no_sideways_grip():
    """Its motors cannot begin a turn. At the slip of the physics' own it would creep, at 2 mm/s it stands: fitted
    without it, tyres grip 1.4 times as much sideways, and the robot turns a quarter faster."""
    weak = (("drive_compliance", {"speed_loss": 0.3}), ("friction_creep", {"factor": 0.1}))
    found = commissioned(replace(load_robot("husky"), effects=weak), [None])
    assert found["friction_creep"]["factor"] == pytest.approx(0.1, abs=0.05)
    assert found["drive_compliance"]["speed_loss"] == pytest.approx(0.3, rel=0.15)
    assert found["friction_anisotropy"]["factor"] == pytest.approx(1.0, abs=0.1)
    assert found["turning_scrub"]["track_width_factor"] == pytest.approx(1.0, abs=0.05)


def test_the_healthy_loss_is_the_mean_of_all_windows_where_one_segment_has_most_of_it():
    """A later drive's mean loss is compared with it: the mean of logarithms is less, here by more than half."""
    husky = load_robot("husky")
    data = driven(husky)
    evidence = Evidence(SmoothedMotion(data.motion, 0.002, 0.001, (slice(0, len(data.motion)),)), data.commands)
    prepared = commissioning._prepare(evidence, husky, SAMPLES, 1.0)
    late = prepared.data.starts > np.quantile(prepared.data.starts, 0.7)
    size = np.where(late, 6.0, 0.2)[:, None, None]
    residual = size * prepared.floor * np.random.default_rng(2).standard_normal(prepared.floor.shape)
    healthy = commissioning._nominal([prepared], commissioning.COMMISSIONED, [residual])
    later = Search(husky, prepared.data, residual_scale(prepared.floor, prepared.data, healthy), nominal=healthy)
    losses = robust(residual / later.scale)
    assert healthy.loss == pytest.approx(losses.mean(), rel=0.15)
    assert np.exp(np.log([losses[late].mean(), losses[~late].mean()]).mean()) < 0.5 * losses.mean()


def test_a_fit_goes_on_where_limits_hardly_act():
    """They have hardly a derivative, and steps as long as the bounds allow: with limits of 0.05 m/s² nothing moves."""
    husky = load_robot("husky")
    limits = {"acceleration_limit": (0.8, 6.0), "yaw_acceleration_limit": (1.0, 8.0)}
    data = driven(replace(husky, effects=tuple((name, {"limit": true}) for name, (true, _) in limits.items())))
    start = (*commissioning.COMMISSIONED, *((name, {"limit": first}) for name, (_, first) in limits.items()))
    fit = fit_effects(Predictions(husky, data), [start], SCALE, iterations=12, prior=0.02)
    for name, (true, _) in limits.items():
        assert dict(fit.effects)[name]["limit"] == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize("further", [(), (("drive_loss", {"loss": 0.05}),)])
def test_what_one_of_two_recordings_shows_of_the_drives_is_not_commissioned(monkeypatch, further):
    """All recordings must then have the same effects again."""
    husky = load_robot("husky")
    monkeypatch.setattr(commissioning, "_further", lambda *args: further)
    recordings = []
    for effects in ((), (("acceleration_limit", {"limit": 1.0}), ("yaw_acceleration_limit", {"limit": 1.5}))):
        data = driven(replace(husky, effects=effects))
        recordings.append(
            Evidence(SmoothedMotion(data.motion, 0.002, 0.001, (slice(0, len(data.motion)),)), data.commands)
        )
    names = {effect.name for effect in commission(recordings, husky)[0]}
    assert not {"acceleration_limit", "yaw_acceleration_limit"} & names
    assert {name for name, _ in further} <= names


def test_a_robot_commissioned_in_grass_knows_its_drag_and_not_a_gain_of_its_drives():
    injected = {"coefficient": 1.5e4, "yield_speed": 0.5}
    robot = replace(load_robot("husky"), effects=(("vegetation_drag", injected),))
    found = commissioned(robot, [rough_and_grassy()])
    assert found["vegetation_drag"]["coefficient"] == pytest.approx(injected["coefficient"], rel=0.25)
    assert found["drive_gain"]["gain"] == pytest.approx(1.0, abs=0.015)
    # A drive that met no grass says nothing about it, and takes nothing from what the other one says.
    bare = replace(rough_and_grassy(), geometric_height=rough_and_grassy().height)
    both = commissioned(robot, [bare, rough_and_grassy()])
    assert both["vegetation_drag"]["coefficient"] == pytest.approx(found["vegetation_drag"]["coefficient"], rel=0.1)
    assert not shows_vegetation(driven(robot, bare)) and not shows_vegetation(driven(robot))


def test_a_robot_is_commissioned_whose_drives_have_a_limit():
    """A limit does nothing at infinity, to which no prior can draw it."""
    found = commissioned(replace(load_robot("husky"), effects=(("actuator_saturation", {"limit": 0.5}),)), [None])
    assert found["actuator_saturation"]["limit"] == pytest.approx(0.5, rel=0.05)


def test_further_effects_are_fitted_from_what_was_found_before_them(monkeypatch):
    """From the usual values of a robot, on ground of a third of the usual friction, no step may lead down at once."""
    began = []

    def watched(predictions, starts, *arguments, **options):
        fit = fit_effects(predictions, starts, *arguments, **options)
        began.append((dict(starts[0]), dict(fit.effects)))
        return fit

    monkeypatch.setattr(commissioning, "fit_effects", watched)
    commissioned(replace(load_robot("husky"), effects=(("actuator_saturation", {"limit": 0.5}),)), [None])
    number, again = next((n, start) for n, (start, _) in enumerate(began) if "actuator_saturation" in start)
    kept = {name: values for name, values in again.items() if name != "actuator_saturation"}
    assert kept in [fitted for _, fitted in began[:number]] and kept != dict(commissioning.COMMISSIONED)


def test_a_supply_that_drains_is_no_supply_that_is_low():
    husky = load_robot("husky")
    data = driven(husky, factor=1.0 - 0.8 * np.arange(2700) * 0.01 / 60.0)
    found = Search(husky, data, SCALE, of_time=True).run(1).best
    assert found.names == ("supply_drain",)
    assert dict(found.effects)["supply_drain"]["drain"] == pytest.approx(0.8, rel=0.1)
    low = Search(husky, driven(husky, factor=0.8), SCALE, of_time=True).run(1).best
    assert low.names == ("drive_gain",)


def test_a_robot_whose_file_says_how_fast_its_supply_drains_is_predicted_with_it():
    husky = load_robot("husky")
    data = driven(husky, factor=1.0 - 0.8 * np.arange(2700) * 0.01 / 60.0)
    drained = replace(husky, effects=(("supply_drain", {"drain": 0.8}),))
    before, after = (np.abs(Predictions(robot, data).residuals([()])[0]).mean() for robot in (husky, drained))
    assert after < 0.3 * before


def test_friction_that_fell_far_below_that_of_the_file_is_found():
    """Far from it, nothing changes at first: values near 1 say as little as those near the file's."""
    file = replace(load_robot("husky"), effects=(("friction_scale", {"factor": 0.4}),))
    data = driven(replace(file, effects=(("friction_scale", {"factor": 0.05}),)))
    found = Search(file, data, SCALE).run(1, exchange=False).best
    assert found.names == ("friction_scale",)
    assert dict(found.effects)["friction_scale"]["factor"] == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(
    ("hidden", "other", "worse"),
    [
        (("gravity_tilt", {"about_x": 0.0, "about_y": 0.05}), "constant_force", 1.0),
        (("command_delay", {"delay": 0.2}), "command_clock_offset", 1.0),
        # They differ where the robot starts and stops, which a better localisation shows.
        (("actuator_deadband", {"width": 0.06}), "rolling_resistance", 3.0),
    ],
)
def test_effects_that_a_drive_cannot_separate_are_one_class(hidden, other, worse):
    """On level ground, straight ahead: of each pair the motion says the same."""
    husky = load_robot("husky")
    robot = replace(husky, effects=(("drive_compliance", {"speed_loss": 0.3}),))
    data = straight(replace(robot, effects=(*robot.effects, hidden)), worse)
    outcome = Search(robot, data, worse * SCALE).run(1)
    (found,) = outcome.best.names
    assert {hidden[0], other} <= {found, *outcome.indistinguishable[found]}


def straight(robot, worse=1.0):
    """Windows of a drive straight ahead, on level ground, at two speeds between stops, with the errors of a
    localisation: 8 mm and 0.2°, or so many times ``worse``, correlated over half a second."""
    step = np.arange(2700)
    commanded = np.zeros((2700, 2))
    commanded[:, 0] = np.where(step % 540 < 400, np.where(step % 1080 < 540, 0.3, 0.7), 0.0)
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    result = rollout(TerrainMap.flat(GRID), robot, speeds, State.at_rest(0.14), with_forces=False)
    motion = recorded(result, 10**9)
    random = np.random.default_rng(5)

    def error(size):
        samples = 0.5e9 / float(motion.stamps[1] - motion.stamps[0])
        rough = gaussian_filter1d(random.standard_normal((len(motion), 3)), samples, axis=0)
        return worse * size * rough / rough.std()

    turned = Rotation.from_quat(motion.quaternions) * Rotation.from_rotvec(error(np.radians(0.2)) * [0.0, 0.0, 1.0])
    motion = replace(motion, positions=motion.positions + error(0.008), quaternions=turned.as_quat())
    commands = CommandTrack(10**9 + step * 10_000_000, commanded)
    return EvidenceWindows(motion, commands, window_starts(motion, [slice(0, len(motion))], 2.0, 1.0), 2.0, SAMPLES)


@pytest.mark.parametrize("friction", [0.12, 0.2])
def test_an_effect_is_found_beside_one_that_took_over_some_of_it(friction):
    """On ice the robot turns less than its limited drives make it: another limit alone takes over some of that. From
    there no friction explains much, unless the limit moves with it."""
    husky = load_robot("husky")
    weak = replace(husky, effects=(("drive_compliance", {"speed_loss": 0.1}), ("friction_scale", {"factor": 1.2})))
    hidden = (("actuator_saturation", {"limit": 0.45}), ("friction_scale", {"factor": friction}))
    search = Search(weak, driven(replace(weak, effects=(weak.effects[0], *hidden))), SCALE)
    alone = (("actuator_saturation", {"limit": 0.52}),)
    further = search.screening.candidates(alone, 0, "2: ")
    found = next(entry for entry in further.screened if entry.name == "friction_scale")
    assert found.loss < 0.05 * further.before and found.test.adjusted < 0.025
    assert dict(found.effects)["friction_scale"]["factor"] == pytest.approx(friction, rel=0.15)
    assert dict(found.effects)["actuator_saturation"]["limit"] == pytest.approx(0.45, rel=0.03)


@pytest.mark.parametrize(("difference", "names"), [(0.02, ["drive_gain"]), (0.06, ["drive_gain", "drive_loss"])])
def test_what_is_no_more_than_the_error_of_a_formula_is_no_further_effect(difference, names):
    """Formulas are exact only in our own simulator: elsewhere a second effect makes up for the first one's error."""
    hidden = (("drive_gain", {"gain": 0.6}), ("drive_asymmetry", {"difference": difference}))
    husky = load_robot("husky")
    search = Search(husky, driven(replace(husky, effects=hidden)), SCALE)
    found = search.run(2, exchange=False)
    # An asymmetry and a loss on one side are the same beside a gain.
    assert list(found.best.names) == names
    second = [candidate for candidate in found.tried if candidate.round == 2 and candidate.judged]
    assert any(candidate.name == "drive_loss" and candidate.p < 0.025 for candidate in second)


@pytest.mark.parametrize(
    ("left", "share", "made_up"), [(1.4, 0.5, True), (1.4, 0.9, False), (5.0, 0.5, False), (5.0, 0.9, False)]
)
def test_what_explains_little_of_as_little_as_a_healthy_robot_shows_makes_up_for_a_formula(left, share, made_up):
    gain = (("drive_gain", {"gain": 0.85}),)
    husky = load_robot("husky")
    varying = dict.fromkeys((effect.name for effect in identifiable_effects(husky)), 0.1)
    healthy = NominalModel(SCALE, varying, segments=5, loss=0.4, loss_spread=0.2)
    search = Search(husky, driven(replace(husky, effects=gain)), SCALE, nominal=healthy)
    windows = np.ones(len(search.loss_of(())))
    first = Trial(gain, (gain,) * 2, 0.4 * left * windows)
    both = (*gain, ("drive_loss", {"loss": 0.01}))
    second = Trial(both, (both,) * 2, 0.4 * (left - share * (left - 1.0)) * windows)
    assert search._makes_up(first, second) == made_up


@pytest.mark.parametrize(
    ("without", "with_it", "needed"),
    [
        (4.0, 1.2, True),  # Most of what the other one leaves.
        (4.0, 3.0, False),  # Little of it.
        (0.9, 0.6, False),  # All of it, but no more than a healthy robot may well have.
        (18.0, 8.0, True),  # Most of what both explain.
    ],
)
def test_one_of_two_effects_is_needed_that_explains_most_of_the_rest(monkeypatch, without, with_it, needed):
    gain, both = (("drive_gain", {"gain": 0.85}),), (("drive_gain", {"gain": 0.85}), ("drive_loss", {"loss": 0.05}))
    husky = load_robot("husky")
    varying = dict.fromkeys((effect.name for effect in identifiable_effects(husky)), 0.1)
    healthy = NominalModel(SCALE, varying, segments=5, loss=0.8, loss_spread=0.2)
    search = Search(husky, driven(husky), SCALE, nominal=healthy)
    windows = np.ones(len(search.loss_of(())))
    monkeypatch.setattr(search, "_without_effects", Trial((), ((),) * 2, 20.0 * windows))
    monkeypatch.setattr(search, "judge", lambda effects: Trial(gain, (gain,) * 2, without * windows))
    assert search.needs(Trial(both, (both,) * 2, with_it * windows), "drive_loss") == needed


def test_a_further_effect_in_whose_presence_the_first_one_goes_must_explain_more_than_that(monkeypatch):
    """Of two effects that the motion shows only together, the first one may not be significant beside the other."""
    husky = load_robot("husky")
    hidden = (("rolling_resistance", {"coefficient": 0.3}), ("constant_force", {"x": 60.0, "y": 0.0}))
    search = Search(husky, driven(replace(husky, effects=hidden)), SCALE)
    first = search.judge((("rolling_resistance", {"coefficient": 0.25}),))
    further, _ = search._further(first, 2)
    assert further is not None and further.names[0] == "rolling_resistance"
    force = search.judge((("constant_force", {"x": -100.0, "y": 0.0}),))
    assert force.loss > first.loss
    monkeypatch.setattr(search, "_pruned", lambda trial: force)
    assert search._further(first, 2)[0] is None


@pytest.mark.parametrize("force", [0.0, 120.0])
def test_what_is_left_that_is_too_large_for_the_error_of_a_formula_lets_a_further_effect_be_found(force):
    """Where a healthy robot varies much in one direction no test shows that this is it: what it predicts does."""
    husky = load_robot("husky")
    hidden = (("drive_gain", {"gain": 0.8}), ("constant_force", {"x": 0.0, "y": force}))
    names = [effect.name for effect in identifiable_effects(husky)]
    varying = {**dict.fromkeys(names, 0.3), "constant_force": 8.0, "gravity_tilt": 8.0}
    healthy = NominalModel(SCALE, varying, segments=5, loss=0.4, loss_spread=0.2)
    search = Search(husky, driven(replace(husky, effects=hidden)), SCALE, nominal=healthy)
    found = search.run(2, exchange=False)
    second = [candidate for candidate in found.tried if candidate.name == "constant_force" and candidate.round == 2]
    assert all(candidate.p > search.thresholds.further_rate for candidate in second)
    assert found.best.names == (("drive_gain", "constant_force") if force else ("drive_gain",))


@pytest.mark.parametrize(("delay", "found"), [(0.035, False), (0.12, True)])
def test_a_shift_of_less_than_the_time_between_two_commands_is_no_fault(delay, found):
    """The base reads commands in its own cycle, which begins anew with each start of a healthy robot."""
    husky = load_robot("husky")
    data = driven(replace(husky, effects=(("command_delay", {"delay": delay}),)))
    slow = CommandTrack(data.commands.stamps[::5], data.commands.twists[::5])
    names = [effect.name for effect in identifiable_effects(husky)]
    healthy = NominalModel(SCALE, dict.fromkeys(names, 0.01), segments=5, loss=0.4, loss_spread=0.2)
    best = Search(husky, replace(data, commands=slow), SCALE, nominal=healthy).run(1, exchange=False).best
    shifts = {"command_delay", "command_clock_offset", "pose_clock_offset"} & set(best.names)
    assert bool(shifts) == found


@pytest.mark.parametrize(("gain", "kept"), [(0.8, True), (1.2, False)])
def test_what_a_sensor_measured_acts_unless_the_motion_contradicts_it(gain, kept):
    husky = load_robot("husky")
    measured = (("drive_gain", {"gain": gain}),)
    data = driven(replace(husky, effects=(("drive_gain", {"gain": 0.8}),)))
    search = Search(husky, data, SCALE, known=measured)
    assert search.known == (measured if kept else ())
    assert search.measured().best.names == (("drive_gain",) if kept else ())


@pytest.mark.parametrize("measured", [True, False])
def test_an_effect_is_exchanged_for_one_that_predicts_better_and_is_a_measurement(monkeypatch, measured):
    husky = load_robot("husky")
    search = Search(husky, driven(replace(husky, effects=(("actuator_lag", {"time_constant": 0.5}),))), SCALE)
    wrong = search.judge((("command_delay", {"delay": 0.3}),))
    if not measured:
        monkeypatch.setattr(search, "credible", lambda trial, last=None: trial.names != ("actuator_lag",))
    best, _ = search._exchanged(wrong)
    assert (best.names == ("actuator_lag",)) == measured


def test_beside_a_further_effect_the_values_of_the_first_one_are_fitted_once_more():
    """Compliance alone makes up for low friction, too: with its value as it is, delays promise more than friction."""
    hidden = (("friction_scale", {"factor": 0.25}), ("drive_compliance", {"speed_loss": 0.42}))
    husky = load_robot("husky")
    names = [effect.name for effect in identifiable_effects(husky)]
    healthy = NominalModel(SCALE, dict.fromkeys(names, 0.25), segments=5, loss=0.4, loss_spread=0.2)
    search = Search(husky, driven(replace(husky, effects=hidden)), SCALE, nominal=healthy)
    found = search.run(2, exchange=False)
    assert set(found.best.names) == {"friction_scale", "drive_compliance"}


@pytest.mark.parametrize("late", [0.0, 0.4])
def test_a_lag_that_is_added_to_that_of_the_healthy_drives_is_no_dead_time(late):
    """One lag in series with another one is later than a single one, but not as late as a dead time."""
    own, added = 0.12, 0.6 if late else 0.32
    file = replace(load_robot("husky"), effects=(("actuator_lag", {"time_constant": own}),))
    hidden = {"time_constant": added, "second_time_constant": own}
    robot = replace(file, effects=(("actuator_lag", hidden), ("command_delay", {"delay": late})))
    candidates = [effect.name for effect in identifiable_effects(file)]
    healthy = NominalModel(SCALE, dict.fromkeys(candidates, 0.1), segments=5, loss=0.4, loss_spread=0.2)
    found = Search(file, driven(robot), SCALE, nominal=healthy).run(3, exchange=False).best
    assert "actuator_lag" in found.names
    assert len(found.names) == (2 if late else 1)
    if not late:
        assert sorted(dict(found.effects)["actuator_lag"].values()) == pytest.approx([own, added], abs=0.03)


@pytest.mark.parametrize(("worse", "name"), [(0.05, "sensor_lever_arm"), (0.2, "payload")])
def test_fewer_parameters_are_preferred_only_within_the_error_of_a_formula(worse, name):
    """Few blocks make large differences insignificant: what predicts much worse is not preferred for that."""
    husky = load_robot("husky")
    payload, arm = (("payload", {"mass": 15.0, "x": 0.2, "y": 0.0}),), (("sensor_lever_arm", {"x": 0.1, "y": 0.0}),)
    search = Search(husky, driven(replace(husky, effects=payload)), SCALE)
    before = search.loss_of(())
    explained = np.zeros(len(before))
    # A single block of some makes the difference, which is therefore not significant.
    explained[:4] = worse * before.sum() / 4.0
    trials = [Trial(payload, (payload,) * 2, 0.0 * before), Trial(arm, (arm,) * 2, explained)]
    assert search._preferred(trials).names == (name,)


def hilly():
    """Slopes of up to 9°."""
    x, y = (torch.from_numpy(values).float() for values in np.meshgrid(GRID.x, GRID.y))
    return TerrainMap.from_height(0.3 * torch.sin(0.5 * x) * torch.cos(0.4 * y), GRID)


@pytest.mark.parametrize("height", [0.4, 0.0])
def test_the_height_of_a_payload_is_found_where_slopes_show_it(height):
    husky = load_robot("husky")
    payload = {"mass": 15.0, "x": -0.2, "y": 0.1, "z": height}
    data = driven(replace(husky, effects=(("payload", payload),)), hilly())
    search = Search(husky, data, SCALE)
    found = dict(search.refined(search.judge((("payload", {"mass": 10.0, "x": -0.1, "y": 0.0}),))).effects)["payload"]
    assert ("z" in found) == (height > 0.0)
    for key in found.keys() - {"mass"}:
        # Mass and place trade off against each other; the moment is what moves the robot.
        assert found["mass"] * found[key] == pytest.approx(payload["mass"] * payload[key], rel=0.2), key


@pytest.mark.parametrize(("delay", "shifted"), [(0.08, True), (0.2, False)])
def test_where_a_base_reads_commands_later_in_its_cycle_that_is_neither_a_fault_nor_a_lag(delay, shifted):
    """It delays all motion: beside a tilt a lag stands in for it."""
    husky = load_robot("husky")
    tilt = ("gravity_tilt", {"about_y": 0.05, "about_x": 0.0})
    data = driven(replace(husky, effects=(tilt, ("command_delay", {"delay": delay}))))
    data = replace(data, commands=CommandTrack(data.commands.stamps[::10], data.commands.twists[::10]))
    varying = dict.fromkeys((effect.name for effect in identifiable_effects(husky)), 0.01)
    healthy = NominalModel(SCALE, varying, segments=5, loss=0.2, loss_spread=0.1)
    evidence = Evidence(SmoothedMotion(data.motion, 0.001, 0.001, (slice(0, len(data.motion)),)), data.commands)
    windows = Windows(data, np.full((len(data.starts), *SCALE.shape), 1e-4))
    aligned = explain_aligned(evidence, husky, windows, healthy, DiagnosisSettings(max_effects=2))
    assert bool(aligned.remark) == shifted
    later = 1e-9 * (aligned.evidence.commands.stamps[0] - data.commands.stamps[0])
    assert later == pytest.approx(delay if shifted else 0.0, abs=0.01)
    if shifted:
        ((name, values),) = aligned.explanation.decision.trial.effects
        assert name == "gravity_tilt" and values["about_y"] == pytest.approx(0.05, abs=0.005)
