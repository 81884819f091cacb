"""The protocol of benchmarks/terrain.py: seeds that do not mix, intervals over worlds and seeds, a log of every use."""

import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import terrain
import terrain_tables
import torch
import wall
from conftest import ROOT
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState
from monoforce_ros.perception import support_points
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults


def result(system, checkpoint, world, position, **changed):
    depth = changed.pop("depth", 0.0)
    windows = {
        "positions": [position] * 5, "rotations": [10 * position] * 5, "vegetation": [depth] * 5,
        "overgrown": [float(depth > 0.2)] * 5,
    }  # fmt: skip
    values = {
        "physics": "paper",
        "rotation": 10 * position,
        "windows": 5,
        "strata": {"robot": "husky"},
        **windows,
    } | changed
    return terrain_tables.Result(system=system, checkpoint=checkpoint, world=world, position=position, **values)


def test_seeds_of_the_purposes_are_disjoint_and_reporting_refuses_the_others():
    ranges = (terrain.TRAINING, terrain.CHOOSING, terrain.REPORTING)
    for first in ranges:
        for second in ranges:
            assert first is second or not any(seed in second for seed in (first.first, first.first + first.count - 1))
    assert terrain.reporting_seeds(440_000, 3) == [440_000, 440_001, 440_002]
    with pytest.raises(ValueError, match="seeds 429999 to 429999 are for training"):
        terrain.reporting_seeds(429_999, 1)
    with pytest.raises(ValueError, match="are for choosing; expected 440000"):
        terrain.reporting_seeds(439_998, 5)


def test_intervals_cover_worlds_and_training_seeds():
    worlds = [result("lss", "0", world, 0.1 + 0.01 * world) for world in range(10)]
    mean, low, high = terrain_tables.interval(worlds, "position")
    assert mean == pytest.approx(0.145) and low < 0.13 and high > 0.16
    # Training seeds that disagree widen the interval although worlds are the same.
    disagreeing = [result("lss", str(run), w, value) for run, value in ((0, 0.1), (1, 0.3)) for w in range(10)]
    mean, low, high = terrain_tables.interval(disagreeing, "position")
    assert mean == pytest.approx(0.2) and low < 0.1 and high > 0.3
    # A world that one run could not evaluate counts for none.
    assert terrain_tables.interval([*disagreeing, result("lss", "0", 99, 5.0)], "position")[0] == pytest.approx(0.2)


def test_ratios_compare_the_same_worlds():
    """Worlds differ a lot, one system is always 20 % better: the interval of the ratio is narrow."""
    first = [result("both", str(run), world, 0.8 * (1 + world)) for run in (0, 1) for world in range(12)]
    second = [result("monoforce", "0", world, 1.0 + world) for world in range(12)]
    assert terrain_tables.ratio(first, second, "position") == pytest.approx((0.8, 0.8, 0.8))
    # A world that only one of them could evaluate counts for neither; without a common one there is no ratio.
    assert terrain_tables.ratio([*first, result("both", "0", 50, 9.0)], second, "position")[0] == pytest.approx(0.8)
    assert np.isnan(terrain_tables.ratio(first, [result("monoforce", "0", 70, 1.0)], "position")[0])
    tall = [
        result(r.system, r.checkpoint, r.world, r.position * (0.5 if r.system == "both" else 1.0), depth=0.5)
        for r in (*first, *second)
        if r.world > 5
    ]
    short = [r for r in (*first, *second) if r.world <= 5]
    (row,) = [line for line in terrain_tables.ratio_table([*tall, *short], "paper").splitlines() if "both" in line]
    assert row.startswith("| both / monoforce | 0.5") and row.count("| 0.40 (0.40 – 0.40) ") == 2
    assert terrain_tables.ratio_table(second, "paper") == ""
    # The paper's own ratios, which it gives in tables of errors, stand beside.
    both_known = [result(name, "0", world, 0.1, depth=0.5) for name in ("monoforce", "lss") for world in (1, 2)]
    (row,) = [line for line in terrain_tables.ratio_table(both_known, "paper").splitlines() if "lss" in line]
    assert row.split(" | ")[5] == "1.08, 0.99" and row.endswith("| 0.64, 0.45 |")


