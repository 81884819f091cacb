"""Randomised worlds: drawn from their ranges, reproducible, physically consistent, and not to be learned by heart."""

import json
import math
import subprocess
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch
from conftest import ROOT

from monoforce_ros.bags import Recording
from monoforce_ros.core import CameraModel
from monoforce_ros.synthetic import WorldSettings, build_model, draw_world
from monoforce_ros.synthetic.labels import GroundClass, labels_file, world_labels
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.recording import RecordingSettings, record, world_file
from monoforce_ros.synthetic.scenery import build_scenery
from monoforce_ros.synthetic.sensors import CameraSettings, LidarSettings
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.varied import distribution
from monoforce_ros.synthetic.varied.distribution import Chance, Choice, LogUniform, Uniform, Whole
from monoforce_ros.synthetic.varied.imaging import Imaging
from monoforce_ros.synthetic.varied.rig import draw_rig
from monoforce_ros.synthetic.varied.settings import ImagingSettings, RigSettings
from monoforce_ros.synthetic.varied.things import Builder
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import TIME_STEP

pytestmark = pytest.mark.usefixtures("one_thread")

NEAR = 3.0
"""Where blind predictions are judged: this close to the track [m]."""


@pytest.fixture(scope="module")
def worlds():
    """Sixteen worlds to learn from, and eight fresh ones."""
    return [draw_world(WorldSettings(), seed) for seed in range(7000, 7024)]


def narrowed(**assignments):
    return WorldSettings().narrowed({name.replace("__", "."): value for name, value in assignments.items()})


# ---------------------------------------------------------------------------------------------------- distributions


@pytest.mark.parametrize("drawn", [Uniform(2.0, 5.0), LogUniform(0.1, 10.0), Whole(1, 4), Chance(0.3)])
def test_draws_stay_within_bounds_and_reach_them(drawn):
    random = np.random.default_rng(0)
    values = np.array([drawn.draw(random) for _ in range(2000)], float)
    if isinstance(drawn, Chance):
        assert values.mean() == pytest.approx(0.3, abs=0.04)
        return
    assert values.min() >= drawn.low and values.max() <= drawn.high
    assert values.min() < drawn.low + 0.1 * (drawn.high - drawn.low)
    assert values.max() > drawn.high - 0.1 * (drawn.high - drawn.low)
    if isinstance(drawn, LogUniform):
        assert np.median(values) == pytest.approx(1.0, rel=0.2)


def test_a_narrowed_setting_leaves_the_other_draws_as_they_were():
    settings = WorldSettings().vegetation
    fixed = replace(settings, height=settings.height.narrowed("0.4"))
    first, second = (group.draw(np.random.default_rng(3)) for group in (settings, fixed))
    assert second.height == 0.4 != first.height
    assert {n: v for n, v in vars(first).items() if n != "height"} == {
        n: v for n, v in vars(second).items() if n != "height"
    }


def test_every_setting_can_be_fixed():
    for name, entry in WorldSettings().distributions().items():
        text = {Choice: lambda e: e.names[-1], Chance: lambda e: "true", Whole: lambda e: str(e.low)}.get(
            type(entry), lambda e: str(e.high)
        )(entry)
        fixed = WorldSettings().narrowed({name: text}).distributions()[name]
        values = {fixed.draw(np.random.default_rng(seed)) for seed in range(5)}
        assert len(values) == 1, name


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("vegetation.height", "7", r"vegetation.height: got '7', expected values within 0.1..1.2"),
        ("vegetation.size", "1", "got setting 'size', expected one of any, coverage"),
        ("weather.rain", "1", "got group 'weather', expected one of route, terrain"),
        ("ground.kind", "lava", "got 'lava', expected some of meadow"),
        ("rig.pitch", "down", "got 'down', expected a number"),
        ("terrain.banks", "1.5", "expected whole numbers"),
    ],
)
def test_a_wrong_setting_is_named(name, value, said):
    with pytest.raises(ValueError, match=said):
        WorldSettings().narrowed({name: value})


def test_distributions_refuse_reversed_bounds():
    with pytest.raises(ValueError, match="ascending"):
        Uniform(2.0, 1.0)
    with pytest.raises(ValueError, match="positive"):
        LogUniform(0.0, 1.0)
    assert distribution.Chance(1.0).draw(np.random.default_rng(0))


# ----------------------------------------------------------------------------------------------------------- worlds


