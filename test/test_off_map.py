"""Where a robot drives beyond the edge of its map nothing is compared: there the map says nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy import commissioning
from monoforce_ros.discrepancy.areas import reach_of
from monoforce_ros.discrepancy.comparable_windows import comparable_windows
from monoforce_ros.discrepancy.diagnosis import diagnose
from monoforce_ros.discrepancy.evidence import COMPONENTS, Evidence
from monoforce_ros.discrepancy.explanation import DiagnosisSettings
from monoforce_ros.discrepancy.held_out_bags import HeldOutBag
from monoforce_ros.discrepancy.step_errors import compare_after_steps
from monoforce_ros.discrepancy.terrain_evidence import off_map_stretches
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")
SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])


def hilly(grid: Grid) -> TerrainMap:
    """Hills of 15 cm every 4 m."""
    x, y = (torch.from_numpy(values).float() for values in np.meshgrid(grid.x, grid.y))
    return TerrainMap.from_height(0.15 * torch.sin(1.6 * x) * torch.cos(1.5 * y), grid)


def recording(known: TerrainMap, seconds: int = 60) -> Evidence:
    """A healthy Husky that leaves a map of 24 m for the last third of its drive, and does not come back."""
    random = np.random.default_rng(3)
    count = seconds * 100
    twists = np.repeat(random.uniform([0.2, -0.6], [0.7, 0.6], (seconds // 2, 2)), 200, axis=0)
    twists[2 * count // 3 :, 1] *= 0.5
    twists[2 * count // 3 :, 0] = 0.8
    robot = load_robot("husky")
    speeds = drive_speeds(robot, torch.as_tensor(twists[None], dtype=torch.float32), 0.01)
    result = rollout(hilly(Grid.square(100.0, 0.1)), robot, speeds, State.at_rest(0.14), with_forces=False)
    motion = recorded(result, 10**9)
    noisy = motion.positions + random.normal(0.0, 0.002, motion.positions.shape)
    smoothed = SmoothedMotion(replace(motion, positions=noisy), 0.002, 0.001, (slice(0, len(motion)),))
    commands = CommandTrack(10**9 + np.arange(count) * 10_000_000, twists)
    return Evidence(smoothed, commands, known, np.eye(4), components=COMPONENTS)


def evidence_on(size: float) -> Evidence:
    """The drive on a map of a size [m]."""
    return recording(hilly(Grid.square(size, 0.1)))


def edge_of(evidence: Evidence, share: float) -> Grid:
    """Cells under the first ``share`` of a drive."""
    path = evidence.smoothed.motion.positions[: int(share * len(evidence.smoothed.motion)), :2]
    low, high = path.min(axis=0) - 1.0, path.max(axis=0) + 1.0
    columns, rows = np.ceil((high - low) / 0.1).astype(int)
    return Grid(int(rows), int(columns), 0.1, (float(low[0]), float(low[1])))


def test_stretches_off_the_map_are_found_in_the_frame_of_the_map():
    husky, evidence = load_robot("husky"), recording(hilly(Grid.square(24.0, 0.1)))
    assert len(off_map_stretches(replace(evidence, terrain=None), husky)) == 0
    everything = replace(evidence, terrain=hilly(Grid.square(100.0, 0.1)))
    assert len(off_map_stretches(everything, husky)) == 0
    grid = edge_of(evidence, 0.6)
    motion = evidence.smoothed.motion
    # The map in a frame that is turned and shifted against the odometry.
    pose = np.eye(4)
    pose[:3, :3], pose[:2, 3] = Rotation.from_euler("z", 0.7).as_matrix(), (3.0, -2.0)
    for turned in (np.eye(4), pose):
        in_map = (motion.positions - turned[:3, 3]) @ turned[:3, :3]
        left, right, bottom, top = np.array(grid.extent)
        reach = reach_of(husky)
        on = (in_map[:, 0] > left + reach) & (in_map[:, 0] < right - reach)
        on &= (in_map[:, 1] > bottom + reach) & (in_map[:, 1] < top - reach)
        cut = replace(evidence, terrain=hilly(grid), odometry_from_terrain=turned)
        found = off_map_stretches(cut, husky)
        inside = ((motion.stamps[:, None] > found[:, 0]) & (motion.stamps[:, None] < found[:, 1])).any(axis=1)
        np.testing.assert_array_equal(inside[1:-1], ~on[1:-1])
        assert inside.any()


def test_a_healthy_robot_that_leaves_its_map_is_healthy_and_the_page_says_what_was_left_out():
    husky, evidence = load_robot("husky"), recording(hilly(Grid.square(24.0, 0.1)))
    cut = replace(evidence, terrain=hilly(edge_of(evidence, 0.7)))
    found = diagnose(cut, husky, settings=DiagnosisSettings(horizon=2.0, samples=tuple(SAMPLES)))
    assert found.verdict == Verdict.NO_DISCREPANCY
    (remark,) = (text for text in found.remarks if "edge of the map" in text)
    assert "give a larger map (--terrain)" in remark
    assert off_map_stretches(cut, husky).shape == (1, 2)
    end = (off_map_stretches(cut, husky)[0, 0] - 10**9) * 1e-9
    assert found.details.paths and all(path.start + 5.0 < end + 0.2 for path in found.details.paths)
    # Neither do errors hold what cannot be compared, at any horizon.
    whole = diagnose(evidence_on(100.0), husky, settings=DiagnosisSettings(horizon=2.0, samples=tuple(SAMPLES)))
    for metric in ("position_1s", "position_2s", "position_5s"):
        assert found.gap[metric].before < 1.5 * whole.gap[metric].before + 0.002


def test_the_time_off_the_map_holds_no_gap_of_the_poses():
    husky, evidence = load_robot("husky"), evidence_on(100.0)
    smoothed = evidence.smoothed
    cut = replace(evidence, terrain=hilly(edge_of(evidence, 0.7)))
    (whole,) = off_map_stretches(cut, husky)
    # Somewhere within that time the poses pause for 300 s.
    middle = int(np.searchsorted(smoothed.motion.stamps, whole.mean()))
    count = len(smoothed.motion)
    late = (np.arange(count) >= middle) * 300 * 10**9
    paused = replace(
        smoothed,
        motion=replace(smoothed.motion, stamps=smoothed.motion.stamps + late),
        stretches=(slice(0, middle), slice(middle, count)),
    )
    found = off_map_stretches(replace(cut, smoothed=paused), husky)
    assert len(found) == 2
    # But for the time between the two poses beside the pause.
    between = smoothed.motion.stamps[middle] - smoothed.motion.stamps[middle - 1]
    assert np.diff(found, axis=1).sum() == whole[1] - whole[0] - between


def test_what_lies_beyond_the_map_is_not_commissioned():
    husky, evidence = load_robot("husky"), recording(hilly(Grid.square(24.0, 0.1)))
    cut = replace(evidence, terrain=hilly(edge_of(evidence, 0.7)))
    off = off_map_stretches(cut, husky)
    prepared = commissioning._prepare(cut, husky, SAMPLES, 1.0)
    starts = prepared.data.starts
    assert len(starts) > 20 and not ((starts + 2 * 10**9 > off[-1, 0]) & (starts < off[-1, 1])).any()
    windows = comparable_windows(cut, husky, DiagnosisSettings())
    assert set(windows.starts) <= set(starts)


def test_errors_on_other_recordings_and_after_steps_do_not_hold_what_lies_beyond_the_map():
    husky, evidence = load_robot("husky"), evidence_on(100.0)
    cut = replace(evidence, terrain=hilly(edge_of(evidence, 0.7)))
    on, beyond = (HeldOutBag.of(entry, husky, None).table(()) for entry in (evidence, cut))
    assert beyond["position_2s"].before < 1.5 * on["position_2s"].before + 0.002
    steps = [compare_after_steps(entry, husky, ()) for entry in (evidence, cut)]
    assert steps[1].windows < steps[0].windows
    with pytest.raises(ValueError, match="and on its map"):
        HeldOutBag.of(replace(evidence, terrain=hilly(Grid(50, 50, 0.1, (200.0, 200.0)))), husky, None)


def test_a_drive_beside_its_map_is_not_diagnosed_and_the_page_says_why():
    husky, evidence = load_robot("husky"), recording(hilly(Grid.square(24.0, 0.1)))
    beside = replace(evidence, terrain=hilly(Grid(50, 50, 0.1, (200.0, 200.0))))
    found = diagnose(beside, husky)
    assert found.verdict == Verdict.NOT_IDENTIFIABLE
    assert any("edge of the map or beyond it" in text for text in found.advice)
