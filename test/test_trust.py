"""Trust: predictions are compared with the ground found later, and a harmful encoder is not used."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CameraModel, MotionState, MotionTrack
from monoforce_ros.encoder import EncoderConfig, new_encoder
from monoforce_ros.perception import (
    DrivenGround,
    EncoderTerrain,
    FlatTerrain,
    Observation,
    TerrainTrust,
    TrustedTerrain,
    support_points,
    traced_ground,
)
from monoforce_ros.perception.ground_alignment import lowest_points
from monoforce_ros.perception.trust_blocks import telling_blocks
from monoforce_ros.perception.trusted_terrain import blended
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

GRID = Grid.square(12.8, 0.2)
WHEELS = np.array([[0.3, 0.3], [0.3, -0.3], [-0.3, 0.3], [-0.3, -0.3]])


def hill(x):
    """A ridge across the path [m]."""
    return 0.3 * np.sin(0.8 * x)


def at(x, z=0.0, stamp=None):
    stamp = int(1e9 * x) if stamp is None else stamp
    return MotionState(stamp, np.array([x, 0.0, z]), np.eye(3), np.array([1.0, 0, 0]), np.zeros(3))


def drive(trust, said, *, length=8.0, step=0.1, start_error=0.0, spread=None):
    """Reports along a drive over the hill; ``said(ahead, x)`` is the predicted height ``ahead`` metres away."""
    reports = []
    for x in np.arange(0.0, length, step):
        height = said(np.broadcast_to(GRID.x, (GRID.rows, GRID.columns)), x)
        terrain = TerrainMap.from_height(torch.from_numpy(height.astype(np.float32)), GRID)
        if spread is not None:
            terrain = replace(terrain, geometric_spread=torch.full_like(terrain.height, spread))
        support = np.column_stack([WHEELS, hill(x + WHEELS[:, 0]) - hill(x)])
        motion = at(x, hill(x))
        reports.append(trust.update(motion, support, terrain, {"front": 0.0, "rear": np.pi}, start_error))
    return reports


def test_a_true_map_is_trusted_and_its_error_is_small():
    report = drive(TerrainTrust(GRID), lambda ahead, x: hill(ahead + x) - hill(x))[-1]
    assert report.trusted and report.error < 0.03 < report.level_error and report.share > 0.8
    assert set(report.by_distance) == {"0.8 to 2 m", "2 to 3.5 m", "3.5 to 5 m"}
    assert "level ground by" in report.explanation


def test_a_slow_robot_compares_as_much_as_a_fast_one():
    # 8 mm between two maps: 0.08 m/s at ten maps a second.
    report = drive(TerrainTrust(GRID), lambda ahead, x: hill(ahead + x) - hill(x), step=0.008)[-1]
    assert report.travelled > 5.0 and report.share > 0.8


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_ground_without_friction_or_damping_is_blended(share):
    height = torch.zeros(GRID.rows, GRID.columns)
    slippery = TerrainMap.from_height(height, GRID, material=TerrainDefaults(damping=0.0, friction=0.0))
    found = blended(slippery, TerrainMap.from_height(height, GRID), share)
    assert bool(torch.isfinite(found.friction).all()) and bool(torch.isfinite(found.damping).all())
    assert float(found.friction[0, 0]) == pytest.approx({0.0: 0.0, 0.5: 9e-4, 1.0: 0.8}[share], abs=1e-4)


def test_holes_that_are_not_there_are_noticed_within_metres_and_named():
    reports = drive(TerrainTrust(GRID), lambda ahead, x: np.where(np.abs(ahead) > 0.7, -0.7, 0.0))
    first = next(i for i, report in enumerate(reports) if not report.trusted)
    assert 0.1 * first < 4.0
    assert not reports[-1].trusted and reports[-1].error > reports[-1].level_error
    assert (
        reports[-1].by_camera == {"front": (reports[-1].by_camera["front"])} and reports[-1].by_camera["front"][0] > 0.5
    )
    assert reports[-1].worst_camera == "front" and "worst from front: adapt the encoder" in reports[-1].explanation


def test_an_encoder_as_good_as_level_ground_is_not_refused_by_chance():
    random = np.random.default_rng(5)
    refused = 0
    for _ in range(20):
        bias = random.normal(0.0, 0.02, 200)
        reports = drive(TerrainTrust(GRID), lambda ahead, x, bias=bias: 0.0 * ahead + bias[round(10 * x)], step=0.25)
        refused += any(not report.trusted for report in reports)
    # Twelve tests along each drive, each with an error rate of 1 %, on differences around zero.
    assert refused <= 2


def test_the_share_is_earned_and_small_for_what_says_nothing_of_the_ground():
    reports = drive(TerrainTrust(GRID), lambda ahead, x: hill(ahead + x) - hill(x))
    assert reports[0].share == 0.0
    assert next(i for i, report in enumerate(reports) if report.share > 0.6) < 45
    shares = []
    for seed in range(10):
        phase = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, 2)
        wrong = drive(TerrainTrust(GRID), lambda ahead, x, p=phase: 0.2 * np.sin(1.3 * (ahead + x) + p[0]) * ahead / 3)
        shares += [report.share for report in wrong[20:]]
    assert np.mean(shares) < 0.2


def test_what_a_sweep_says_is_used_until_the_ground_says_otherwise():
    def shares(said):
        return np.array([report.share for report in drive(TerrainTrust(GRID, expected=1.0), said)])

    right = shares(lambda ahead, x: hill(ahead + x) - hill(x))
    assert right[0] == 1.0 and right.min() > 0.9
    # Where it says what the fallback says, nothing speaks against it.
    level = [
        trust.update(at(x), np.column_stack([WHEELS, np.zeros(4)]), TerrainMap.flat(GRID), {}, 0.0).share
        for trust in [TerrainTrust(GRID, expected=1.0)]
        for x in np.arange(0.0, 8.0, 0.1)
    ]
    assert min(level) == 1.0
    # Holes that are not there, too shallow to be refused at once.
    wrong = shares(lambda ahead, x: hill(ahead + x) - hill(x) - np.where(np.abs(ahead) > 0.7, 0.25, 0.0))
    assert wrong[0] == 1.0 and wrong[-1] < 0.6
    half = shares(lambda ahead, x: 2.0 * (hill(ahead + x) - hill(x)))
    assert half[0] == 1.0 and (0.4 < half[-1] < 0.7 or half[-1] == 0.0)


def share_over_a_bump(expected, found, length, *, place=4.0, wheels=WHEELS):
    """Share after level ground, of which prediction and fallback say the same, and one place where they differ.

    The prediction there is a bump of 10 cm, the ground found one of ``found`` metres.
    """
    trust = TerrainTrust(GRID, expected)

    def bump(x, height):
        return np.where((x > place) & (x < place + length), height, 0.0)

    for x in np.arange(0.0, 8.0, 0.1):
        height = bump(np.broadcast_to(GRID.x, (GRID.rows, GRID.columns)) + x, 0.1)
        terrain = TerrainMap.from_height(torch.from_numpy(height.astype(np.float32)), GRID)
        support = np.column_stack([wheels, bump(x + wheels[:, 0], found)])
        report = trust.update(at(x), support, terrain, {}, 0.0, TerrainMap.flat(GRID))
    return report.share


def test_one_place_alone_says_nothing_against_a_sweep():
    assert share_over_a_bump(1.0, 0.0, 0.2) == 1.0
    assert share_over_a_bump(1.0, 0.0, 2.5) < 0.5


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.parametrize("place", [4.0, 4.1, 4.2, 4.3, 4.4])
def test_one_place_alone_earns_images_nothing(place, scale):
    """Level ground, of which they say what the fallback says, confirms nothing, nor does a wheel that follows."""
    wheels = scale * WHEELS
    assert share_over_a_bump(0.0, 0.1, 0.4, place=place, wheels=wheels) == 0.0
    assert share_over_a_bump(0.0, 0.1, 2.5, place=place, wheels=wheels) > 0.6


def test_a_place_where_images_were_wrong_is_not_left_out():
    """One that differs far more than the others: it neither earns trust nor gives it back."""

    def shares(wrong):
        trust = TerrainTrust(GRID)

        def ground(x):
            return np.where((x > 4.0) & (x < 6.0), 0.05, 0.0)

        for x in np.arange(0.0, 9.0, 0.1):
            ahead = np.broadcast_to(GRID.x, (GRID.rows, GRID.columns)) + x
            height = ground(ahead) + np.where((ahead > 7.0) & (ahead < 7.5), wrong, 0.0)
            terrain = TerrainMap.from_height(torch.from_numpy(height.astype(np.float32)), GRID)
            support = np.column_stack([WHEELS, ground(x + WHEELS[:, 0])])
            report = trust.update(at(x), support, terrain, {}, 0.0, TerrainMap.flat(GRID))
        return report.share

    assert shares(0.0) > 0.5 and shares(0.5) < 0.1


def test_a_block_that_is_far_more_wrong_does_not_give_trust_back():
    """It would outweigh all others, and one place alone says nothing: the others decide as they did before."""
    squares = np.array([0.01, 0.01, 0.01])
    assert telling_blocks(squares).tolist() == [1.0, 1.0, 1.0]
    assert telling_blocks(np.append(squares, 0.02)).tolist() == [1.0] * 4
    for further in (0.09, 0.25, 4.0):
        assert telling_blocks(np.append(squares, further)).tolist() == [1.0, 1.0, 1.0, 0.0]
    assert telling_blocks(np.array([0.0] * 12 + [0.25, 0.01])) is None


def test_half_of_the_ground_is_used_by_half():
    report = drive(TerrainTrust(GRID), lambda ahead, x: 2.0 * (hill(ahead + x) - hill(x)))[-1]
    assert 0.35 < report.share < 0.6 or not report.trusted


def test_spreads_that_are_too_small_are_widened_by_what_the_ground_shows():
    errors = np.random.default_rng(3).laplace(0.0, 0.1, 200)

    def factors(spread):
        said = lambda ahead, x: hill(ahead + x) - hill(x) + errors[round(10 * x)]  # noqa: E731
        return [report.spread_factor for report in drive(TerrainTrust(GRID), said, spread=spread)]

    assert factors(0.1)[0] == 1.0 and factors(0.1)[-1] < 1.6
    assert 1.8 < factors(0.033)[-1] < 4.0
    # Where it drives errors are smaller than elsewhere: spreads that are too large stay.
    assert factors(0.5)[-1] == 1.0 and factors(None)[-1] == 1.0


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8, 1.0])
@pytest.mark.parametrize("bump", [0.0, 0.1, 0.6])
def test_bands_of_what_is_used_hold_what_those_of_the_prediction_hold(share, bump):
    """Of surfaces that are distributed as the encoder says, 90 % lie in the band about what is used of it."""
    random = np.random.default_rng(7)
    flat = TerrainMap.flat(GRID)
    predicted = replace(
        flat,
        height=flat.height + 0.75 * bump,
        geometric_height=flat.height + bump,
        geometric_spread=torch.full_like(flat.height, 0.1),
        decrease_spread=torch.full_like(flat.height, 0.02),
    )
    used = blended(flat, predicted, share)
    surface = predicted.geometric_height.numpy() + random.laplace(0.0, 0.1, flat.height.shape)
    depth = 0.25 * bump + random.laplace(0.0, 0.02, flat.height.shape)
    for actual, height, spread in (
        (surface, used.geometric_height, used.geometric_spread),
        (depth, used.geometric_height - used.height, used.decrease_spread),
    ):
        inside = np.abs(actual - height.numpy()) < np.log(10.0) * spread.numpy()
        assert inside.mean() == pytest.approx(0.9, abs=0.015)
    wider = blended(flat, predicted, share, spread_factor=3.0)
    assert (wider.geometric_spread > used.geometric_spread).all() and torch.equal(wider.height, used.height)


def test_a_fallback_s_own_spread_counts_and_maps_without_any_tell_none():
    flat = TerrainMap.flat(GRID)
    predicted = replace(flat, height=flat.height + 0.3, geometric_spread=torch.full_like(flat.height, 0.1))
    measured = replace(flat, geometric_spread=torch.full_like(flat.height, 0.02))
    assert float(blended(measured, predicted, 0.0, 2.0).geometric_spread.mean()) == pytest.approx(0.02)
    assert float(blended(measured, predicted, 0.5).geometric_spread.mean()) == pytest.approx(0.06)
    assert float(blended(measured, predicted, 1.0, 2.0).geometric_spread.mean()) == pytest.approx(0.2)
    assert blended(flat, flat, 0.0).spreads == () and blended(measured, flat, 0.5).spreads == ()
    assert blended(measured, flat, 0.0).spreads == ("geometric_spread",)


def test_trust_returns_when_predictions_become_right_again():
    trust = TerrainTrust(GRID)
    wrong = drive(trust, lambda ahead, x: np.full(ahead.shape, -0.7))
    assert not wrong[-1].trusted
    # Later on the same drive, without a jump of the odometry.
    reports = []
    for x in np.arange(8.0, 24.0, 0.1):
        height = hill(np.broadcast_to(GRID.x, (GRID.rows, GRID.columns)) + x) - hill(x)
        terrain = TerrainMap.from_height(torch.from_numpy(height.astype(np.float32)), GRID)
        support = np.column_stack([WHEELS, hill(x + WHEELS[:, 0]) - hill(x)])
        reports.append(trust.update(at(x, hill(x)), support, terrain, {}, 0.0))
    assert reports[-1].trusted


def test_ground_under_the_wheels_that_is_off_is_refused_at_once():
    report = drive(TerrainTrust(GRID), lambda ahead, x: 0.0 * ahead, length=0.3, start_error=0.4)[0]
    assert not report.trusted and "under the wheels is off by 40 cm, expected at most 15 cm" in report.explanation
    assert not drive(TerrainTrust(GRID), lambda ahead, x: 0.0 * ahead, length=0.3, start_error=float("nan"))[0].trusted


def test_an_odometry_jump_starts_over():
    trust = TerrainTrust(GRID)
    assert not drive(trust, lambda ahead, x: np.full(ahead.shape, -0.7))[-1].trusted
    flat = TerrainMap.flat(GRID)
    report = trust.update(at(500.0, stamp=int(9e9)), np.column_stack([WHEELS, np.zeros(4)]), flat, {}, 0.0)
    assert report.trusted and np.isnan(report.error) and "nothing compared yet" in report.explanation


@pytest.fixture(scope="module")
def robot():
    return load_robot("husky")


def test_the_fallback_replaces_the_maps_of_a_harmful_encoder(robot):
    config = EncoderConfig(sensor="camera_lidar", image_width=64, image_height=48, resolution=0.2, edges=False)
    encoder = new_encoder(config).eval()
    source = EncoderTerrain(encoder, robot, ("lidar", "camera"))
    material = TerrainDefaults()
    trusted = TrustedTerrain(source, source, [FlatTerrain(robot, config.grid, material)])
    cloud = np.random.default_rng(1).uniform([1.0, -4.0, -0.14], [5.0, 4.0, -0.12], (4000, 3))
    maps = []
    for x in np.arange(0.0, 8.0, 0.1):
        # The encoder goes wrong far away: its ground under the wheels stays right.
        with torch.no_grad():
            encoder.heads.bias[0] = 0.1 if x > 1.0 else 0.0
            # It no longer believes what is measured, or interpolated between.
            encoder.heads.bias[[7, 9]] = -3.0 if x > 1.0 else 3.0
        maps.append(trusted.terrain(Observation(int(1e9 * x), cloud=cloud), at(x)))
    assert trusted.report is not None and not trusted.report.trusted
    assert all(entry.spreads == ("geometric_spread", "decrease_spread") for entry in maps)
    # What is not trusted says little of level ground, which the wheels found to be right.
    assert trusted.report.fallback_error < 0.01
    flat = FlatTerrain(robot, config.grid, material).terrain(Observation(0), at(0.0))
    implied = blended(flat, trusted.predicted, 0.0)
    assert float(maps[-1].height_spread.median()) < 0.5 * float(implied.height_spread.median())
    assert torch.equal(maps[-1].height, flat.height) and torch.equal(maps[0].height, flat.height)
    # Right again: the encoder is used again.
    with torch.no_grad():
        encoder.heads.bias[:2] = torch.tensor([0.0, -3.0])
        encoder.heads.bias[[7, 9]] = 3.0
    for x in np.arange(8.0, 24.0, 0.1):
        trusted.terrain(Observation(int(1e9 * x), cloud=cloud), at(x))
    assert trusted.report.trusted


@pytest.fixture(scope="module")
def believing():
    """An untrained encoder of both sensors that believes what a sweep measured and says nothing of pictures."""
    config = EncoderConfig(sensor="camera_lidar", image_width=64, image_height=48, resolution=0.2, edges=False)
    encoder = new_encoder(config).eval()
    with torch.no_grad():
        encoder.heads.weight.zero_()
        encoder.heads.bias.zero_()
        encoder.heads.bias[1] = -3.0
        encoder.heads.bias[[7, 9]] = 3.0
    return encoder


CAMERA = CameraModel(64, 48, np.array([[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]]), np.zeros(5))
FORWARD = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])


def seen(x, *, lidar=True, camera=True):
    """What the sensors of a robot on the hill see: a sweep of the ground around it, a grey picture."""
    random = np.random.default_rng(1)
    place = random.uniform(-6.0, 6.0, (6000, 2))
    cloud = np.column_stack([place, hill(x + place[:, 0]) - hill(x) - 0.1323]).astype(np.float32)
    names = ["front"] if camera else []
    return Observation(
        int(1e9 * x),
        cloud=cloud if lidar else None,
        images={name: np.full((48, 64, 3), 90, np.uint8) for name in names},
        cameras=dict.fromkeys(names, CAMERA),
        base_from_cameras=dict.fromkeys(names, FORWARD),
    )


def test_a_share_is_that_of_the_sensors_that_there_are(robot, believing):
    source = EncoderTerrain(believing, robot, ("lidar", "camera"))
    trusted = TrustedTerrain(source, source, [FlatTerrain(robot, believing.config.grid, TerrainDefaults())])
    for x in np.arange(0.0, 6.0, 0.1):
        trusted.terrain(seen(x), at(x, hill(x)))
    earned = trusted.report.share
    own, level = trusted.report.by_lidar
    # Cells of 20 cm on the sides of the hill.
    assert own < 0.05 < 0.1 < level
    assert earned > 0.5 and trusted.report.sensors == ("lidar", "camera")
    # The lidar dies: nothing has confirmed what pictures alone say.
    terrain = trusted.terrain(seen(6.0, lidar=False), at(6.0, hill(6.0)))
    assert trusted.report.share == 0.0 and trusted.report.sensors == ("camera",)
    assert "images alone" in trusted.report.explanation and float(terrain.height.std()) < 1e-6
    for x in np.arange(6.1, 10.0, 0.1):
        trusted.terrain(seen(x, lidar=False), at(x, hill(x)))
    alone = trusted.report
    assert alone.share < 0.2 and alone.error > 0.1 and alone.by_lidar is None
    # It is back: so is what both had earned, and ground found meanwhile counts, too.
    trusted.terrain(seen(10.0), at(10.0, hill(10.0)))
    assert trusted.report.share > 0.5 and trusted.report.sensors == ("lidar", "camera")
    # What images alone had said is compared with what the lidar measures of it now.
    trusted.terrain(seen(10.05, lidar=False), at(10.05, hill(10.05)))
    assert trusted.report.by_lidar[0] > 0.1
    trusted.terrain(seen(10.1, camera=False), at(10.1, hill(10.1)))
    assert trusted.report.share == 0.0 and "sweep alone" in trusted.report.explanation
    # A covered lidar is none.
    covered = replace(seen(10.2), cloud=seen(10.2).cloud[:5])
    trusted.terrain(covered, at(10.2, hill(10.2)))
    assert trusted.report.sensors == ("camera",) and trusted.report.share < 0.2
    # An odometry jump ends all of it.
    trusted.terrain(seen(500.0, lidar=False), at(500.0, hill(500.0), stamp=int(11e9)))
    trusted.terrain(seen(500.1), at(500.1, hill(500.1), stamp=int(11.1e9)))
    assert trusted.report.share == 0.0 and np.isnan(trusted.report.error)


def test_driven_ground_moves_with_the_robot_and_ends_after_six_metres(robot):
    driven = DrivenGround(robot, 2e6)
    for i, angle in enumerate(np.linspace(0.0, 1.0, 101)):
        turn = Rotation.from_euler("z", angle).as_matrix()
        position = np.array([10.0 * np.sin(angle), 10.0 * (1 - np.cos(angle)), 0.2 * angle])
        motion = MotionState(int(1e8 * i), position, turn, np.array([1.0, 0, 0]), np.array([0, 0, 0.1]))
        points = driven.update(motion)
    distance = np.hypot(points[:, 0], points[:, 1])
    assert 5.0 < distance.max() < 6.8 and points[distance < 1.0].shape[0] > 0
    # The path rose by 2 cm per metre.
    away = points[distance > 5.0]
    assert np.median(away[:, 2]) == pytest.approx(-0.13 - 0.02 * np.median(np.hypot(away[:, 0], away[:, 1])), abs=0.03)
    assert not len(driven.update(at(500.0, stamp=int(2e10))))


@pytest.mark.parametrize("name", ["husky", "jackal", "warthog", "tradr", "marv", "rally_car", "offroad_car"])
def test_where_a_robot_tips_over_its_wheels_are_on_no_ground(name):
    robot = load_robot(name)
    driven, poses = DrivenGround(robot, 2e6), []
    for i in range(31):
        # On a slope of 20°, tipped over on its way, and on its wheels again.
        turn = Rotation.from_euler("xy", [80.0 if 10 <= i < 20 else 20.0, -10.0], degrees=True).as_matrix()
        motion = MotionState(int(1e8 * i), np.array([0.11 * i, 0.0, 0.0]), turn, np.array([1.1, 0, 0]), np.zeros(3))
        points = driven.update(motion)
        poses.append(np.eye(4))
        poses[-1][:3, :3], poses[-1][:3, 3] = turn, motion.position
    lowest = len(lowest_points(robot))
    assert len(points) / lowest == pytest.approx(20, abs=1)
    assert len(traced_ground(robot, np.array(poses), 0.1)) / lowest == pytest.approx(20, abs=1)


def test_driven_ground_follows_the_track_between_two_maps_and_never_looks_ahead(robot):
    along = np.arange(0.0, 8.0, 0.02)
    track = MotionTrack(
        (along * 1e9).astype(np.int64), np.stack([along, 0 * along, 0.1 * along], axis=1),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(along), 1)), np.tile([1.0, 0.0, 0.1], (len(along), 1)),
        np.zeros((len(along), 3)),
    )  # fmt: skip

    def driven_by(stamps: list[float]) -> np.ndarray:
        driven = DrivenGround(robot, 2e6)
        for stamp in stamps:
            points = driven.update(track.at(int(stamp * 1e9)), track)
        return points

    once = driven_by([4.01])
    # Asked before or not, and of later times, too.
    assert np.array_equal(once, driven_by([1.0, 3.333, 4.01])) and np.array_equal(once, driven_by([7.0, 4.01]))
    middle = np.array([points.mean(axis=0) for points in once.reshape(-1, len(support_points(robot, at(0.0), 2e6)), 3)])
    assert np.allclose(np.diff(middle[:, 0]), 0.1, atol=0.021) and middle[0, 0] == pytest.approx(-4.01, abs=0.05)
    assert -0.15 < middle[-1, 0] < -0.05
    # Without a track it knows where it was asked alone.
    sparse = DrivenGround(robot, 2e6)
    sparse.update(track.at(0))
    assert len(sparse.update(track.at(int(4.01e9)))) < len(once) / 10


def test_an_encoder_without_a_sensor_says_so(robot):
    encoder = new_encoder(EncoderConfig(image_width=64, image_height=48, resolution=0.4))
    with pytest.raises(ValueError, match="terrain from lidar: the encoder takes camera"):
        EncoderTerrain(encoder, robot, ("lidar",))
    with pytest.raises(ValueError, match="needs an image, and the observation has none"):
        EncoderTerrain(encoder, robot).terrain(Observation(0), at(0.0))
