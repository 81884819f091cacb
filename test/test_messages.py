"""Messages: encoded messages are read back by ROS, and decoded ones are checked before use."""

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import Twist
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import GridCells, Path
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from monoforce_ros.bags import builders, is_rectified
from monoforce_ros.messages import decoding, encoding
from monoforce_ros.messages.decoding import MessageError

STAMP = 1_666_877_643_267_394_304


@pytest.mark.parametrize("frame", ["map", "odom", "a", "robot_1/odom_frame", ""])
def test_path_is_read_back_whatever_the_length_of_its_frame(frame):
    generator = np.random.default_rng(0)
    positions, quaternions = generator.normal(size=(7, 3)), generator.normal(size=(7, 4))
    stamps = STAMP + np.arange(7) * 100_000_000
    path = deserialize_message(encoding.path(frame, stamps, positions, quaternions), Path)
    assert path.header.frame_id == frame and decoding.stamp_of(path) == STAMP
    for i, pose in enumerate(path.poses):
        assert pose.header.frame_id == frame and decoding.stamp_of(pose) == stamps[i]
        p, q = pose.pose.position, pose.pose.orientation
        np.testing.assert_array_equal([p.x, p.y, p.z], positions[i])
        np.testing.assert_array_equal([q.x, q.y, q.z, q.w], quaternions[i])


def test_grid_cells_are_read_back():
    points = np.random.default_rng(0).normal(size=(50, 3))
    cells = deserialize_message(encoding.grid_cells(STAMP, "odom", 0.1, points), GridCells)
    assert cells.header.frame_id == "odom" and cells.cell_width == cells.cell_height == np.float32(0.1)
    np.testing.assert_array_equal([[c.x, c.y, c.z] for c in cells.cells], points)


def test_point_cloud_is_read_back_with_its_channels():
    channels = {name: np.arange(6, dtype=np.float32) + i for i, name in enumerate(("x", "y", "z", "friction"))}
    cloud = deserialize_message(encoding.point_cloud(STAMP, "odom", channels), PointCloud2)
    assert [f.name for f in cloud.fields] == list(channels) and cloud.is_dense and cloud.width == 6
    np.testing.assert_array_equal(decoding.decode_cloud(cloud), np.stack([channels[n] for n in "xyz"], axis=1))


def test_markers_are_read_back_and_empty_ones_deleted():
    points = np.random.default_rng(0).normal(size=(4, 3))
    colours = np.tile([0.1, 0.2, 0.3, 1.0], (4, 1))
    markers = [
        encoding.ListMarker("forces", "lines", points, colours, 0.02),
        encoding.ListMarker("dots", "spheres", points, np.array([1, 0, 0, 1]), 0.1, identifier=3),
        encoding.ListMarker("gone", "spheres", np.zeros((0, 3)), np.zeros((0, 4)), 0.1),
    ]
    array = deserialize_message(encoding.marker_array(STAMP, "odom", markers), MarkerArray)
    lines, dots, gone = array.markers
    assert (lines.type, lines.action, lines.ns) == (Marker.LINE_LIST, Marker.ADD, "forces")
    assert (dots.type, dots.id, dots.color.r, dots.scale.y) == (Marker.SPHERE_LIST, 3, 1.0, 0.1)
    assert gone.action == Marker.DELETE
    np.testing.assert_array_equal([[p.x, p.y, p.z] for p in lines.points], points)
    np.testing.assert_allclose([[c.r, c.g, c.b, c.a] for c in lines.colors], colours, atol=1e-7)
    assert lines.pose.orientation.w == 1.0 and decoding.stamp_of(lines) == STAMP


PIXELS = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)


@pytest.mark.parametrize(
    ("encoding_name", "stored", "expected"),
    [
        ("rgb8", PIXELS, PIXELS),
        ("bgr8", PIXELS[..., ::-1], PIXELS),
        ("bgra8", cv2.cvtColor(PIXELS, cv2.COLOR_RGB2BGRA), PIXELS),
        ("mono8", PIXELS[..., :1], PIXELS[..., :1].repeat(3, axis=2)),
    ],
)
def test_images_of_common_encodings_become_rgb(encoding_name, stored, expected):
    message = builders.image(STAMP, "camera", stored, encoding_name)
    np.testing.assert_array_equal(decoding.decode_image(message), expected)


