"""Foreign pictures, and sensors that die, through the installed predictor: paths are hardly worse than on level ground.

The bundled drive is played to two predictors with the shipped encoder and all defaults that concern terrain, one with
cameras and one with a lidar, too.
"""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rclpy.serialization import deserialize_message

from monoforce_ros.bags import BagReader, Recording, builders
from monoforce_ros.messages import message_class, stamp_of
from monoforce_ros.perception import FlatTerrain, Observation
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

# No times are asserted; on a busy machine four drives take minutes.
pytestmark = [pytest.mark.unhurried_nodes, pytest.mark.timeout(600)]
HORIZON = 2.0
DROPPED = 4.0
"""When a sensor dies [s]."""
LENGTH = 10.0
"""Of the drive [s]."""
PATIENCE = 2.0
"""With a sensor that is silent [s]."""
OK, WARN, STALE = 0, 1, 3
IMAGE = "/pictures/image_raw"
TOPICS = {
    "/odom": "/odom", "/cmd_vel": "/cmd_vel", "/points": "/points", "/camera_front/camera_info": "/pictures/camera_info"
}  # fmt: skip
"""Topics of the bag, and those on which they are played."""
SOURCES = {"images": "camera", "both": "lidar_camera"}
"""Name of each node, and its terrain source."""


