"""Robot files from URDF: what a description says, what is guessed from it, and the robot file that follows."""

from monoforce_ros.robots.urdf.conversion import Conversion, ConversionOptions, convert_description
from monoforce_ros.robots.urdf.description import Description, Joint, Link, UrdfError, read_description

__all__ = [
    "Conversion",
    "ConversionOptions",
    "Description",
    "Joint",
    "Link",
    "UrdfError",
    "convert_description",
    "read_description",
]