@pytest.mark.parametrize("name", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
def test_bayer_patterns_have_red_pixels_where_their_names_say(name):
    # A uniformly red scene: only the red sites of the pattern are lit.
    pattern = {c: name[6:10].index(c) for c in "rb"}
    raw = np.zeros((8, 8, 1), np.uint8)
    raw[pattern["r"] // 2 :: 2, pattern["r"] % 2 :: 2] = 200
    colour = decoding.decode_image(builders.image(STAMP, "camera", raw, name))[2:6, 2:6].mean(axis=(0, 1))
    assert colour[0] > 150 and colour[1] < 20 and colour[2] < 20


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_images_of_a_sensor_with_fewer_bits_than_are_sent_are_not_black(bits):
    values = np.linspace(0, (1 << bits) - 1, 48).astype("<u2").reshape(6, 8)
    message = builders.image(STAMP, "camera", values.view(np.uint8).reshape(6, 16, 1), "mono16")
    message.width = 8
    np.testing.assert_array_equal(decoding.decode_image(message)[..., 0], values >> (bits - 8))


def test_rows_with_padding_and_other_byte_orders_are_read():
    message = builders.image(STAMP, "camera", np.zeros((4, 6, 3), np.uint8))
    padded = np.zeros((4, 20), np.uint8)
    padded[:, :18] = np.arange(72, dtype=np.uint8).reshape(4, 18)
    message.data, message.step = padded.ravel(), 20
    np.testing.assert_array_equal(decoding.decode_image(message), np.arange(72).reshape(4, 6, 3))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"encoding": "32FC1"}, "encoding: got '32FC1'"),
        ({"width": 0}, "size: got 0"),
        ({"step": 3}, "row step of 3"),
        ({"data": np.zeros(5, np.uint8)}, "got 5 bytes"),
        ({"width": 2**31, "height": 2**31}, "expected 1 to"),
    ],
)
def test_unusable_images_are_refused_with_the_reason(change, text):
    message = builders.image(STAMP, "camera", PIXELS)
    for field, value in change.items():
        setattr(message, field, value)
    with pytest.raises(MessageError, match=text):
        decoding.decode_image(message)


@given(st.binary(max_size=200), st.sampled_from(["jpeg", "png", "rgb8; jpeg compressed bgr8", ""]))
@settings(max_examples=60, deadline=None)
def test_any_bytes_as_a_compressed_image_are_decoded_or_refused(data, name):
    try:
        decoding.decode_image(builders.compressed_image(STAMP, "camera", name, data))
    except MessageError:
        pass


def test_empty_returns_are_removed_from_clouds():
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [0, 0, 0], [np.inf, 1, 1], [4, 5, 6], [1e30, 0, 0]], np.float32)
    cloud = builders.point_cloud(STAMP, "lidar", points)
    np.testing.assert_array_equal(decoding.decode_cloud(cloud), points[[0, 4]])


def test_a_cloud_of_only_nan_is_refused():
    with pytest.raises(MessageError, match="none of its 9 points is a finite return"):
        decoding.decode_cloud(builders.point_cloud(STAMP, "lidar", np.full((9, 3), np.nan)))


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.binary(max_size=64),
    st.lists(
        st.tuples(st.sampled_from(["x", "y", "z", "w"]), st.integers(0, 2**32 - 1), st.integers(0, 255)), max_size=4
    ),
)
@settings(max_examples=150, deadline=None)
def test_any_point_cloud_is_decoded_or_refused(width, height, point_step, row_step, data, fields):
    cloud = builders.point_cloud(STAMP, "lidar", np.zeros((1, 3)))
    kind = type(cloud.fields[0])
    cloud.width, cloud.height, cloud.point_step, cloud.row_step = width, height, point_step, row_step
    cloud.data = np.frombuffer(data, np.uint8)
    cloud.fields = [kind(name=n, offset=o, datatype=d, count=1) for n, o, d in fields]
    try:
        assert decoding.decode_cloud(cloud).shape[1] == 3
    except MessageError:
        pass


@pytest.mark.parametrize(
    ("quaternion", "velocity", "text"),
    [
        ([0, 0, 0, 0], [0, 0, 0], "norm 0"),
        ([0, 0, 0, 2], [0, 0, 0], "unit quaternion"),
        ([0, 0, 0, np.nan], [0, 0, 0], "norm nan"),
        ([0, 0, 0, 1], [np.nan, 0, 0], "not finite"),
        ([0, 0, 0, 1], [500.0, 0, 0], "expected at most 100"),
    ],
)
def test_unusable_odometry_is_refused_with_the_reason(quaternion, velocity, text):
    message = builders.odometry(STAMP, "odom", "base_link", [0, 0, 0], quaternion, velocity, [0, 0, 0])
    with pytest.raises(MessageError, match=text):
        decoding.decode_odometry(message)