def test_windows_in_which_a_prediction_diverged_count_for_no_system():
    rows = [result("lss", "0", 1, 0.2), result("lidar", "", 1, 0.1), result("lidar", "", 2, 0.3)]
    rows[0] = replace(rows[0], positions=[0.2, float("nan"), 0.2, 0.2, 0.2])
    rows[1] = replace(rows[1], positions=[0.1, 9.9, 0.1, 0.1, 0.1])
    assert terrain_tables.diverged(rows) == {"lss": 1}
    found = terrain_tables.in_common(rows)
    assert [r.windows for r in found] == [4, 4, 5]
    assert [r.position for r in found] == pytest.approx([0.2, 0.1, 0.3])


def test_grounds_go_by_what_the_robot_drives_through():
    row = replace(
        result("lidar", "", 1, 0.1), positions=[1.0, 2.0, 3.0], rotations=[1.0, 2.0, 3.0],
        vegetation=[0.01, 0.6, 0.6], overgrown=[0.0, 0.1, 0.5],
    )  # fmt: skip
    found = {
        name: terrain_tables.over_windows([row], among)[0].position for name, among in terrain_tables.GROUNDS.items()
    }
    assert found == {"rigid": 1.0, "some vegetation": 2.0, "tall vegetation": 3.0}


def test_compared_systems_differ_in_heights_alone():
    robot = load_robot("husky")
    shipped = terrain.parse_checkpoints([])["shipped_lidar"]
    systems = [*terrain.learned_systems({"lidar_ht": shipped, "shipped_lidar": shipped}), terrain.LIDAR]
    found = {system.key: terrain.judged_source(system, robot) for system in systems}
    assert isinstance(found["lidar_ht@0"], terrain.DefaultMaterial) and found["lidar_ht@0"].sensors == ("lidar",)
    assert not isinstance(found["shipped_lidar@0"], terrain.DefaultMaterial)

    class Slippery:
        sensors, grid = (), Grid.square()

        def terrain(self, observation, motion):
            return terrain.TerrainMap.from_height(
                0.1 * torch.ones(self.grid.rows, self.grid.columns), self.grid, material=TerrainDefaults(friction=0.1)
            )

    judged = terrain.DefaultMaterial(Slippery()).terrain(None, None)
    assert float(judged.friction.min()) == pytest.approx(TerrainDefaults().friction)
    assert float(judged.height.min()) == pytest.approx(0.1)


def test_vegetation_counts_anywhere_under_the_robot(tmp_path, monkeypatch):
    """A tuft beside the centre is under the wheels; a path through grass is overgrown where half of it is."""
    robot = load_robot("husky")
    stamps = (np.arange(61) * 1e8).astype(np.int64)
    track = SimpleNamespace(stamps=stamps, positions=np.stack([0.2 * np.arange(61), *np.zeros((2, 61))], axis=1),
                            quaternions=np.tile([0.0, 0.0, 0.0, 1.0], (61, 1)))  # fmt: skip
    opened = SimpleNamespace(in_base_frame=lambda frame: SimpleNamespace(motion=track))
    monkeypatch.setattr(terrain.Recording, "open", lambda *args, **kwargs: opened)
    height = np.zeros((81, 241), np.float32)
    height[36:38, 80] = 0.3  # 0.3 to 0.4 m to the right, 6 m ahead
    height[:, 120:] = 0.5
    np.savez(terrain.labels_file(tmp_path / "bag"), visible_height=height, support_height=np.zeros_like(height),
             vegetation_height=height, origin=np.array([-2.0, -4.0]), resolution=np.array(0.1))  # fmt: skip
    greatest, share = terrain.driven_vegetation(tmp_path / "bag", robot, [0])
    assert greatest[0] == pytest.approx(0.5) and share[0] == pytest.approx(1 / 51, abs=0.03)
    height[:, 120:] = 0.0
    np.savez(terrain.labels_file(tmp_path / "bag"), visible_height=height, support_height=np.zeros_like(height),
             vegetation_height=height, origin=np.array([-2.0, -4.0]), resolution=np.array(0.1))  # fmt: skip
    assert terrain.driven_vegetation(tmp_path / "bag", robot, [0]) == ([pytest.approx(0.3, abs=0.01)], [0.0])
    # Deep mud is no vegetation.
    np.savez(terrain.labels_file(tmp_path / "bag"), visible_height=height + 0.3, support_height=np.zeros_like(height),
             vegetation_height=np.zeros_like(height), origin=np.array([-2.0, -4.0]),
             resolution=np.array(0.1))  # fmt: skip
    assert terrain.driven_vegetation(tmp_path / "bag", robot, [0]) == ([0.0], [0.0])


