from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
)
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import (
    ComposableNodeContainer,
    LifecycleNode,
    Node,
    PushRosNamespace,
    SetParameter,
    SetRemap,
)
from launch_ros.descriptions import ComposableNode
from launch_ros.substitutions import FindPackageShare


def more(context):
    robot = LaunchConfiguration("robot").perform(context)
    return [Node(package="demo", executable="listener", name="opaque_" + robot)]


def generate_launch_description():
    robot = LaunchConfiguration("robot")
    talker = Node(
        package="demo",
        executable="talker",
        name="talk",
        output="screen",
        arguments=["--loud", robot],
        ros_arguments=["--log-level", "warn"],
        parameters=[
            {"rate": 2.5, "nested": {"list": [1, 2]}, "text": robot, "number": "12"},
            PathJoinSubstitution([FindPackageShare("demo"), "config", "demo.yaml"]),
        ],
        remappings=[("chatter", "/chat")],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "robot", default_value="husky", description="which one", choices=["husky", "jackal"]
            ),
            DeclareLaunchArgument("camera", default_value="true"),
            SetEnvironmentVariable("RSLTRACE_T", "set"),
            SetParameter("shared", 7),
            GroupAction(
                [
                    PushRosNamespace(robot),
                    SetRemap("tf", "/tf_all"),
                    talker,
                    Node(
                        package="demo",
                        executable="listener",
                        namespace="/abs",
                        condition=IfCondition(LaunchConfiguration("camera")),
                    ),
                    LifecycleNode(
                        package="demo", executable="talker", name="cycle", namespace="life"
                    ),
                ]
            ),
            OpaqueFunction(function=more),
            ComposableNodeContainer(
                package="rclcpp_components",
                executable="component_container",
                name="c",
                namespace="",
                composable_node_descriptions=[
                    ComposableNode(
                        package="demo",
                        plugin="demo.nodes.Filter",
                        name="f",
                        parameters=[{"gain": 3}],
                        remappings=[("in", "out")],
                    ),
                    ComposableNode(package="demo", plugin="demo::Fast"),
                ],
            ),
            IncludeLaunchDescription(
                AnyLaunchDescriptionSource([ThisLaunchFileDir(), "/sub.launch.xml"]),
                launch_arguments={"who": robot}.items(),
            ),
            ExecuteProcess(cmd=["echo", robot], condition=UnlessCondition("false")),
            TimerAction(period=1.0, actions=[talker]),
            RegisterEventHandler(OnProcessExit(target_action=talker, on_exit=[talker])),
        ]
    )
