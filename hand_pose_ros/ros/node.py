"""The node `estimator`: depth images in, hand joints out.

Callbacks only store data and signal. One worker thread takes the newest image, decodes it, estimates the hands and
publishes them.
"""

from __future__ import annotations

import gc
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import ChangeState
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from hand_pose_ros import ros
from hand_pose_ros.conventions import stamp_ns
from hand_pose_ros.depth import decode_compressed, decode_image, depth_problem
from hand_pose_ros.detection import Region
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.models.checkpoints import DEFAULT
from hand_pose_ros.ros import params as parameters
from hand_pose_ros.ros import qos, topics
from hand_pose_ros.ros.camera import Camera, Closed
from hand_pose_ros.ros.diagnostics import Complaints, Statistics
from hand_pose_ros.ros.outputs import Outputs
from hand_pose_ros.ros.worker import NewestWorker

_Transition = Callable[['EstimatorNode', LifecycleState], TransitionCallbackReturn]
QOS = 'qos_overrides.'
"""Parameters with this prefix are declared when the node subscribes to their topic."""
SILENCE_S = 5.0
"""If no image arrives for this time, there is a warning."""
BACK_NS = 100_000_000
"""If an image is older than the one before it by more than this, a bag has started again. When clocks are corrected, or
images overtake each other, it is less."""


def _logged(transition: _Transition) -> _Transition:
    """Log why a transition failed. rclpy itself swallows exceptions."""
    def wrapper(self: EstimatorNode, state: LifecycleState) -> TransitionCallbackReturn:
        self._statistics.failure = ''
        try:
            return transition(self, state)
        except HandPoseError as error:
            result, self._statistics.failure = TransitionCallbackReturn.FAILURE, str(error)
        except Exception:
            result = TransitionCallbackReturn.ERROR
            if not self.context.ok():  # after Ctrl-C, there is nothing to do or to log
                return result
            self._statistics.failure = f'unexpected error, please report it:\n{traceback.format_exc()}'
        self._stop()
        self.get_logger().error(self._statistics.failure)
        return result
    return wrapper


