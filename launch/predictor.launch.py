"""Start the predictor and, optionally, path_selector.

``ros2 launch monoforce_ros predictor.launch.py robot:=husky terrain_source:=lidar candidates:=32 path_selector:=true``
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

# Name of an argument: default, type of the predictor's parameter of that name (None if there is no such one), meaning.
ARGUMENTS = {
    "robot": ("husky", str, "robot model: name of a shipped robot or path of a file"),
    "terrain_source": ("lidar", str, "lidar, camera, lidar_camera or flat"),
    "checkpoint": ("", str, "terrain encoder weights, for terrain sources with a camera"),
    "cloud_topic": ("points", str, "sensor_msgs/PointCloud2, for terrain sources with a lidar"),
    "odometry_topic": ("odom", str, "nav_msgs/Odometry"),
    "command_topic": ("cmd_vel", str, "geometry_msgs/TwistStamped or Twist"),
    "candidates": ("0", int, "number of candidate commands; 0 disables candidates"),
    "ensemble": ("0", int, "number of rollouts for the uncertainty of each prediction; 0 disables the ensemble"),
    "autostart": ("true", bool, "if false, a lifecycle manager configures and activates the predictor"),
    "use_sim_time": ("false", bool, "use the time on /clock"),
    "params_file": ("", None, "YAML file with further parameters; overrides launch arguments"),
    "namespace": ("", None, "namespace of the nodes and their topics, for several robots"),
    "path_selector": ("false", None, "also start path_selector, which drives to goal_pose using the candidates"),
}


def _typed(text: str, kind: type) -> str | int | bool:
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError(f"got {text!r}, expected true or false")
        return text.lower() == "true"
    return kind(text)


def _nodes(context: LaunchContext) -> list[Node]:
    """The nodes for the given arguments."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    parameters = {name: _typed(given[name], kind) for name, (_, kind, _) in ARGUMENTS.items() if kind is not None}
    common = {"package": "monoforce_ros", "namespace": given["namespace"], "output": "screen"}
    files = [given["params_file"]] if given["params_file"] else []
    nodes = [Node(executable="predictor", name="predictor", parameters=[parameters, *files], **common)]
    if _typed(given["path_selector"], bool):
        shared = {name: parameters[name] for name in ("use_sim_time", "odometry_topic", "command_topic")}
        nodes.append(Node(executable="path_selector", name="path_selector", parameters=[shared, *files], **common))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """The predictor with its most important parameters as arguments, and path_selector on request."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, (default, _, meaning) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])
