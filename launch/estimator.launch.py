"""ros2 launch hand_pose_ros estimator.launch.py depth_topic:=/camera/camera/depth/image_rect_raw"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description() -> LaunchDescription:
    """The node, and RViz if asked for. The node configures and activates itself, so nothing else is needed."""
    arguments = {
        'depth_topic': ('depth/image_rect', 'Depth image, without its transport; camera_info is beside it.'),
        'params_file': (str(SHARE / 'config' / 'estimator.yaml'), 'Parameters of the node.'),
        'namespace': ('', 'Namespace of the node and its topics.'),
        'use_sim_time': ('', 'true: take the time from /clock (bags played with --clock). Empty: as params_file says.'),
        'rviz': ('false', 'Show the hands in RViz.'),
    }
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value, description=about)
          for name, (value, about) in arguments.items()),
        OpaqueFunction(function=_nodes),
    ])


def _nodes(context: LaunchContext) -> list[Node]:
    """use_sim_time is passed on only if it was given, because it would override that of params_file."""
    use_sim_time = LaunchConfiguration('use_sim_time')
    given = [{'use_sim_time': use_sim_time}] if use_sim_time.perform(context) else []
    depth_topic = LaunchConfiguration('depth_topic')
    # RViz does not remap it along with the image.
    camera_info = str(Path(depth_topic.perform(context)).with_name('camera_info'))
    return [
        Node(package='hand_pose_ros', executable='estimator', name='estimator', output='screen',
             namespace=LaunchConfiguration('namespace'),
             parameters=[LaunchConfiguration('params_file'), *given],
             remappings=[('depth/image_rect', depth_topic)]),
        Node(package='rviz2', executable='rviz2', arguments=['-d', str(SHARE / 'rviz' / 'hand_pose.rviz')],
             namespace=LaunchConfiguration('namespace'),
             remappings=[('/hand/markers', 'hand/markers'), ('/depth/image_rect', depth_topic),
                         ('/depth/camera_info', camera_info)],
             parameters=given, condition=IfCondition(LaunchConfiguration('rviz'))),
    ]