def test_a_seed_gives_one_world_and_settings_do_not_disturb_each_other(worlds):
    again = draw_world(WorldSettings(), 7000)
    np.testing.assert_array_equal(again.scenery.ground.heights, worlds[0].scenery.ground.heights)
    np.testing.assert_array_equal(again.scenery.grass.canopy.heights, worlds[0].scenery.grass.canopy.heights)
    other_light = draw_world(narrowed(light__sky="dusk", obstacles__walls="0"), 7000)
    np.testing.assert_array_equal(other_light.scenery.grass.canopy.heights, again.scenery.grass.canopy.heights)
    np.testing.assert_array_equal(other_light.scenery.route.points, again.scenery.route.points)


def test_tracks_start_at_the_origin_along_x_and_differ(worlds):
    ends = []
    for world in worlds:
        route = world.scenery.route
        np.testing.assert_allclose(route.points[0], 0.0, atol=1e-6)
        assert abs(route.headings[0]) < 0.12
        assert np.ptp(route.points, axis=0).max() < 28.0
        ends.append(route.at(6.0)[0])
    # Six metres on, tracks have fanned out to both sides.
    assert np.ptp(np.array(ends)[:, 1]) > 4.0


def test_things_stand_on_the_ground_and_keep_clear_of_the_start(worlds):
    for world in worlds[:8]:
        for thing in world.scenery.obstacles:
            if thing.kind in ("plants", "bush"):
                continue
            vertices = np.concatenate([part.shape.vertices for part in thing.parts])
            ground = float(world.scenery.ground.height_at(thing.position))
            assert vertices[:, 2].min() < ground + 0.05, thing.kind
            assert vertices[:, 2].max() > ground, thing.kind
            assert np.linalg.norm(thing.position) > 1.0


def test_labels_hold_posts_and_soft_layers():
    world = draw_world(narrowed(ground__kind="snow", ground__misleading="false", ground__patches="0"), 7001)
    builder = Builder(world.scenery.ground, np.random.default_rng(0))
    post = builder.post(np.array([3.02, 1.03]), 0.9)
    scenery = replace(world.scenery, obstacles=(post,))
    labels = world_labels(scenery, np.zeros(3))
    cell = tuple(np.rint((post.position[::-1] - labels["origin"][::-1]) / labels["resolution"]).astype(int))
    assert labels["ground_class"][cell] == GroundClass.OBSTACLE
    assert labels["support_height"][cell] - scenery.ground.height_at(post.position) == pytest.approx(0.9, abs=0.02)
    snow = labels["visible_height"] - labels["support_height"]
    assert 0.02 < np.median(snow) < 0.26
    assert 0.2 <= labels["friction"].min() <= labels["friction"].max() <= 0.45


@pytest.mark.parametrize("is_firm", [False, True])
def test_firm_plants_stop_a_robot_and_soft_ones_of_the_same_look_do_not(is_firm):
    settings = narrowed(
        vegetation__any="true", vegetation__coverage="0.6", vegetation__height="0.8", vegetation__species="1",
        vegetation__firm=str(is_firm), vegetation__pattern="meadow", vegetation__extent="4.5", vegetation__drag="2",
        vegetation__viscous_drag="4", vegetation__bushes="0", vegetation__hidden_rocks="0", ground__kind="soil",
        ground__misleading="false", ground__patches="0", terrain__slope="0", terrain__hill_height="0.02",
        terrain__bumps="0.005", terrain__banks="0", terrain__ditches="0", terrain__steps="0", terrain__ramps="0",
        terrain__stairs="0", **{f"obstacles__{kind}": "0" for kind in (
            "boulders", "stones", "walls", "kerbs", "fences", "posts", "logs", "trees", "boxes", "vehicles")},
        obstacles__on_track="false", robot__kind="husky", terrain__rim="0",
    )  # fmt: skip
    for seed in range(7002, 7012):
        world = draw_world(settings, seed)
        x, y = world.scenery.ground.grid()
        deep = (world.scenery.grass.canopy.heights > 0.6) & (np.abs(y) < 0.4)
        if (deep & (x > 1.0) & (x < 3.5)).sum() > 100:
            break
    else:
        pytest.fail("no seed has vegetation ahead of the start")
    entry = float(x[deep & (x > 1.0)].min())
    robot = world.robot()
    simulation = Simulation(build_model(world.scenery, robot, seed, {}), world.scenery, robot)
    simulation.drive(0.8, 0.0)
    for _ in range(round(8.0 / TIME_STEP)):
        simulation.step()
    driven = float(np.linalg.norm(simulation.data.qpos[:2]))
    assert (driven < entry + 0.8) == is_firm, (driven, entry)


