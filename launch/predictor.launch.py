"""Start the predictor and, optionally, path_selector.

``ros2 launch monoforce_ros predictor.launch.py robot:=husky terrain_source:=lidar candidates:=32 path_selector:=true``

Every parameter of the nodes is an argument; ``--show-args`` lists them, and says which node has each. They are checked
as the nodes check them, and override the parameter file. What is started is decided, and checked, by
monoforce_ros.nodes.launch_plan.
"""

import sys
from pathlib import Path

from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import Action, LaunchContext, LaunchDescription
from monoforce_ros.nodes.launch_plan import idle_sections, launch_arguments, plan_nodes


def _actions(context: LaunchContext) -> list[Action]:
    """The nodes for the given arguments, and what the user should know of them."""
    # Where another launch file was called, the arguments on the command line are first of all that file's.
    included = not any(Path(word).name == Path(__file__).name for word in sys.argv)
    given = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in launch_arguments()}
    # What a file that includes this one passes on is no word of the command line.
    passed = [f"{name}:={value}" for name, value in context.launch_configurations.items()] if included else []
    plans = plan_nodes(given, [*context.argv, *passed], included=included)
    nodes = [
        Node(
            package="monoforce_ros",
            executable=plan.executable,
            name=plan.name,
            namespace=plan.namespace,
            parameters=[plan.parameters] if plan.parameters else [],
            remappings=list(plan.remappings),
            output="screen",
        )
        for plan in plans
    ]
    return [*(LogInfo(msg=text) for text in idle_sections(plans, given["params_file"])), *nodes]


def generate_launch_description() -> LaunchDescription:
    """The predictor and, on request, path_selector, with their parameters as arguments."""
    declared = [
        DeclareLaunchArgument(argument.name, default_value="", description=argument.description)
        for argument in launch_arguments()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_actions)])
