"""Start the predictor: ``ros2 launch monoforce_ros predictor.launch.py robot:=husky terrain_source:=lidar``."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

ARGUMENTS = {
    "robot": ("husky", "robot model, a shipped name or a file"),
    "terrain_source": ("lidar", "lidar, camera or flat"),
    "checkpoint": ("", "terrain encoder weights, for terrain_source:=camera"),
    "namespace": ("", "namespace of the node and its topics"),
}


def generate_launch_description() -> LaunchDescription:
    """One predictor with its most used parameters as launch arguments."""
    parameters = {name: LaunchConfiguration(name) for name in ARGUMENTS if name != "namespace"}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=meaning)
                for name, (default, meaning) in ARGUMENTS.items()
            ),
            Node(
                package="monoforce_ros",
                executable="predictor",
                namespace=LaunchConfiguration("namespace"),
                parameters=[parameters],
                output="screen",
            ),
        ]
    )