def test_obstacles_are_not_always_off_the_track():
    """Drivers meet some: training needs crashes as well as free roads."""
    distances = []
    for seed in range(7030, 7036):
        world = draw_world(narrowed(obstacles__on_track="true", obstacles__walls="7"), seed)
        tall = [t for t in world.scenery.obstacles if t.kind in ("wall", "box", "fence", "rock", "vehicle", "post")]
        for thing in tall:
            top = max(p.shape.vertices[:, 2].max() for p in thing.parts) - world.scenery.ground.height_at(
                thing.position
            )
            if top > 0.3:
                distances.append(float(world.scenery.route.distance(thing.position)))
    assert min(distances) < 0.8


def test_the_style_site_is_nearly_level_and_has_walls():
    rises = []
    for seed in range(4):
        world = draw_world(WorldSettings.of_style("site"), seed)
        assert sum(thing.kind == "wall" for thing in world.scenery.obstacles) >= 1
        points = world.scenery.route.points
        heights = world.scenery.ground.height_at(points)
        rises.append(float(np.abs(heights - heights.mean()).max()))
    assert np.median(rises) < 0.6


def test_the_style_textures_has_no_natural_surface():
    settings = WorldSettings.of_style("textures")
    world = draw_world(settings, 3)
    assert {area.look for area in world.scenery.appearance.areas.areas} == {"odd"}
    with pytest.raises(ValueError, match="style: got 'dreams', expected one of varied, textures, site"):
        WorldSettings.of_style("dreams")


# ------------------------------------------------------------------------------------------------------ memorability


def vegetation_near_track(world):
    """Vegetation on the world's grid around the start, and which cells are near the track ``[256, 256]``."""
    steps = (np.arange(256) - 127.5) * 0.1
    positions = np.stack(np.meshgrid(steps, steps), axis=-1)
    scenery = world.scenery
    return scenery.grass.height_at(positions) > 0.1, scenery.route.distance(positions) < NEAR


def blind_iou(found):
    """Pooled IoU of the mean map of two thirds of the worlds, at its best threshold there, on the last third."""
    count = 2 * len(found) // 3
    mean = np.mean([vegetation for vegetation, _ in found[:count]], axis=0)

    def iou(threshold, listed):
        pairs = [((mean > threshold) & near, vegetation & near) for vegetation, near in listed]
        both = sum((predicted & true).sum() for predicted, true in pairs)
        return both / max(sum((predicted | true).sum() for predicted, true in pairs), 1)

    best = max(np.linspace(0.0, 0.9, 19) - 1e-9, key=lambda threshold: iou(threshold, found[:count]))
    return iou(best, found[count:])


def test_a_map_that_saw_no_image_is_worth_nothing_in_a_fresh_world(worlds):
    found = [vegetation_near_track(world) for world in worlds]
    assert blind_iou(found) <= 0.15
    # The measure notices worlds that are alike: those of style nature have their grass in constant places.
    alike = []
    for seed in range(6):
        scenery = build_scenery(TerrainSettings(ground="grass"), 51_000 + seed)
        alike.append(vegetation_near_track(type("W", (), {"scenery": scenery})))
    assert blind_iou(alike) > 0.5


def route_samples(scenery, random, keep_out=0.0, count=4000):
    """What a network knows from the route alone, and whether vegetation is there.

    Features of random cells near the track: position in the world, distance along the track and to its side, and where
    the track leads. Vegetation within ``keep_out`` of the track [m] is removed.
    """
    route = scenery.route
    stations = random.uniform(0.0, route.length, count)
    sides = random.uniform(-NEAR, NEAR, count)
    index = np.round(stations / 0.05).astype(int) % len(route.points)
    headings = route.headings[index]
    normals = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    positions = route.points[index] + sides[:, None] * normals
    bend = np.array(
        [math.remainder(a - b, 2 * math.pi) for a, b in zip(np.roll(route.headings, -40)[index], headings, strict=True)]
    )
    features = [positions / 10.0, stations[:, None] / 30.0, sides[:, None], np.abs(sides)[:, None], bend[:, None]]
    features += [np.sin(headings)[:, None], np.cos(headings)[:, None], route.points[index] / 10.0]
    grown = (scenery.grass.height_at(positions) > 0.1) & (np.abs(sides) >= keep_out)
    return np.concatenate(features, axis=1).astype(np.float32), grown


