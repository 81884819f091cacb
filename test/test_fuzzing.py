"""Arbitrary content in messages and files is decoded into finite numbers, or refused with a reason."""

import copy
import dataclasses
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from monoforce_ros.bags import builders
from monoforce_ros.encoder import CheckpointError, load_encoder
from monoforce_ros.encoder.checkpoint import shipped_checkpoint
from monoforce_ros.messages import decoding
from monoforce_ros.messages.decoding import MessageError
from monoforce_ros.robots import RobotFileError, load_robot
from monoforce_ros.robots.loader import robot_file
from monoforce_ros.terrain import TerrainFileError, load_terrain
from monoforce_ros.training.recording_samples import SamplesError, read_samples

STAMP = 1_700_000_000_123_456_789


@dataclasses.dataclass
class Dimension:
    label: str = ""
    size: int = 0
    stride: int = 0


@dataclasses.dataclass
class Layout:
    dim: list
    data_offset: int = 0


@dataclasses.dataclass
class Array:
    layout: Layout
    data: np.ndarray


def sequences():
    return Array(Layout([Dimension("n", 2), Dimension("k", 3), Dimension("c", 2)]), np.zeros(12, np.float32))


EXAMPLES = {
    "image": (
        lambda: builders.image(STAMP, "camera", np.full((6, 8, 3), 90, np.uint8)),
        decoding.decode_image,
    ),
    "compressed": (
        lambda: builders.compressed_image(STAMP, "camera", "jpeg", b"\xff\xd8\xff"),
        decoding.decode_image,
    ),
    "camera_info": (
        lambda: builders.camera_info(
            STAMP,
            "camera",
            64,
            48,
            np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1.0]]),
            [0.1, 0.0, 0.0, 0.0, 0.0],
        ),
        decoding.decode_camera_info,
    ),
    "cloud": (
        lambda: builders.point_cloud(STAMP, "lidar", np.ones((5, 3), np.float32)),
        decoding.decode_cloud,
    ),
    "fields": (
        lambda: builders.point_cloud(STAMP, "lidar", np.ones((5, 3), np.float32)),
        decoding.decode_fields,
    ),
    "odometry": (
        lambda: builders.odometry(STAMP, "odom", "base_link", [1, 2, 3], [0, 0, 0, 1], [0.5, 0, 0], [0, 0, 0.1]),
        decoding.decode_odometry,
    ),
    "imu": (lambda: builders.imu(STAMP, "imu_link", [0, 0, 0.1], [0, 0, 9.81]), decoding.decode_angular_velocity),
    "joint_state": (
        lambda: builders.joint_state(STAMP, ["left_wheel", "right_wheel"], [0, 0], [1.0, 1.0]),
        decoding.decode_wheels,
    ),
    "twist": (lambda: builders.twist(0.5, 0.1), decoding.decode_command),
    "twist_stamped": (lambda: builders.twist_stamped(STAMP, "base_link", 0.5, 0.1), decoding.decode_command),
    "transforms": (
        lambda: builders.static_transforms(STAMP, "base_link", {"lidar": np.eye(4)}),
        decoding.decode_transforms,
    ),
    "sequences": (sequences, lambda message: decoding.decode_command_sequences(message, 16)),
}


def places(message, path=()):
    """Paths to the numbers, strings and arrays of a message."""
    if dataclasses.is_dataclass(message):
        for entry in dataclasses.fields(message):
            if entry.name != "__msgtype__":
                yield from places(getattr(message, entry.name), (*path, entry.name))
    elif isinstance(message, list) and message and dataclasses.is_dataclass(message[0]):
        yield path
        for index, item in enumerate(message):
            yield from places(item, (*path, index))
    else:
        yield path


def at(message, path):
    for step in path:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    return message


def changed(message, path, value):
    message = copy.deepcopy(message)
    holder = at(message, path[:-1])
    if isinstance(path[-1], int):
        holder[path[-1]] = value
    else:
        setattr(holder, path[-1], value)
    return message


WHOLE = st.one_of(st.integers(0, 8), st.sampled_from([2**16, 2**31 - 1, 2**31, 2**32 - 1]), st.integers(0, 2**32 - 1))
REAL = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True), st.sampled_from([0.0, -1.0, 1e308, -1e-308, 1e12, float("nan")])
)


