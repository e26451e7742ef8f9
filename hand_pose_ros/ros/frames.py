"""tf. ROS from wheels has neither tf2_ros nor tf2_msgs, so they are imported only when they are needed."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

from hand_pose_ros.errors import HandPoseError, InputError

TIMEOUT_S = 0.1
"""Maximum time that an image waits for the transform at its stamp."""


def tf_message() -> type:
    """The message type of /tf.

    Raises:
        HandPoseError: tf2_msgs is not installed.
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        raise HandPoseError('parameter publish_tf needs the package tf2_msgs, which is not installed here (ROS from '
                            'wheels has none): install it with ROS, or set publish_tf to false') from error
    return TFMessage


class TargetFrame:
    """Knows where the camera is in the target frame.

    Raises:
        HandPoseError: tf2_ros is not installed.
    """

    def __init__(self, node: Node, frame: str) -> None:
        try:
            import tf2_ros
        except ImportError as error:
            raise HandPoseError(f"parameter target_frame ('{frame}') needs the package tf2_ros, which is not installed "
                                'here (ROS from wheels has none): install it with ROS, or leave target_frame empty'
                                ) from error
        self._frame, self._error = frame, tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener: Any = tf2_ros.TransformListener(self._buffer, node)

    def lookup(self, header: Header) -> TransformStamped:
        """The transform from the frame of an image to the target frame, at the time of the image.

        Raises:
            InputError: the transform is not known.
        """
        try:
            return self._buffer.lookup_transform(self._frame, header.frame_id, Time.from_msg(header.stamp),
                                                 timeout=Duration(seconds=TIMEOUT_S))
        except self._error as error:
            raise InputError(f"where the camera ('{header.frame_id}') is in the target_frame '{self._frame}' is not "
                             f'known ({error}): publish the transform, or leave target_frame empty') from error

    def clear(self) -> None:
        """Forget moving transforms. Call this when time goes back: tf ignores transforms older than those it has."""
        self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
