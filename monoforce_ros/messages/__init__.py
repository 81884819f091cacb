"""Arrays ↔ ROS messages. Decoders accept messages of rclpy and of bags, which have the same attributes."""

from monoforce_ros.messages import decoding, encoding
from monoforce_ros.messages.cdr import CdrWriter
from monoforce_ros.messages.decoding import MessageError, stamp_of
from monoforce_ros.messages.message_types import message_class, missing_package

__all__ = [
    "CdrWriter",
    "MessageError",
    "decoding",
    "encoding",
    "message_class",
    "missing_package",
    "stamp_of",
]
