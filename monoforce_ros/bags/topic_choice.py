"""Topic choice: which of a bag's topics are read, by type, name and number of messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from monoforce_ros.bags.reader import BagError, BagReader

ODOMETRY = "nav_msgs/msg/Odometry"
COMMANDS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")
ACKERMANN = ("ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive")
CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU, JOINTS = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


def camera_info_topics(image_topic: str) -> tuple[str, str]:
    """Where the CameraInfo of an image topic may be, likeliest first.

    By the convention of image_transport it is beside the topic of the raw image. Drivers that name the raw image by its
    namespace (``color`` with ``color/compressed``) have it below that topic.

    >>> camera_info_topics("/camera/front/image_raw/compressed")
    ('/camera/front/camera_info', '/camera/front/image_raw/camera_info')
    """
    base = image_topic.removesuffix("/compressed")
    space, slash, _ = base.rpartition("/")
    return f"{space}{slash}camera_info", f"{base}/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Whether the images of a topic are rectified, by the names of image_proc: ``image_rect``, ``image_rect_color``."""
    name = image_topic.removesuffix("/compressed").rpartition("/")[2].lower()
    return any(word.startswith("rect") for word in name.split("_"))


def is_commanded(topic: str) -> bool:
    """Whether joint states on a topic are commands, by its name."""
    return "command" in topic.lower() or "cmd" in topic.lower()


def chosen_topic(
    bag: BagReader,
    named: str | None,
    message_types: tuple[str, ...],
    accepts: Callable[[str], bool] = lambda topic: True,
) -> str | None:
    """The topic named, else the one of these types with the most messages; ``BagError`` if it is of another type."""
    if named:
        if bag.topics.get(named) not in message_types:
            raise BagError(
                f"{bag.path}: topic {named} is {bag.topics.get(named, 'absent')}, expected {' or '.join(message_types)}"
            )
        return named
    candidates = [topic for topic in bag.of_type(*message_types) if accepts(topic)]
    return max(candidates, key=lambda topic: bag.counts[topic], default=None)


def topic_choices(
    bag: BagReader, chosen: Mapping[str, str | None], named: Mapping[str, str | None], command_types: tuple[str, ...]
) -> list[str]:
    """What was chosen among several topics of a type, and how to choose another one."""
    texts = []
    for role, types in (("odometry", (ODOMETRY,)), ("commands", command_types), ("cloud", (CLOUD,))):
        others = [topic for topic in bag.of_type(*types) if topic != chosen[role] and bag.counts[topic]]
        if others and not named[role]:
            texts.append(
                f"{role}: {chosen[role]} is used, with the most messages of its type, not {', '.join(others)}; "
                f"--{role} TOPIC selects another one"
            )
    return texts
