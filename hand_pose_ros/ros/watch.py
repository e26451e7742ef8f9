"""Listen to a camera and to the node `estimator`, and pass on their messages, for `hand-pose view`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from hand_pose_ros import ros
from hand_pose_ros.bags import check_frame
from hand_pose_ros.conventions import stamp_ns
from hand_pose_ros.depth import decode_compressed, decode_image
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import qos, topics
from hand_pose_ros.ros.camera import Camera
from hand_pose_ros.ros.conversions import hand_from_msg
from hand_pose_ros.ros.diagnostics import Complaints
from hand_pose_ros.ros.params import Params
from hand_pose_ros.skeleton import Skeleton, get_skeleton

OnDepth = Callable[[int, NDArray[np.float32], Intrinsics], None]
OnHands = Callable[[int, list[HandEstimate], Skeleton], None]


def watch(on_depth: OnDepth, on_hands: OnHands, transport: str = 'raw', depth_scale: float = 0.001,
          intrinsics: Sequence[float] | None = None, ros_args: Sequence[str] = ()) -> None:
    """Until Ctrl-C, call `on_depth` for each depth image and `on_hands` for the hands of each image. Stamps are in ns.

    Args:
        transport, depth_scale: as the parameters of the node `estimator`.
        intrinsics: fx, fy, cx and cy in pixels, used instead of camera_info.
        ros_args: remappings (`-r from:=to`) and other ROS arguments.
    """
    ros.init(['--ros-args', *ros_args])
    try:
        _Watcher(on_depth, on_hands, transport, depth_scale, intrinsics).spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        ros.shutdown()


class _Watcher:
    """Node `view`. Messages that cannot be shown are left out with a warning."""

    def __init__(self, on_depth: OnDepth, on_hands: OnHands, transport: str, depth_scale: float,
                 intrinsics: Sequence[float] | None = None) -> None:
        self._node = rclpy.create_node('view')
        self._on_depth, self._on_hands = on_depth, on_hands
        fx, fy, cx, cy = intrinsics or (0.0, 0.0, 0.0, 0.0)
        self._params = Params(transport=transport, depth_scale=depth_scale, camera_info_timeout=0.0,
                              intrinsics_fx=fx, intrinsics_fy=fy, intrinsics_cx=cx, intrinsics_cy=cy)
        self._complaints = Complaints()
        self._frame = ''
        self._topic, info_topic = topics.input_topics(self._node, transport)
        self._camera = Camera(info_topic, 'give --intrinsics FX FY CX CY')
        image_type, self._decode = (Image, decode_image) if transport == 'raw' else (CompressedImage, decode_compressed)
        topics.subscribe(self._node, CameraInfo, info_topic, self._camera.update, self._complain)
        topics.subscribe(self._node, image_type, self._topic, self._image, self._complain)
        self._latched: Subscription | None = None  # to a camera_info that was published before the viewer came
        # A steady clock: this must also work while simulated time stands still.
        self._node.create_timer(1.0, self._listen_to_latched, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._node.create_subscription(HandJointsArray, 'hand/joints', self._hands, qos.RESULTS)
        self._hands_topic = self._node.resolve_topic_name('hand/joints')
        self._node.get_logger().info(f'showing {self._topic} and {self._hands_topic}')

    def spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        try:
            executor.spin()
        finally:
            self._node.destroy_node()

    def _listen_to_latched(self) -> None:
        if self._latched is None:
            self._latched = topics.subscribe_latched(self._node, CameraInfo, self._camera.topic, self._camera.update)

    def _image(self, image: Any) -> None:
        self._frame = image.header.frame_id
        try:
            depth = self._decode(image, self._params.depth_scale, source=self._topic)
            intrinsics = self._camera.intrinsics(depth.shape[1], depth.shape[0], self._params)
        except InputError as error:
            self._complain(str(error))
        else:
            self._on_depth(stamp_ns(image.header), depth, intrinsics)

    def _hands(self, message: HandJointsArray) -> None:
        try:
            skeleton = get_skeleton(message.skeleton)
            check_frame(self._hands_topic, message.header.frame_id, self._frame)
            hands = [hand_from_msg(hand, skeleton) for hand in message.hands]
        except HandPoseError as error:
            self._complain(f'hands cannot be shown: {error}')
        else:
            self._on_hands(stamp_ns(message.header), hands, skeleton)

    def _complain(self, problem: str) -> None:
        if self._complaints.is_news(problem):
            self._node.get_logger().warning(problem)
