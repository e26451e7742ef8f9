"""All that the node publishes about hands: always the joints, and the rest on request."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from hand_pose_ros.conventions import CROP
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.geometry import Intrinsics, crop
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.markers import HandMarkers
from hand_pose_ros.models.checkpoints import described
from hand_pose_ros.msg import HandJointsArray, HandSkeleton
from hand_pose_ros.ros import conversions, qos
from hand_pose_ros.ros.frames import TargetFrame, tf_message
from hand_pose_ros.ros.params import Params


class Outputs:
    """The publishers of a configured node.

    Raises:
        HandPoseError: a parameter needs something that this ROS, or this model, does not have.
    """

    def __init__(self, node: LifecycleNode, estimator: HandPoseEstimator, params: Params,
                 complain: Callable[[str], None]) -> None:
        skeleton = estimator.skeleton
        if params.publish_joint_states and skeleton.name != 'hand21':
            raise HandPoseError('parameter publish_joint_states needs a model with the joints of hand21, but '
                                f"{params.model or 'the default'} has those of {skeleton.name}: choose another model")
        tf = tf_message() if params.publish_tf else None
        self._frame = TargetFrame(node, params.target_frame) if params.target_frame else None
        self._node, self._complain = node, complain
        self._publishers: list[Any] = []
        self._skeleton, self._metadata, self._markers = skeleton, estimator.metadata, HandMarkers(skeleton)
        self._joints_pub = self._create(HandJointsArray, 'hand/joints')
        self._markers_pub = self._create(MarkerArray, 'hand/markers')
        self._skeleton_pub = self._create(HandSkeleton, 'hand/skeleton', qos.LATCHED)
        self._crop_pub = self._create(Image, f'~/{CROP}')
        self._poses_pub = self._create(PoseArray, 'hand/poses') if params.publish_poses else None
        self._states_pub = self._create(JointState, 'hand/joint_states') if params.publish_joint_states else None
        self._tf_pub = self._create(tf, '/tf', qos.TF) if tf else None

    @property
    def joints_topic(self) -> str:
        """The resolved name of the topic of the joints."""
        return str(self._joints_pub.topic_name)

    def publish_skeleton(self) -> None:
        """Publish what the joints mean."""
        now = Header(stamp=self._node.get_clock().now().to_msg())
        self._skeleton_pub.publish(conversions.skeleton_to_msg(now, self._skeleton, *described(self._metadata)))

    def publish_joints(self, header: Header, hands: Sequence[HandEstimate]) -> None:
        """Publish the joints, in the target frame if there is one. They come first, because others wait for them.

        Raises:
            InputError: the transform to the target frame is not known. Nothing was published.
        """
        message = conversions.hands_to_msg(header, hands, self._skeleton)
        if self._frame is not None:
            message = conversions.in_frame(message, self._frame.lookup(header))
        self._joints_pub.publish(message)
        if self._poses_pub is not None:
            self._poses_pub.publish(conversions.poses_to_msg(message))

    def publish_others(self, header: Header, hands: Sequence[HandEstimate], depth: NDArray[np.float32],
                       intrinsics: Intrinsics, params: Params) -> None:
        """Publish all the rest, in the frame of the camera. Viewers and tf know where this frame is."""
        if self._states_pub is not None and hands:
            self._states_pub.publish(conversions.joint_states_to_msg(header, hands))
        if self._tf_pub is not None and hands:
            if header.frame_id:
                transforms = conversions.transforms_to_msgs(header, hands, self._node.get_namespace())
                self._tf_pub.publish(self._tf_pub.msg_type(transforms=transforms))
            else:
                self._complain('the frame_id of the depth image is empty, so the joints have no place in tf: let the '
                               'camera driver set it')
        if not params.publish_markers:
            if shown := self._markers.clear():  # markers have just been switched off
                self._markers_pub.publish(conversions.markers_to_msg(header, shown, 0.0))
        elif self._markers_pub.get_subscription_count():
            markers = self._markers.update(hands)
            self._markers_pub.publish(conversions.markers_to_msg(header, markers, params.marker_lifetime))
        if hands and self._crop_pub.get_subscription_count():
            self._crop_pub.publish(conversions.patch_to_msg(header, crop(depth, hands[0].cube, intrinsics)))

    def begin_again(self) -> None:
        """Forget old transforms. Call this when time goes back, for example when a bag is played in a loop."""
        if self._frame is not None:
            self._frame.clear()

    def clear(self, header: Header) -> None:
        """Delete the markers of all hands."""
        self._markers_pub.publish(conversions.markers_to_msg(header, self._markers.clear(), 0.0))

    def close(self) -> None:
        """Destroy the publishers."""
        if self._frame is not None:
            self._frame.close()
        for publisher in self._publishers:
            self._node.destroy_lifecycle_publisher(publisher)

    def _create(self, kind: type, topic: str, profile: QoSProfile = qos.RESULTS) -> Any:
        self._publishers.append(self._node.create_lifecycle_publisher(kind, topic, profile))
        return self._publishers[-1]