def another(value):
    """Values that a field of the same type may hold."""
    if isinstance(value, bool | np.bool_):
        return st.booleans()
    if isinstance(value, int | np.integer):
        return WHOLE
    if isinstance(value, float | np.floating):
        return REAL
    if isinstance(value, str):
        return st.one_of(st.text(max_size=12), st.sampled_from(["", "rgb8", "bayer_rggb8", "equidistant", "a" * 300]))
    if isinstance(value, np.ndarray):
        if value.dtype == np.uint8:
            return st.binary(max_size=200).map(lambda data: np.frombuffer(data, np.uint8))
        return st.lists(REAL, max_size=20).map(lambda listed: np.array(listed, value.dtype))
    if isinstance(value, list):
        return st.sampled_from([value[:0], value[:1], value * 2])
    raise AssertionError(f"nothing is drawn for a {type(value)}")


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
@pytest.mark.parametrize("name", EXAMPLES)
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.data_too_large, HealthCheck.too_slow])
@given(data=st.data())
def test_a_message_with_arbitrary_content_is_decoded_or_refused(name, data):
    make, decode = EXAMPLES[name]
    message = make()
    for _ in range(data.draw(st.integers(1, 3), label="changes")):
        path = data.draw(st.sampled_from(list(places(message))), label="where")
        message = changed(message, path, data.draw(another(at(message, path)), label="what"))
    try:
        found = decode(message)
    except MessageError:
        return
    numbers = found[0] if isinstance(found, tuple) else found
    if name == "joint_state":
        assert not np.isinf([value for pair in found.values() for value in pair]).any()
    elif name in ("twist", "twist_stamped", "imu", "sequences", "cloud"):
        assert np.isfinite(np.asarray(numbers)).all()
    if name == "odometry":
        assert np.isfinite(numbers.position).all() and np.isfinite(numbers.rotation).all()
    if name == "transforms":
        assert all(np.isfinite(matrix).all() for matrix in found.values())
    if name == "camera_info":
        assert np.isfinite(found.matrix).all() and np.isfinite(found.distortion).all()


def damaged(data, content: bytes) -> bytes:
    """A file cut short, or with some bytes changed."""
    if data.draw(st.booleans(), label="cut"):
        return content[: data.draw(st.integers(0, len(content) - 1), label="to")]
    changed_bytes = bytearray(content)
    for _ in range(data.draw(st.integers(1, 8), label="changes")):
        place = data.draw(st.integers(0, min(len(content), 4000) - 1), label="at")
        changed_bytes[place] = data.draw(st.integers(0, 255))
    return bytes(changed_bytes)


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_damaged_checkpoint_is_refused_or_loads(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    source = shipped_checkpoint()
    weights, configuration = source.read_bytes(), source.with_suffix(".json").read_bytes()
    if data.draw(st.booleans(), label="weights"):
        weights = damaged(data, weights)
    else:
        configuration = damaged(data, configuration)
    file = folder / "encoder.safetensors"
    file.write_bytes(weights)
    file.with_suffix(".json").write_bytes(configuration)
    try:
        load_encoder(file)
    except CheckpointError:
        pass


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_damaged_robot_file_is_refused_or_loads(data, tmp_path_factory):
    file = tmp_path_factory.mktemp("robot") / "robot.yaml"
    file.write_bytes(damaged(data, robot_file("husky").read_bytes()))
    try:
        robot = load_robot(file)
    except RobotFileError:
        return
    assert np.isfinite(robot.points.numpy()).all() and float(robot.mass) > 0


ANYTHING = st.one_of(
    st.binary(max_size=300),
    st.text(max_size=200).map(str.encode),
    st.dictionaries(st.text(max_size=8), st.integers()).map(lambda content: json.dumps(content).encode()),
)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(content=ANYTHING)
def test_any_file_as_terrain_or_samples_is_refused(content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    for ending, read, error in ((".npz", load_terrain, TerrainFileError), (".safetensors", read_samples, SamplesError)):
        file = folder / f"file{ending}"
        file.write_bytes(content)
        with pytest.raises(error):
            read(file)
