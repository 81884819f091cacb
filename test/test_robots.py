"""Robot files: the models read from them, and the errors of invalid ones."""

import math

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import RobotFileError, load_robot, robot_file, shipped_robots, write_robot
from monoforce_ros.robots.belt import belt_outline
from monoforce_ros.terrain import Grid, TerrainMap


@pytest.mark.parametrize("name", shipped_robots())
def test_shipped_robots_are_consistent(name):
    robot = load_robot(name)
    assert robot.name == name
    driven = robot.point_drives >= 0
    norms = robot.point_tangents.norm(dim=1)
    np.testing.assert_allclose(norms[driven].numpy(), 1.0, atol=1e-6)
    np.testing.assert_allclose(norms[~driven].numpy(), 0.0)
    assert float(robot.inertia.det()) > 0 and 0 < robot.ground_clearance < 1
    # The lowest points move backwards relative to a body that drives forward.
    lowest = robot.points[:, 2] < robot.points[driven][:, 2].min() + 0.005
    assert bool((robot.point_tangents[lowest & driven][:, 0] < -0.85).all())


def test_area_does_not_depend_on_sampling():
    areas = []
    for spacing in (0.1, 0.05, 0.02):
        robot = load_robot("husky", spacing=spacing)
        areas.append(float(robot.point_areas[robot.point_drives >= 0].sum()))
    wheel = 2 * math.pi * 0.1651 * 0.1143
    np.testing.assert_allclose(areas, 4 * wheel, rtol=1e-5)


def test_inertia_does_not_depend_on_sampling():
    first, second = (load_robot("husky", spacing=s).inertia for s in (0.1, 0.02))
    np.testing.assert_array_equal(first.numpy(), second.numpy())


@given(st.floats(0.05, 3.0), st.floats(0.02, 0.5), st.floats(0.02, 0.5), st.sampled_from([0.02, 0.05]))
@settings(max_examples=40, deadline=None)
def test_belts_are_closed_and_run_backwards_at_the_bottom(length, rear, front, spacing):
    if abs(rear - front) >= 0.95 * length:
        return
    positions, tangents, lengths, _ = belt_outline(length, rear, front, spacing)
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0, atol=1e-9)
    # The belt is closed.
    np.testing.assert_allclose((tangents * lengths[:, None]).sum(axis=0), 0.0, atol=0.03 * lengths.sum())
    assert tangents[np.argmin(positions[:, 1]), 0] < -0.7
    tilt = math.asin((rear - front) / length)
    circumference = front * (math.pi - 2 * tilt) + rear * (math.pi + 2 * tilt) + 2 * length * math.cos(tilt)
    assert lengths.sum() == pytest.approx(circumference, rel=1e-9)


def test_flippers_move_their_points_and_the_inertia():
    marv = load_robot("marv").to(torch.float64)
    raised = marv.posed(torch.tensor([0.8, 0.8, -0.14, -0.14]))
    front = (marv.point_flippers == 0) | (marv.point_flippers == 1)
    assert float(raised.points[front][:, 2].max()) > float(marv.points[front][:, 2].max()) + 0.2
    assert torch.equal(raised.points[~front], marv.points[~front])
    # With the front flippers raised, mass moves up and back; the total is unchanged.
    assert float(raised.mass) == pytest.approx(float(marv.mass))
    shift = raised.centre_of_mass - marv.centre_of_mass
    lift = 2 * 4.0 * 0.18 * (math.sin(0.8) - math.sin(-0.14)) / 60.0
    assert float(shift[2]) == pytest.approx(lift, rel=1e-6) and float(shift[0]) < 0
    upright = marv.posed(torch.full((4,), math.pi / 2))
    assert float(upright.inertia[2, 2]) < float(marv.inertia[2, 2])
    back = upright.posed(marv.flipper_angles)
    np.testing.assert_allclose(back.points.numpy(), marv.points.numpy(), atol=1e-12)
    np.testing.assert_allclose(back.inertia.numpy(), marv.inertia.numpy(), atol=1e-9)
    with pytest.raises(ValueError, match=r"flipper angles: got shape \(2,\), expected \[4\]"):
        marv.posed(torch.zeros(2))


@pytest.mark.parametrize("angles", [[0.0] * 4, [-0.6, -0.6, 0.3, 0.3], [-0.5] * 4])
def test_a_robot_stands_and_drives_on_its_flippers(angles):
    marv = load_robot("marv").posed(torch.tensor(angles))
    speeds = marv.drive_speeds(torch.tensor([0.4, 0.0]).expand(1, 400, 2))
    result = rollout(TerrainMap.flat(Grid.square(20.0)), marv, speeds, State.at_rest(marv.ground_clearance + 0.02))
    assert bool(result.valid.all())
    assert float(result.normal_forces[0, -1].sum()) == pytest.approx(60 * 9.81, rel=0.02)
    assert float(result.velocity[0, -1, 0]) == pytest.approx(0.4, rel=0.05)
    pitch = math.asin(float(result.rotation[0, -1, 2, 0]))
    # Front flippers pushed down lift the nose.
    assert (pitch > 0.05) == (angles[0] < angles[2] - 0.1)


