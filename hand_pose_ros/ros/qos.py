"""Quality of service: what the topics ask for and offer, and how large images get through."""

from __future__ import annotations

import os

from rclpy import get_rmw_implementation_identifier
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from hand_pose_ros.resources import resource

RESULTS = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
"""Out: reliable connects to every subscriber."""
TF = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=100, reliability=QoSReliabilityPolicy.RELIABLE)
"""Out, to /tf, as its listeners expect it."""
LATCHED = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.RELIABLE,
                     durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
"""Out, published once: whoever comes later still receives it."""


def sensor() -> QoSProfile:
    """In: best effort connects to every publisher, reliable or not, and only the newest image matters (REP-2003).

    A new profile each time, because overrides by parameters are written into it.
    """
    return QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)


PROFILE_VARIABLES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')  # the second up to Jazzy


def middleware() -> str:
    """Name of the middleware in use, such as rmw_fastrtps_cpp; the profile is for that one alone."""
    return str(get_rmw_implementation_identifier())


def large_image_profile() -> tuple[str, str]:
    """The environment variable, and the file that it must name, for large images over Fast DDS.

    Only who publishes images needs it: the shared memory that an image must fit into is the publisher's. Without it a
    VGA depth image is larger than all of it, and most are lost on the way to a best-effort subscriber.
    """
    new, old = PROFILE_VARIABLES
    name = old if os.environ.get('ROS_DISTRO') in ('humble', 'iron', 'jazzy') else new
    return name, str(resource('config/fastdds_large_images.xml'))


def let_large_images_through() -> None:
    """Choose that profile for this process, unless the user has chosen one; call it before rclpy.init()."""
    if not any(name in os.environ for name in PROFILE_VARIABLES):
        os.environ.update([large_image_profile()])
