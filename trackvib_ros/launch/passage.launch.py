"""Sensor and detector of one site, configured and activated.

ros2 launch trackvib_ros passage.launch.py scenario:=demo namespace:=/north
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.parameter_descriptions import ParameterValue
from lifecycle_msgs.msg import Transition


def _managed(name: str, parameters: list) -> list:
    """A lifecycle node, and the transitions that bring it to state active."""
    node = LifecycleNode(
        package="trackvib_ros",
        executable=f"{name}_node",
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=parameters,
        remappings=[("/clock", "clock")],  # simulated time is the site's own
        output="screen",
        sigterm_timeout="5",
    )

    def emit(transition: int) -> EmitEvent:
        return EmitEvent(
            event=ChangeState(
                lifecycle_node_matcher=lambda action: action is node, transition_id=transition
            )
        )

    activate = RegisterEventHandler(
        OnStateTransition(
            target_lifecycle_node=node,
            start_state="configuring",
            goal_state="inactive",
            entities=[emit(Transition.TRANSITION_ACTIVATE)],
        )
    )
    return [activate, node, emit(Transition.TRANSITION_CONFIGURE)]


def generate_launch_description() -> LaunchDescription:
    """Describe the launch."""
    share = Path(get_package_share_directory("trackvib_ros"))

    def typed(name: str, kind: type) -> ParameterValue:
        return ParameterValue(LaunchConfiguration(name), value_type=kind)

    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of the site"
            ),
            DeclareLaunchArgument(
                "scenario", default_value="demo", description="scenario preset or TOML file"
            ),
            DeclareLaunchArgument(
                "real_time_factor",
                default_value="1.0",
                description="simulated seconds per second; 0: as fast as nothing is lost",
            ),
            DeclareLaunchArgument(
                "record_directory",
                default_value="",
                description="record all topics to this new bag; empty: do not record",
            ),
            DeclareLaunchArgument(
                "await_recorders",
                default_value="0",
                description="subscribers of all data to wait for at the start (1 with recording)",
            ),
            DeclareLaunchArgument(
                "parameters",
                default_value=str(share / "config" / "passage.yaml"),
                description="parameter file of both nodes",
            ),
            SetEnvironmentVariable(
                "FASTRTPS_DEFAULT_PROFILES_FILE",
                EnvironmentVariable(
                    "FASTRTPS_DEFAULT_PROFILES_FILE",
                    default_value=str(share / "config" / "dds_profile.xml"),
                ),
            ),
            *_managed(
                "detector",
                [
                    LaunchConfiguration("parameters"),
                    {"record_directory": typed("record_directory", str)},
                ],
            ),
            *_managed(
                "sensor",
                [
                    LaunchConfiguration("parameters"),
                    {
                        "scenario": typed("scenario", str),
                        "real_time_factor": typed("real_time_factor", float),
                        "await_recorders": typed("await_recorders", int),
                    },
                ],
            ),
        ]
    )
