"""Starts the node and brings it to active: it votes from then on. Deactivate it to close the ballot."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition

NAME = "mapvote_vehicle"


def generate_launch_description() -> LaunchDescription:
    parameters = f"{get_package_share_directory(NAME)}/config/{NAME}.param.yaml"
    node = LifecycleNode(
        package=NAME,
        executable=f"{NAME}_node",
        name=NAME,
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("param_path")],
        output="both",
    )

    def change(transition: int) -> EmitEvent:
        return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition))

    activate = OnStateTransition(
        target_lifecycle_node=node,
        start_state="configuring",
        goal_state="inactive",
        entities=[change(Transition.TRANSITION_ACTIVATE)],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("param_path", default_value=parameters),
            DeclareLaunchArgument("namespace", default_value=""),
            RegisterEventHandler(activate),
            node,
            change(Transition.TRANSITION_CONFIGURE),
        ]
    )