def gain_of_a_blind_network(sceneries, keep_out=0.0):
    """Share of the log loss that a network of route features saves on fresh worlds, against their own base rates.

    Worlds have a tenth or nine tenths of vegetation, which no route tells: each one's rate is given, or it would hide
    everything else. Half of the worlds train the network, and a sixth say how long: one that learnt them by heart would
    be worse than nothing elsewhere, whatever the route gives away.
    """
    random = np.random.default_rng(0)
    samples = []
    for scenery in sceneries:
        features, grown = route_samples(scenery, random, keep_out)
        if 0.01 < grown.mean() < 0.99:
            odds = math.log(grown.mean() / (1.0 - grown.mean()))
            samples.append((features, grown.astype(np.float32), np.full(len(grown), odds, np.float32)))
    half, end = len(samples) // 2, 2 * len(samples) // 3
    learnt, watched, fresh = (
        [torch.from_numpy(np.concatenate(values)) for values in zip(*part, strict=True)]
        for part in (samples[:half], samples[half:end], samples[end:])
    )
    mean, scale = learnt[0].mean(dim=0), learnt[0].std(dim=0) + 1e-6
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(len(mean), 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    with torch.no_grad():
        # It starts from the base rates.
        network[-1].weight.zero_()
        network[-1].bias.zero_()
    optimiser = torch.optim.AdamW(network.parameters(), 2e-3, weight_decay=0.1)

    def loss(features, grown, odds):
        scores = network((features - mean) / scale)[:, 0] + odds
        return torch.nn.functional.binary_cross_entropy_with_logits(scores, grown)

    best, blind, base = math.inf, math.nan, math.nan
    for step in range(600):
        if step % 10 == 0:
            with torch.no_grad():
                at_hand, elsewhere = float(loss(*watched)), float(loss(*fresh))
            base = elsewhere if step == 0 else base
            if at_hand < best:
                best, blind = at_hand, elsewhere
        batch = torch.randint(len(learnt[0]), (2048,))
        optimiser.zero_grad()
        loss(*(values[batch] for values in learnt)).backward()
        optimiser.step()
    return 1.0 - blind / base


def test_a_network_that_sees_the_route_but_no_image_gains_nothing(worlds):
    sceneries = [world.scenery for world in worlds]
    sceneries += [draw_world(WorldSettings(), seed).scenery for seed in range(7024, 7048)]
    assert gain_of_a_blind_network(sceneries) < 0.02
    # It notices a track that is kept free of vegetation, and places that are always the same.
    assert gain_of_a_blind_network(sceneries, keep_out=1.0) > 0.05
    alike = [build_scenery(TerrainSettings(ground="grass"), 51_000 + seed) for seed in range(6)]
    assert gain_of_a_blind_network(alike) > 0.3


# ---------------------------------------------------------------------------------------------------------- cameras


def test_rigs_reach_their_ranges_and_look_where_their_poses_say():
    robot = Vehicle.load("husky")
    found = [
        c for seed in range(60) for c in draw_rig(RigSettings(), ImagingSettings(), robot, np.random.default_rng(seed))
    ]
    heights = np.array([c.pose[2, 3] + robot.clearance for c in found])
    pitches = np.degrees([math.asin(c.pose[2, 2]) for c in found])
    assert 0.19 < heights.min() < 0.3 and 1.4 < heights.max() < 1.51
    assert -35.1 < pitches.min() < -30.0 and 6.0 < pitches.max() < 10.1
    assert {c.settings.distortion_model for c in found} == {"plumb_bob", "rational_polynomial", "equidistant"}
    assert any(c.settings.width < c.settings.height for c in found)
    views = np.degrees([max(c.settings.field_of_view, c.settings.horizontal_field_of_view) for c in found])
    assert views.min() < 55.0 and views.max() > 135.0
    for camera in found:
        np.testing.assert_allclose(camera.pose[:3, :3] @ camera.pose[:3, :3].T, np.eye(3), atol=1e-9)
        # The image's x axis is level but for a little roll.
        assert abs(camera.pose[2, 0]) < 0.08


def test_a_fisheye_renders_pixels_where_the_camera_model_sees_them():
    settings = CameraSettings(
        width=160, height=120, field_of_view=math.radians(150), distortion=(0.02, -0.005, 0.0, 0.0),
        distortion_model="equidistant",
    )  # fmt: skip
    drawn = settings.drawn_pixels()
    model = CameraModel(160, 120, settings.matrix, np.array(settings.distortion), "equidistant")
    rng = np.random.default_rng(0)
    pixels = np.stack([rng.integers(40, 120, 200), rng.integers(30, 90, 200)], axis=1)
    rays = model.rays(pixels)
    middle = (np.array(settings.drawn_size) - 1) / 2
    focal = settings.drawn_size[1] / 2 / math.tan(settings.vertical_field_of_view / 2)
    np.testing.assert_allclose(drawn[pixels[:, 1], pixels[:, 0]], rays[:, :2] * focal + middle, atol=0.2)
    # The corners lie outside the lens' circle and stay black.
    assert (drawn[[0, 0, -1, -1], [0, -1, 0, -1]] < 0).all()


def test_a_distortion_needs_the_coefficients_of_its_model():
    with pytest.raises(ValueError, match="expected four numbers k1, k2, k3, k4"):
        CameraSettings(distortion=(0.1, 0.0, 0.0, 0.0, 0.0), distortion_model="equidistant")
    with pytest.raises(ValueError, match="distortion_model: got 'fov', expected one of plumb_bob"):
        CameraSettings(distortion_model="fov")


def test_imaging_does_what_its_settings_say():
    scene = np.full((120, 160, 3), 105, np.uint8)
    plain = {"exposure": "0", "red": "1", "blue": "1", "saturation": "1", "gamma": "1", "noise": "0.5", "blur": "0",
             "motion_blur": "0", "vignetting": "0", "dirt": "0", "quality": "90"}  # fmt: skip

    def shot(**changed):
        settings = narrowed(**{f"imaging__{name}": value for name, value in (plain | changed).items()}).imaging
        return (
            Imaging(settings.draw(np.random.default_rng(1)), 160, 120, np.random.default_rng(2))
            .apply(scene)
            .astype(float)
        )

    middle = np.s_[40:80, 60:100]
    assert shot()[middle].mean() == pytest.approx(105, abs=3)
    assert shot(exposure="-0.9")[middle].mean() == pytest.approx(105 * 2**-0.9, abs=4)
    assert shot(red="1.2")[middle][..., 0].mean() > shot()[middle][..., 0].mean() + 15
    assert shot(noise="10")[middle].std() == pytest.approx(10, rel=0.25)
    dark = shot(vignetting="0.6")
    assert dark[:4, :4].mean() < 0.6 * dark[middle].mean()
    assert np.ptp(cv2.GaussianBlur(shot(dirt="7"), (0, 0), 2)) > np.ptp(cv2.GaussianBlur(shot(), (0, 0), 2)) + 10


# -------------------------------------------------------------------------------------------------------- recordings


def test_a_recording_holds_its_rig_and_says_what_its_world_is(tmp_path):
    settings = narrowed(
        rig__count="2", rig__size="320x180", rig__rate="10", rig__lens="equidistant", robot__kind="marv"
    )
    out = tmp_path / "drive"
    summary = record(
        out,
        RecordingSettings(seed=11, duration=0.4, world=settings, labels=True, lidar=LidarSettings(rings=8, columns=90)),
    )
    assert summary.mishap is None
    recording = Recording.open(out)
    world = draw_world(settings, 11)
    robot = world.robot()
    rig = world.rig(robot)
    assert len(recording.images) == len(rig) == 2
    for camera in rig:
        topic = next(name for name in recording.images if camera.frame in name)
        image = recording.image(recording.images[topic][0])
        assert image.shape[:2] == (camera.settings.height, camera.settings.width)
        assert recording.cameras[topic].distortion_model == "equidistant"
        np.testing.assert_allclose(recording.base_from(camera.frame, robot.base_frame), camera.pose, atol=1e-6)
        assert image.std() > 5.0
    described = json.loads(world_file(out).read_text())
    assert described["robot"] == "marv" and described["cameras"] == 2 and described["style"] == "varied"
    assert np.load(labels_file(out))["vegetation_height"].shape == (401, 401)


def test_the_command_line_refuses_what_does_not_fit(tmp_path, executables, ros_environment):
    for arguments, said in (
        (["--set", "vegetation.height=0.5"], "style nature has no such settings; add --style varied"),
        (["--style", "varied", "--flat"], "--flat: applies to --style nature only"),
        (["--style", "varied", "--set", "vegetation.height=9"], "vegetation.height: got '9'"),
    ):
        command = [executables / "synthesize", tmp_path / "x", "--duration", "0.2", *arguments]
        done = subprocess.run(command, env=ros_environment, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 1 and said in done.stderr and "Traceback" not in done.stderr


def test_the_page_shows_worlds():
    image = cv2.imread(str(ROOT / "docs" / "worlds.jpg"))
    assert image is not None and (ROOT / "docs" / "worlds.jpg").stat().st_size < 1.5e6
    assert "worlds.jpg" in (ROOT / "docs" / "data.md").read_text()


def test_every_group_documents_every_setting():
    for name, group in WorldSettings().groups().items():
        for entry in fields(group):
            assert f"{entry.name}" in (type(group).__doc__ or ""), f"{name}.{entry.name}"
    assert random_stream(1, "a").random() != random_stream(1, "b").random()