class EstimatorNode(LifecycleNode):
    """A lifecycle node that configures and activates itself unless the parameter `autostart` is false."""

    def __init__(self, **kwargs: Any) -> None:
        self._statistics, self._complaints = Statistics(), Complaints()
        self._estimator: HandPoseEstimator | None = None
        self._worker: NewestWorker[Image | CompressedImage] | None = None
        self._inputs: list[Subscription] = []
        self._latched: Subscription | None = None  # to a camera_info that was published before the node came
        self._published = False  # whether anybody publishes images that can arrive
        self._info_stamp = -1  # of the newest camera_info, ns
        self._last_header = Header()  # of the image before
        self._reset = False  # a reset was requested; the worker does it, since only the worker uses the estimator
        super().__init__('estimator', **kwargs)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        self._params = parameters.declare(self)
        for name in parameters.unknown(self):
            if not name.startswith(QOS):
                self.get_logger().warning(f"there is no parameter '{name}', so it has no effect: "
                                          'hand-pose estimator --parameters lists all')
        self.add_on_set_parameters_callback(self._on_parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', qos.RESULTS)
        self.create_service(SetBool, '~/enable', self._on_enable)
        self.create_service(Trigger, '~/reset', self._on_reset)
        # A steady clock: if simulated time stands still, the node must still report it.
        self.create_timer(1.0, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self._params.autostart:
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()
            elif self.context.ok():
                self.get_logger().error('so the node does nothing: correct this and configure it, or start it anew')

    # Lifecycle

    @_logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the network and create the publishers."""
        estimator = self._params.make_estimator()
        self._outputs = Outputs(self, estimator, self._params, self._complain)
        self._image_topic, info_topic = topics.input_topics(self, self._params.transport)
        self._camera = Camera(info_topic)
        self._regions: list[Region] = []
        self._right_scale = 0.0  # depth_scale at which a hand was seen
        self._estimator = estimator
        return super().on_configure(state)

    @_logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to listen, and publish what the joints mean."""
        super().on_activate(state)
        self._start()
        self._outputs.publish_skeleton()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening, finish the current image, and delete the markers."""
        self._stop()
        return super().on_deactivate(state)

    @_logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the network and its memory."""
        self._release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything, in any state."""
        self._release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to unconfigured. From there, the node can be configured again."""
        self._release()
        return super().on_error(state)

    def destroy_node(self) -> None:
        """Stop the worker before its publishers are destroyed."""
        self._release()
        super().destroy_node()

    def _release(self) -> None:
        self._stop()
        if self._estimator is None:
            return
        self._estimator = None
        self._outputs.close()
        gc.collect()
        if (torch := sys.modules.get('torch')) is not None and torch.cuda.is_available():
            torch.cuda.empty_cache()

    def _start(self) -> None:
        raw = self._params.transport == 'raw'
        self._image_type, self._decode = (Image, decode_image) if raw else (CompressedImage, decode_compressed)
        self._camera.open()
        self._reset = True  # the hands that are there now may be others than before
        self._heard_at, self._statistics.silence = time.monotonic(), ''
        inputs = [(CameraInfo, self._camera.topic, self._on_camera_info),
                  (self._image_type, self._image_topic, self._on_image)]
        if self._params.detector == 'region':
            inputs.append((RegionOfInterest, self.resolve_topic_name(topics.REGION), self._on_region))
        for kind, topic, callback in inputs:
            self._inputs.append(topics.subscribe(self, kind, topic, callback, self._complain))
        for name in parameters.unknown(self):
            if name.startswith(QOS):
                self._say(f"there is no parameter '{name}', so it has no effect: history, depth and reliability of "
                          f'{", ".join(topic for _, topic, _ in inputs)} can be set')
        self._worker = NewestWorker(self._answer)
        self.get_logger().info(f'listening to {", ".join(sorted(listener.topic_name for listener in self._inputs))}')

    def _stop(self) -> None:
        while self._inputs:
            self.destroy_subscription(self._inputs.pop())
        if self._latched is not None:
            self.destroy_subscription(self._latched)
            self._latched = None
        if self._worker is None:
            return
        self._camera.close()
        self._worker.stop()
        self._worker = None
        try:
            self._outputs.clear(self._last_header)
        except RuntimeError:  # RCLError: after Ctrl-C, a thread of rclpy shuts down, and nothing can be published
            if self.context.ok():
                raise

    # Callbacks

    def _on_image(self, image: Image | CompressedImage) -> None:
        self._heard_at, self._statistics.silence = time.monotonic(), ''
        dropped = int(self._worker is not None and self._worker.put(image))
        self._statistics.count(received=1, dropped=dropped, waited=int(dropped and self._camera.waiting))

    def _on_camera_info(self, info: CameraInfo) -> None:
        stamp = stamp_ns(info.header)  # openni2_camera publishes each one twice, for its raw and for its metric images
        self._statistics.count(camera_infos=int(stamp != self._info_stamp))
        self._info_stamp = stamp
        self._camera.update(info)

    def _on_region(self, region: RegionOfInterest) -> None:
        self._regions = [(region.x_offset, region.y_offset, region.width, region.height)]

    def _on_parameters(self, changes: Sequence[Parameter]) -> SetParametersResult:
        try:
            self._params = parameters.changed(self._params, changes, configured=self._estimator is not None)
        except HandPoseError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            return self._change_state(request, response)
        except RuntimeError:  # RCLError: with rclpy up to Jazzy, an invalid transition would end the node
            wanted = request.transition.label or request.transition.id
            self.get_logger().error(f'there is no transition {wanted} from the state {self._state}: ask for one that '
                                    f'`ros2 lifecycle list {self.get_fully_qualified_name()}` names')
            response.success = False
            return response

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._state not in ('active', 'disabled'):
            response.message = f'the node is {self._state}: activate it first'
            return response
        if request.data and self._worker is None:
            self._start()
        elif not request.data:
            self._stop()
        response.success, response.message = True, 'enabled' if request.data else 'disabled'
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset = True
        response.success, response.message = True, 'tracked hands will be forgotten before the next image'
        return response

    def _on_timer(self) -> None:
        listening = self._worker is not None
        published = listening and topics.can_arrive(self, self._image_topic, self._image_type)
        if published and not self._published:  # a publisher that has just started, such as a bag, may take time
            self._heard_at, self._statistics.silence = time.monotonic(), ''
        self._published = published
        if listening and self._latched is None:
            self._latched = topics.subscribe_latched(self, CameraInfo, self._camera.topic, self._camera.update)
        if listening and time.monotonic() - self._heard_at > SILENCE_S:
            silence = topics.explain_silence(self, self._image_topic, self._image_type, SILENCE_S)
            if silence != self._statistics.silence:  # the publishers may have changed, and so has the remedy
                self._statistics.silence = silence
                self._statistics.problem(silence)
            self._say(silence)
        if listening and self.count_publishers(self._outputs.joints_topic) > 1:
            self._complain(f'somebody else publishes {self._outputs.joints_topic}, too: stop one of them, or give each '
                           'a namespace (--ros-args -r __ns:=/left)')
        name = self.get_fully_qualified_name().lstrip('/')  # nodes of other namespaces report there, too
        status = self._statistics.report(name, self._state, published, self._facts())
        if status.level == DiagnosticStatus.WARN:
            self._say(status.message)
        if self._params.publish_diagnostics:
            now = Header(stamp=self.get_clock().now().to_msg())
            self._diagnostics.publish(DiagnosticArray(header=now, status=[status]))

    def _facts(self) -> dict[str, str]:
        facts = {'model': self._params.model or DEFAULT, 'detector': self._params.detector}
        if self._estimator is not None:
            facts['engine'] = self._estimator.engine.name
        if self._worker is not None:
            facts |= {'image': f'{self._image_topic} {topics.describe_publishers(self, self._image_topic)}',
                      'intrinsics': self._camera.source(self._params)}
        return facts

    @property
    def _state(self) -> str:
        state = self._state_machine.current_state[1]
        return 'disabled' if state == 'active' and self._worker is None else state

    def _complain(self, problem: str) -> None:
        self._statistics.problem(problem)
        self._say(problem)

    def _say(self, problem: str) -> None:
        if self._complaints.is_news(problem):
            self.get_logger().warning(problem)

    # The worker

    def _answer(self, image: Image | CompressedImage) -> None:
        """Process one image and publish the answer. An error is reported, and the next image is processed as usual."""
        try:
            start = time.perf_counter()
            params = self._params  # for this image, even if parameters are set meanwhile
            depth = self._decode(image, params.depth_scale, source=self._image_topic)
            self._statistics.time(decode=time.perf_counter() - start)
            intrinsics = self._camera.intrinsics(depth.shape[1], depth.shape[0], params)
            hands = self._estimate(image.header, depth, intrinsics, params)
            try:
                self._outputs.publish_joints(image.header, hands)
                self._statistics.time(total=time.perf_counter() - start)
                self._statistics.age(self.get_clock().now().nanoseconds - stamp_ns(image.header))
                self._statistics.count(answered=1, hands=len(hands))
            finally:  # even if the target frame is unknown: these outputs are in the frame of the camera
                self._outputs.publish_others(image.header, hands, depth, intrinsics, params)
        except Closed:  # the node was stopped before a camera_info came
            self._statistics.count(dropped=1)
        except HandPoseError as error:
            self._statistics.count(refused=1)
            self._complain(str(error))
        except Exception:
            if self.context.ok():  # if not, Ctrl-C came between two steps
                self._statistics.count(refused=1)
                self._complain(f'unexpected error on an image, please report it:\n{traceback.format_exc()}')

    def _estimate(self, header: Header, depth: NDArray[np.float32], intrinsics: Intrinsics,
                  params: parameters.Params) -> list[HandEstimate]:
        estimator = self._estimator
        regions = self._regions if params.detector == 'region' else None
        assert estimator is not None
        params.apply(estimator)
        began_again = stamp_ns(header) < stamp_ns(self._last_header) - BACK_NS
        if began_again:
            self._outputs.begin_again()
        if began_again or self._reset:
            self._reset = False
            estimator.reset()
        self._last_header = header
        if problem := self._camera.frame_problem(header.frame_id, params):
            self._complain(f'{self._image_topic}: {problem}')
        hands = estimator(depth, intrinsics, time_s=stamp_ns(header) / 1e9 or None, regions=regions)
        self._statistics.time(**estimator.timings)
        if hands:
            self._right_scale = params.depth_scale
            return hands
        problem = '' if regions is None else topics.region_problem(self, regions, depth.shape[1], depth.shape[0])
        problem = problem or depth_problem(
            depth, params.min_depth, params.max_depth, params.depth_scale == self._right_scale)
        if problem:
            self._complain(f'{self._image_topic}: {problem}')
        return hands


def main(args: list[str] | None = None) -> int:
    """Run the node until Ctrl-C or SIGTERM. Both are no error.

    Raises:
        HandPoseError: a parameter at start has a wrong type or value, or the ROS arguments cannot be used.
    """
    ros.init(args)
    executor, node = SingleThreadedExecutor(), None
    try:
        node = EstimatorNode()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        ros.shutdown()
    return 0