def shuffled(image):
    tiles = [np.hsplit(row, 4) for row in np.vsplit(image, 4)]
    order = np.random.default_rng(1).permutation(16)
    return np.vstack([np.hstack([tiles[i // 4][i % 4] for i in order[4 * r : 4 * r + 4]]) for r in range(4)])


def of_another_robot(images):
    """Pictures of a robot that stands elsewhere, or, without real recordings, of this drive the other way round."""
    root = Path(__file__).resolve().parent.parent
    scenes = Path(os.environ.get("MONOFORCE_REAL_DATA", root.parent / "shared" / "data")) / "rough"
    files = sorted(scenes.glob("tradr_robingas/images/*"))
    if not files:
        return images[::-1]
    height, width = images[0].shape[:2]
    other = [cv2.resize(cv2.imread(str(file)), (width, height))[..., ::-1] for file in files]
    return [other[i // 10 % len(other)] for i in range(len(images))]


PICTURES = {
    "of another robot": of_another_robot,
    "upside down": lambda images: [image[::-1] for image in images],
    "shuffled": lambda images: [shuffled(image) for image in images],
    "covered lens": lambda images: [np.full_like(image, 8) for image in images],
}
DIES = {"upside down": "/points", "shuffled": IMAGE, "covered lens": "/points"}
"""What falls silent during the drive."""


@dataclass
class Played:
    """What the predictors published during one drive."""

    paths: dict[str, list] = field(default_factory=dict)
    """Stamp since the start of the drive [s], and positions every 0.1 s in the odometry frame, by node."""
    status: dict[str, dict] = field(default_factory=dict)
    """The last state of each part by the name of its node: level, message and values."""


@pytest.fixture(scope="module")
def recording(demo_bag):
    return Recording.open(demo_bag).in_base_frame("base_link")


@pytest.fixture(scope="module")
def drives(start, peer, demo_bag, recording):
    processes = [
        start(
            "predictor", "--ros-args", "-r", f"__node:={name}", "-r", f"predicted/path:={name}/path",
            "-p", f"terrain_source:={source}", "-p", f"image_topics:=[{IMAGE}]", "-p", f"data_timeout:={PATIENCE}",
            "-p", f"horizon:={HORIZON}", "-p", "rate:=100.0",
        )
        for name, source in SOURCES.items()
    ]  # fmt: skip
    paths = {name: {} for name in SOURCES}
    kind = message_class("nav_msgs/msg/Path")

    def keep(data, name):
        path = deserialize_message(data, kind)
        paths[name][stamp_of(path)] = positions(path)

    for name in SOURCES:
        peer.node.create_subscription(kind, f"/{name}/path", lambda data, name=name: keep(data, name), 50, raw=True)
    for process, source in zip(processes, SOURCES.values(), strict=True):
        process.wait_for(f"with terrain from {source}")
    with BagReader(demo_bag) as bag:
        entries = [(m.received, m.topic, m.decode()) for m in bag.messages() if m.topic in TOPICS]
    first = entries[0][0]
    # As often as clouds.
    frames = recording.images["/camera_front/image_raw/compressed"][::2]
    images = [image for _, image in recording.images_of(frames)]
    found = {}
    for number, (name, change) in enumerate(PICTURES.items()):
        offset = number * round((LENGTH + 0.5) * 1e9) + 1_000_000_000
        drive = [(at, TOPICS[topic], message) for at, topic, message in entries]
        drive += [
            (frame.stamp, IMAGE, builders.image(frame.stamp, "camera_front", np.ascontiguousarray(image)))
            for frame, image in zip(frames, change(images), strict=True)
        ]
        newest = drive[0][0] + offset
        if number == 0:
            firsts = {topic: message for _, topic, message in reversed(drive)}
            for _ in range(30):
                for topic, message in firsts.items():
                    peer.publish(topic, moved(message, offset))
                if predicted(peer, paths, newest, SOURCES):
                    break
        # Not in real time, but when both predictors are done, however busy the machine is.
        for at, topic, message in sorted(drive, key=lambda entry: entry[0]):
            dead = DIES.get(name) if (at - first) * 1e-9 > DROPPED else None
            if topic == dead:
                continue
            if topic in (IMAGE, "/points") and at + offset != newest:
                predicted(peer, paths, newest, [node for node in SOURCES if (node, dead) != ("images", IMAGE)])
                newest = at + offset
            peer.publish(topic, moved(message, offset))
            peer.spin_once(0.0)
        predicted(peer, paths, newest, [node for node in SOURCES if (node, dead) != ("images", IMAGE)])
        found[name] = Played(
            {
                node: [
                    ((stamp - first - offset) * 1e-9, path)
                    for stamp, path in sorted(paths[node].items())
                    if stamp >= first + offset
                ]
                for node in SOURCES
            },
            latest_status(peer),
        )
        for node in SOURCES:
            paths[node].clear()
    assert all(process.running and "Traceback" not in process.output for process in processes)
    return found


def predicted(peer, paths, stamp, nodes):
    """Whether nodes have predicted from the data of a time; it waits for that, in vain where a sensor has just died."""
    return peer.until(lambda: all(stamp in paths[node] for node in nodes), 0.5 * PATIENCE)


def latest_status(peer):
    """Level, message and values of each part by the name of its node, as published from now on."""
    peer.received["/diagnostics"].clear()
    status = {}

    def complete():
        for array in peer.received["/diagnostics"]:
            for entry in array.status:
                values = {value.key: value.value for value in entry.values}
                status[entry.name] = (int.from_bytes(entry.level, "little"), entry.message, values)
        return all(f"{node}: terrain" in status for node in SOURCES)

    assert peer.until(complete, 30.0)
    return status


def moved(message, offset):
    """A message with a later stamp."""
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec + offset
    time_class = type(message.header.stamp)
    header = replace(message.header, stamp=time_class(sec=stamp // 10**9, nanosec=stamp % 10**9))
    return replace(message, header=header)


def positions(path):
    return np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in path.poses])


@pytest.fixture(scope="module")
def level(recording):
    """Errors of predictions on level ground [m], from the same commands as the node knows them."""
    robot = load_robot("husky")
    source = FlatTerrain(robot, Grid.square(12.8, 0.1), TerrainDefaults())
    predictor = Predictor(robot, source, horizon=HORIZON)

    def errors(seconds):
        stamps = [int(recording.motion.stamps[0] + round(s * 1e9)) for s in seconds]
        motions = [recording.motion.at(stamp) for stamp in stamps]
        twists = [
            recording.commands.sample(np.minimum(predictor.command_stamps(stamp), stamp), timeout=0.5)
            for stamp in stamps
        ]
        maps = TerrainMap.stack([source.terrain(Observation(m.stamp), m) for m in motions])
        rolled = predictor.roll_out(maps, motions, np.array(twists))
        ends = [
            m.odometry_from_terrain[:3, :3] @ rolled.position[i, -1].double().numpy() + m.position
            for i, m in enumerate(motions)
        ]
        return [off(recording, s, end) for s, end in zip(seconds, ends, strict=True)]

    return errors


def off(recording, seconds, end):
    """Distance of a predicted end from the measured position [m]."""
    stamp = int(recording.motion.stamps[0] + round((seconds + HORIZON) * 1e9))
    return float(np.linalg.norm(recording.motion.at(stamp).position - end))


@pytest.mark.parametrize("node", SOURCES)
@pytest.mark.parametrize("name", PICTURES)
def test_paths_are_hardly_worse_than_on_level_ground(drives, recording, level, name, node):
    found = drives[name].paths[node]
    assert all(np.isfinite(path).all() for _, path in found)
    stamps = np.array([seconds for seconds, _ in found])
    assert (np.diff(stamps) > 0).all() and stamps[0] >= 0.0
    # Nothing of the past is published as new, and what remains is used.
    blind = DIES.get(name) == IMAGE and node == "images"
    assert stamps[-1] <= DROPPED + 0.1 if blind else stamps[-1] > LENGTH - 1.0
    judged = [(s, path[-1]) for s, path in found if s < LENGTH - HORIZON - 0.05 and len(path) == 21]
    assert len(judged) >= 6
    own = np.mean([off(recording, s, end) for s, end in judged])
    other = np.mean(level([s for s, _ in judged]))
    assert own <= 1.05 * other


def errors_in(values):
    """Errors of the encoder and of level ground [cm] by what they are of, as /diagnostics has them."""
    found = {}
    for key, value in values.items():
        if key.endswith(" [cm] (level ground)"):
            own, level = value.rstrip(")").split(" (")
            found[key.removesuffix(" [cm] (level ground)")] = float(own), float(level)
    return found


def test_diagnostics_say_how_far_images_are_trusted_and_what_to_do(drives):
    level, message, values = drives["of another robot"].status["images: terrain"]
    assert level == WARN and "falling back, the encoder is not used" in message
    assert f"worst from camera {IMAGE}" in message
    assert "ros2 run monoforce_ros train --adapt BAG --robot husky --out adapted" in message
    found = errors_in(values)
    assert {"error", "error, 0.8 to 2 m", "error, 2 to 3.5 m", f"error, camera {IMAGE}"} <= found.keys()
    assert found["error"][0] > found["error"][1] > 0.0
    assert values["used of what the encoder adds [%]"] == "0" and values["sensors"] == "camera"


def test_diagnostics_say_which_sensors_are_trusted_when_one_dies(drives):
    _, message, values = drives["upside down"].status["both: terrain"]
    assert message.startswith("from images alone: ") or "used: from images alone: " in message
    assert values["sensors"] == "camera" and f"error, camera {IMAGE}" in errors_in(values)
    own, other = errors_in(drives["of another robot"].status["both: terrain"][2])["error of the visible surface, lidar"]
    assert 0.0 < own < 2.0 * other
    level, message, values = drives["upside down"].status["both: terrain from the sweep alone"]
    assert (level, message, values) == (STALE, "no usable sweep in the last map", {})
    _, _, values = drives["shuffled"].status["both: terrain"]
    assert values["sensors"] == "lidar"
    level, message, values = drives["shuffled"].status["both: terrain from the sweep alone"]
    assert level == OK and float(values["used of what the encoder adds [%]"]) > 50
    own, other = errors_in(values)["error"]
    assert own < other