def test_quaternions_are_read_as_x_y_z_w():
    quarter = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    state, frame, child = decoding.decode_odometry(
        builders.odometry(STAMP, "odom", "base_link", [1, 2, 3], quarter, [1, 0, 0], [0, 0, 0.5])
    )
    assert (frame, child, state.stamp) == ("odom", "base_link", STAMP)
    np.testing.assert_allclose(state.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    assert state.heading == pytest.approx(np.pi / 2)


def test_commands_that_no_robot_can_follow_are_refused():
    command = Twist()
    command.linear.x = 1000.0
    with pytest.raises(MessageError, match=r"got \[1000\.0, 0\.0\], expected at most 100 m/s"):
        decoding.decode_command(command)


def test_commands_of_both_types_are_decoded_and_nan_is_refused():
    assert decoding.decode_command(builders.twist(0.5, -0.1)).tolist() == [0.5, -0.1]
    assert decoding.decode_command(builders.twist_stamped(STAMP, "", 0.5, -0.1)).tolist() == [0.5, -0.1]
    with pytest.raises(MessageError, match="expected finite numbers"):
        decoding.decode_command(builders.twist(np.nan, 0.0))


@pytest.mark.parametrize("name", ["jpeg", "png"])
@pytest.mark.parametrize(("width", "height"), [(65_000, 65_000), (20_000, 20_000), (0, 5)])
def test_a_few_bytes_that_claim_a_huge_picture_are_refused_before_it_is_decoded(name, width, height):
    encoded = bytearray(cv2.imencode(f".{name}", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    if name == "png":
        encoded[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    else:
        frame = encoded.index(b"\xff\xc0")
        encoded[frame + 5 : frame + 9] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    with pytest.raises(MessageError, match=rf"image size: got {width} × {height}, expected 1 to"):
        decoding.decode_image(builders.compressed_image(STAMP, "camera", name, bytes(encoded)))


@pytest.mark.parametrize("name", ["jpeg", "png"])
def test_images_of_any_size_keep_it(name):
    picture = np.random.default_rng(1).integers(0, 255, (37, 53, 3), np.uint8)
    for flags in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1] if name == "jpeg" else []):
        data = cv2.imencode(f".{name}", picture, flags)[1].tobytes()
        assert decoding.decode_image(builders.compressed_image(STAMP, "camera", name, data)).shape == (37, 53, 3)


def test_joints_without_a_velocity_interface_are_measured():
    """joint_state_broadcaster tells their rates as NaN."""
    state = builders.joint_state(STAMP, ["left_steering", "right_steering"], [0.1, 0.2], [np.nan, np.nan])
    angles, rates = decoding.decode_joints(state, ["left_steering", "right_steering"])
    assert angles.tolist() == [0.1, 0.2] and np.isnan(rates).all()
    infinite = builders.joint_state(STAMP, ["left_steering"], [0.1], [np.inf])
    with pytest.raises(MessageError, match="no finite velocity"):
        decoding.decode_joints(infinite, ["left_steering"])


def test_joints_that_steer_or_spring_at_a_wheel_are_no_wheels():
    names = ["front_left_wheel_steering_joint", "front_right_wheel_steering_joint", "left_wheel", "right_wheel"]
    state = builders.joint_state(STAMP, [*names, "left_wheel_suspension"], [0.0] * 5, [0.0, 0.0, 10.0, 12.0, 3.0])
    assert decoding.decode_wheels(state) == {"left_wheel": (0.0, 10.0), "right_wheel": (0.0, 12.0)}


def test_one_bad_transform_does_not_cost_the_others():
    message = builders.static_transforms(STAMP, "base_link", {"lidar": np.eye(4), "wheel": np.eye(4)})
    bad = next(entry for entry in message.transforms if entry.child_frame_id == "wheel")
    bad.transform.rotation.w = 0.0
    assert list(decoding.decode_transforms(message)) == [("base_link", "lidar")]
    message.transforms.remove(next(entry for entry in message.transforms if entry.child_frame_id == "lidar"))
    with pytest.raises(MessageError, match="quaternion is zero"):
        decoding.decode_transforms(message)


def test_a_jpeg_that_ends_early_is_refused():
    pixels = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    whole = builders.compressed_image(STAMP, "camera", "jpeg", data + b"\x00" * 16)
    assert decoding.decode_image(whole).shape == (60, 80, 3)
    for share in (0.5, 0.9):
        cut = builders.compressed_image(STAMP, "camera", "jpeg", data[: int(share * len(data))])
        with pytest.raises(MessageError, match="cannot be decoded"):
            decoding.decode_image(cut)
    depth = builders.compressed_image(STAMP, "camera", "16UC1; png compressed ", data)
    with pytest.raises(MessageError, match="depth image"):
        decoding.decode_image(depth)


def test_rectified_images_are_projected_by_p_without_distortion():
    matrix = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    info = builders.camera_info(STAMP, "camera", 640, 480, matrix, [-0.3, 0.1, 0, 0, 0])
    info.p[[0, 5]] = 330.0
    raw, rectified = decoding.decode_camera_info(info), decoding.decode_camera_info(info, rectified=True)
    assert raw.is_distorted and not rectified.is_distorted
    pixels, _ = rectified.project(np.array([[0.5, 0.6, 1.5]]))
    np.testing.assert_allclose(pixels, [[430.0, 372.0]])
    info.p[:] = 0.0
    with pytest.raises(MessageError, match="no projection P"):
        decoding.decode_camera_info(info, rectified=True)
    rectified_names = ("image_rect", "image_rect_color/compressed", "rectified")
    assert all(is_rectified(f"/camera/{name}") for name in rectified_names)
    assert not any(is_rectified(f"/camera/{name}") for name in ("image_raw", "direct"))