def test_a_twist_becomes_drive_speeds():
    robot = load_robot("husky")
    left, right = robot.drive_names.index("left"), robot.drive_names.index("right")
    speeds = robot.drive_speeds(torch.tensor([0.5, 1.0]))
    assert float(speeds[left]) == pytest.approx(0.5 - 0.2854) and float(speeds[right]) == pytest.approx(0.5 + 0.2854)
    assert float(robot.drive_speeds(torch.tensor([9.0, 0.0])).max()) == robot.maximum_speed


CHANGES = [
    (lambda c: c.update(wieght=3), r"the file: got 'wieght', expected one of the keys"),
    (lambda c: c.update(mass="50 kg"), r"mass: got '50 kg', expected a number from 0.1 to 100000 kg"),
    (lambda c: c.update(mass=-1), r"mass: got -1"),
    (lambda c: c.pop("command"), r"the key 'command', which is missing"),
    (lambda c: c["wheels"][0].update(radius=165.1), r"wheels\[0\].radius: got 165.1, expected a number .* m"),
    (lambda c: c["wheels"][1].pop("drive"), r"wheels\[1\].*'drive', which is missing"),
    (lambda c: c.update(wheels=[]), r"at least one driven wheel, track or flipper"),
    (lambda c: c.update(inertia=[1, 1, 1, 0, 0, 0]), r"either inertia or inertia_box"),
    (lambda c: (c.pop("inertia_box"), c.update(inertia=[1, 1, 9, 0, 0, 0])), r"principal moments"),
    (lambda c: c.update(centre_of_mass=[0, 0]), r"a list of 3 numbers"),
    (lambda c: c["sensors"]["lidar"].update(quaternion=[0, 0, 0, 1]), r"either rotation .* or quaternion"),
    (lambda c: c.update(sensors={"lidar": {"translation": [0, 0, 0], "quaternion": [0, 0, 0, 0]}}), r"unit quaternion"),
    (lambda c: c.update(mass=float("nan")), r"mass: got nan"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES)
def test_errors_name_the_file_and_the_field(tmp_path, change, message):
    content = yaml.safe_load(robot_file("husky").read_text())
    change(content)
    file = tmp_path / "robot.yaml"
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(RobotFileError, match=message) as caught:
        load_robot(file)
    assert str(file) in str(caught.value)


def test_the_error_of_an_unknown_name_lists_the_shipped_robots():
    with pytest.raises(RobotFileError, match=r"no robot named 'huskey'.*husky"):
        load_robot("huskey")
    with pytest.raises(RobotFileError, match="does not exist"):
        load_robot("nowhere/robot.yaml")


@given(st.text(max_size=80))
@settings(max_examples=60, deadline=None)
def test_any_text_as_a_robot_file_is_refused_in_one_sentence(tmp_path_factory, text):
    file = tmp_path_factory.mktemp("robots") / "robot.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(RobotFileError):
        load_robot(file)


@pytest.mark.parametrize("key", ["indistinguishable", "rivals"])
def test_indistinguishable_effects_are_written_under_the_new_and_the_former_name(tmp_path, key):
    parameters = {"gain": {"value": 0.9, "low": 0.85, "high": 0.95, "unit": "-"}}
    effect = {"name": "drive_gain", "parameters": parameters, key: ["turning_scrub"]}
    file = write_robot("husky", tmp_path / "husky.yaml", [effect], [tmp_path / "bag"], "0")
    (written,) = yaml.safe_load(file.read_text())["effects"]
    assert written["provenance"]["indistinguishable"] == written["provenance"]["rivals"] == ["turning_scrub"]
    assert dict(load_robot(file).effects) == {"drive_gain": {"gain": 0.9}}


def test_the_wheel_radius_is_that_of_the_driven_wheels(tmp_path):
    """Wheel speeds are those of the drives: a small caster behind must not count."""
    robot = {
        "name": "cart", "mass": 80.0, "inertia_box": [1.0, 0.7, 0.3], "command": {"track_width": 0.76},
        "wheels": [
            *({"name": side, "drive": side, "centre": [0.0, y, 0.0], "radius": 0.175, "width": 0.09}
              for side, y in (("left", 0.38), ("right", -0.38))),
            {"name": "rear", "drive": None, "centre": [-0.5, 0.0, -0.113], "radius": 0.062, "width": 0.04},
        ],
    }  # fmt: skip
    file = tmp_path / "cart.yaml"
    file.write_text(yaml.safe_dump(robot))
    assert load_robot(file).wheel_radius == pytest.approx(0.175)
