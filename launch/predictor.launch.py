"""Start the predictor and, optionally, path_selector.

``ros2 launch monoforce_ros predictor.launch.py robot:=husky terrain_source:=lidar candidates:=32 path_selector:=true``

Arguments override the parameter file. What is started is decided, and checked, by monoforce_ros.nodes.launch_plan.
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from monoforce_ros.nodes.launch_plan import launch_arguments, plan_nodes


def _nodes(context: LaunchContext) -> list[Node]:
    """The nodes for the given arguments."""
    given = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in launch_arguments()}
    return [
        Node(
            package="monoforce_ros",
            executable=plan.executable,
            name=plan.name,
            namespace=plan.namespace,
            parameters=[plan.parameters] if plan.parameters else [],
            remappings=list(plan.remappings),
            output="screen",
        )
        for plan in plan_nodes(given, context.argv)
    ]


def generate_launch_description() -> LaunchDescription:
    """The predictor with its most important parameters as arguments, and path_selector on request."""
    declared = [
        DeclareLaunchArgument(argument.name, default_value="", description=argument.description)
        for argument in launch_arguments()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])