def test_an_encoder_gets_the_sensors_of_its_row():
    """The shipped encoder takes either sensor or both."""
    wanted = {"shipped": ("camera",), "shipped_lidar": ("lidar",), "shipped_both": ("camera", "lidar")}
    systems = terrain.learned_systems(terrain.parse_checkpoints([]))
    found = {system.key: terrain.terrain_source(system, load_robot("husky")).sensors for system in systems}
    assert found == {f"{name}@0": sensors for name, sensors in wanted.items()}


def test_the_log_counts_how_often_seeds_were_used(tmp_path):
    log = tmp_path / "terrain.log.jsonl"
    published = tmp_path / "published.log.jsonl"
    assert terrain.log_use([log, published], {"date": "a", "seeds": [1, 2]}) == 1
    assert terrain.log_use([log, published], {"date": "b", "seeds": [3]}) == 1
    assert terrain.log_use([log, published], {"date": "c", "seeds": [2, 3]}) == 3
    # The same use in the log of published tables counts once; a new folder does not start over.
    assert terrain.log_use([published, log], {"date": "c", "seeds": [2, 3]}) == 3
    assert terrain.log_use([tmp_path / "other", published], {"date": "d", "seeds": [3]}) == 2
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["times_used"] for line in lines] == [1, 1, 3]


def test_tables_have_a_row_for_every_system_and_stratum():
    rows = [result(key, "", world, 0.1, strata={"robot": name}) for key in ("lidar", "true_support", "flat")
            for world, name in enumerate(("husky", *["marv"] * 5))]  # fmt: skip
    text = terrain_tables.table(rows)
    assert "6 worlds, 30 windows" in text and "true support height (bound)" in text and "level ground" in text
    (row,) = [line for line in text.splitlines() if "lidar interpolation" in line]
    assert row.endswith("| 0.14 m, 4.06° | 0.13 m, 4.74° |")
    strata = terrain_tables.strata_table(rows, "paper")
    assert "| robot | marv | 5 |" in strata
    # One world says nothing of its robot.
    assert "| robot | husky |" not in strata


def test_strata_by_distance_leave_out_worlds_without_such_poses():
    near, far = {"0 to 1 m": 0.1, "1 to 2.5 m": 0.3}, {"0 to 1 m": 0.2, "1 to 2.5 m": float("nan")}
    rows = [result("lidar", "", 0, 0.1, by_distance=near), result("lidar", "", 1, 0.1, by_distance=far)]
    text = terrain_tables.strata_table([*rows, result("lidar", "", 2, float("nan"), windows=0)], "paper")
    assert "| distance | 0 to 1 m | 2 | 0.150 |" in text and "| distance | 1 to 2.5 m | 1 | 0.300 |" in text


def test_the_worst_predictions_of_each_system_are_of_different_worlds():
    rows = [
        result("lidar", "", world, 0.1, worst=1 + world, worst_position=error)
        for world, error in ((0, 0.5), (0, 0.9), (1, 0.7), (2, 0.2), (3, 0.1), (4, 0.05))
    ]
    rows += [
        result("constant", "", 0, 0.1, worst=1, worst_position=3.0),
        result("flat", "", 5, float("nan"), windows=0),
    ]
    found = terrain.worst_cases(rows, "paper")
    assert list(found) == ["lidar"] and [case.world for case in found["lidar"]] == [0, 1, 2]
    assert found["lidar"][0].worst_position == 0.9


def test_a_failure_is_where_true_heights_do_better():
    rows = [result(key, "", world, 0.1, worst=1, worst_position=error)
            for key, errors in (("true_support", (2.0, 0.1)), ("lidar", (2.1, 0.9)))
            for world, error in enumerate(errors)]  # fmt: skip
    (only,) = terrain.own_failures(rows, "paper").values()
    assert [(case.system, case.world) for case in only] == [("lidar", 1)]


