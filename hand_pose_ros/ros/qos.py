"""Quality of service of the topics, and how large images get through."""

from __future__ import annotations

import os
from importlib.metadata import version

from rclpy import get_rmw_implementation_identifier
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from hand_pose_ros.resources import resource

RESULTS = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
"""Outputs. Reliable connects to every subscriber."""
TF = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=100, reliability=QoSReliabilityPolicy.RELIABLE)
"""Output to /tf, as its listeners expect it."""
LATCHED = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.RELIABLE,
                     durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
"""Outputs that are published once. Subscribers that come later still receive them."""


def sensor() -> QoSProfile:
    """Inputs. Best effort connects to every publisher, reliable or not. Only the newest image matters (REP-2003).

    Each call makes a new profile, because overrides by parameters are written into it.
    """
    return QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)


KILTED = 9
"""Major version of its rclpy."""
PROFILE_VARIABLES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')  # the second up to Jazzy


def middleware() -> str:
    """Name of the middleware in use, for example rmw_fastrtps_cpp. The profile is only for this one."""
    return str(get_rmw_implementation_identifier())


def large_image_profile() -> tuple[str, str]:
    """The environment variable for large images over Fast DDS, and the file that it must name.

    Only the publisher of the images needs it, because an image must fit into the shared memory of its publisher.
    Without the profile, a VGA depth image is larger than this memory, and a best-effort subscriber loses many images.
    """
    new, old = PROFILE_VARIABLES
    distro = os.environ.get('ROS_DISTRO')  # not set with ROS from wheels
    up_to_jazzy = (distro in ('humble', 'iron', 'jazzy') if distro
                   else int(version('rclpy').partition('.')[0]) < KILTED)
    return old if up_to_jazzy else new, str(resource('config/fastdds_large_images.xml'))


def let_large_images_through() -> None:
    """Choose that profile for this process, unless the user has chosen one. Call this before rclpy.init()."""
    if not any(name in os.environ for name in PROFILE_VARIABLES):
        os.environ.update([large_image_profile()])