def test_worlds_are_sorted_into_strata():
    described = {
        "vegetation_height": 0.5, "slope_deg": 9.0, "sky": "dusk", "misleading_ground": True, "cameras": 2,
        "field_of_view_deg": [60.0, 120.0], "robot": "marv", "camera_height": [0.4, 1.0],
        "distortion_model": ["plumb_bob", "equidistant"],
    }  # fmt: skip
    found = terrain.strata(described)
    assert found["camera height"] == "0.5 to 1 m" and found["lens"] == "fisheye"
    bare = described | {"field_of_view_deg": [], "camera_height": [], "distortion_model": []}
    assert {terrain.strata(bare)[name] for name in ("camera height", "lens", "field of view")} == {"none"}
    assert found["vegetation height"] == "0.4 to 0.8 m" and found["slope"] == "8 ° or more"
    assert found["field of view"] == "75° or more" and found["ground misleads"] == "yes"


def test_the_bound_reads_true_heights_in_the_terrain_frame():
    columns = np.mgrid[:201, :201][1]
    labels = {
        "support_height": (0.1 * (0.1 * columns - 10.0)).astype(np.float32),
        "visible_height": (0.1 * (0.1 * columns - 10.0) + 0.3).astype(np.float32),
        "origin": np.array([-10.0, -10.0]), "resolution": np.array(0.1),
    }  # fmt: skip
    robot = load_robot("husky")
    source = terrain.TrueSupport(robot, labels, Grid.square(), TerrainDefaults())
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    motion = MotionState(0, np.array([2.0, 1.0, 0.5]), turned, np.zeros(3), np.zeros(3))
    found = source.terrain(None, motion)
    # Five metres to the right of a robot that faces along y are at x = 7 m, where the ground is at 0.7 m.
    row, column = np.argmin(np.abs(np.asarray(found.grid.y) + 5.0)), np.argmin(np.abs(np.asarray(found.grid.x)))
    expected = 0.1 * (2.0 - float(np.asarray(found.grid.y)[row])) - motion.odometry_from_terrain[2, 3]
    assert float(found.height[row, column]) == pytest.approx(expected, abs=1e-3)
    assert float(found.geometric_height[row, column]) == pytest.approx(expected + 0.3, abs=1e-3)
    # Under the robot it passes through the ground on which its wheels stand, as every other source's does.
    support = support_points(robot, motion, TerrainDefaults().stiffness)
    rows, columns, _ = found.grid.cells(support[:, :2])
    under = found.height.numpy()[rows, columns]
    assert (
        np.median(np.abs(under - support[:, 2]))
        < 0.01
        < abs(support[:, 2].mean() - (0.2 - motion.odometry_from_terrain[2, 3]))
    )


def test_physics_differ_by_the_drag_of_vegetation():
    robot = load_robot("tradr")
    assert terrain.with_physics(robot, "paper").effects == ()
    assert [name for name, _ in terrain.with_physics(robot, "vegetation drag").effects] == ["vegetation_drag"]


def test_wrong_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match="expected SYSTEM=FILE with one of shipped, shipped_lidar"):
        terrain.parse_checkpoints(["best=x"])
    assert list(terrain.parse_checkpoints([])) == ["shipped", "shipped_lidar", "shipped_both"]
    command = [sys.executable, "benchmarks/terrain.py", "--out", str(tmp_path), "--seed", "420000"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 1 and "are for training" in done.stderr and "Traceback" not in done.stderr


def test_a_stop_is_found_where_it_is_predicted_near_its_place():
    def scene(kind, driven):
        return wall.Scene(SimpleNamespace(kind=kind), None, None, driven)

    scenes = [scene("wall", 2.0), scene("wall", 6.3), scene("post", 3.0), scene("vegetation", 6.3)]
    row = wall.counted("x", scenes, np.array([[1.8, 6.4, 6.4, 3.0]]))
    assert (row["stops"], row["precision"][0], row["recall"][0]) == (2, 0.5, 0.5)
    assert row["stop_error_m"] == pytest.approx(-0.2)
    assert row["vegetation"] == [0.0, 1.0, 0, 1] and row["wall"] == [1.0, 1.0, 1, 2]
    # Of two training seeds the other stops 3 m behind the wall: no wall was found, but a stop was predicted.
    row = wall.counted("x", scenes, np.array([[1.8, 6.4, 6.4, 3.0], [5.0, 6.4, 6.4, 6.4]]))
    assert row["recall"][0] == 0.25 and row["recall_anywhere"][0] == 0.5 and row["precision"][0] == pytest.approx(1 / 3)
    assert row["recall"][1] < 0.25 < row["recall"][2]
    assert "| x | 0.33 (" in wall.table([row]) and "| 0.5 of 1 found |" in wall.table([row])
    assert wall.counted("x", scenes, np.full((1, 4), 6.4))["precision"] is None
