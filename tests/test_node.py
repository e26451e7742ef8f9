"""How the node answers images: each once, with its stamp and frame, the newest first. The real node, over real DDS."""

import threading
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from visualization_msgs.msg import Marker, MarkerArray

from hand_pose_ros.depth import encode_compressed
from hand_pose_ros.msg import HandJointsArray, HandSkeleton
from hand_pose_ros.ros import conversions
from hand_pose_ros.ros.node import EstimatorNode
from hand_pose_ros.ros.topics import input_topics
from hand_pose_ros.ros.worker import NewestWorker
from hand_pose_ros.skeleton import HAND21

pytestmark = pytest.mark.usefixtures('ros_domain', 'load_once')

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def depth_with_hand(z: float = 0.6) -> np.ndarray:
    """(H, W) metres: a hand-sized disc before a far wall."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    disc = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) < 0.06 * FOCAL / z
    return np.where(disc, z, 3.0).astype(np.float32)


def image(depth: np.ndarray, stamp: int = 1, frame: str = 'camera_optical', encoding: str = '16UC1') -> Image:
    """A sensor_msgs/Image of a depth image in metres; `stamp` in milliseconds."""
    data = (depth * 1000).astype(np.uint16) if encoding == '16UC1' else depth.astype(np.float32)
    message = Image(height=depth.shape[0], width=depth.shape[1], encoding=encoding, step=data.strides[0],
                    data=array('B', data.tobytes()))
    return stamped(message, stamp, frame)


def camera_info(width: int = WIDTH, height: int = HEIGHT, focal: float = FOCAL) -> CameraInfo:
    k = [focal, 0.0, width / 2, 0.0, focal, height / 2, 0.0, 0.0, 1.0]
    return stamped(CameraInfo(width=width, height=height, k=k), 1)


def stamped(message, stamp: int, frame: str = 'camera_optical'):
    message.header.stamp.sec, message.header.stamp.nanosec = stamp // 1000, stamp % 1000 * 1_000_000
    message.header.frame_id = frame
    return message


def stamp_of(message) -> int:
    return message.header.stamp.sec * 1000 + message.header.stamp.nanosec // 1_000_000


class Rig:
    """The node under test, and a camera and a listener in a node of their own, each with its executor and thread."""

    def __init__(self, weights: Path) -> None:
        self.weights = weights
        self.context = rclpy.Context()
        self.context.init()
        self.client = Node('client', context=self.context)
        self.received: dict[type, list] = {}
        self.listen(HandJointsArray, 'hand/joints', RELIABLE)
        self.listen(MarkerArray, 'hand/markers', RELIABLE)
        self.listen(DiagnosticArray, '/diagnostics', RELIABLE)
        self.listen(Log, '/rosout', QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.executors, self.threads, self.done = [], [], Future()
        self.node: EstimatorNode | None = None
        self.spin(self.client)

    def listen(self, kind: type, topic: str, qos: QoSProfile) -> None:
        self.client.create_subscription(kind, topic, self.received.setdefault(kind, []).append, qos)

    def spin(self, node: Node) -> None:
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin_until_future_complete, args=(self.done,), daemon=True)
        thread.start()
        self.executors.append(executor)
        self.threads.append(thread)

    def start(self, *remaps: str, **parameters) -> EstimatorNode:
        """The node, with `min_score` 0: an untrained network is never sure. And what is shown to it is just something
        near, which the network that finds hands need not take for one."""
        parameters = {'model': str(self.weights), 'min_score': 0.0, 'detector': 'nearest', 'num_threads': 1,
                      **parameters}
        arguments = [word for rule in remaps for word in ('-r', rule)]
        overrides = [Parameter(name.replace('__', '.'), value=value) for name, value in parameters.items()]
        self.node = EstimatorNode(context=self.context, parameter_overrides=overrides,
                                  cli_args=['--ros-args', *arguments] if arguments else None)
        self.spin(self.node)
        return self.node

    def camera(self, qos: QoSProfile = BEST_EFFORT, kind: type = Image, topic: str = 'depth/image_rect',
               info: CameraInfo | None = None) -> Callable[[object], None]:
        """Connect a camera that publishes its camera_info (if any) before each image, and return its `publish`."""
        images = self.client.create_publisher(kind, topic, qos)
        self.connected(images)
        if info is None:
            return images.publish
        infos = self.client.create_publisher(CameraInfo, 'depth/camera_info', qos)
        self.connected(infos)

        def publish(message) -> None:
            infos.publish(info)
            images.publish(message)
        return publish

    def connected(self, publisher) -> None:
        """Both ends must know each other: what is sent earlier, best effort, is lost."""
        self.until(lambda: publisher.get_subscription_count() and self.client.count_publishers('/hand/joints')
                   and (self.node is None or any(sub.topic_name.endswith(publisher.topic_name)
                                                 and sub.get_publisher_count() for sub in self.node.subscriptions)))

    def until(self, condition: Callable[[], object], what: str = 'it', seconds: float = 60.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f'waited in vain for {what}; the node said: {self.said()}'
            time.sleep(0.002)

    def answer(self, publish: Callable[[object], None], message) -> HandJointsArray:
        """Publish one image and return the answer to it."""
        answers = self.received[HandJointsArray]
        before = len(answers)
        publish(message)
        self.until(lambda: len(answers) > before, 'an answer')
        return answers[-1]

    def said(self) -> list[str]:
        return [log.msg for log in self.received[Log] if log.name.endswith('estimator')]

    def until_said(self, *words: str) -> None:
        self.until(lambda: any(all(word in text for word in words) for text in self.said()), f'a sentence with {words}')

    def call(self, kind: type, service: str, **fields):
        client = self.client.create_client(kind, f'/estimator/{service}')
        assert client.wait_for_service(60)
        return self.result(client.call_async(kind.Request(**fields)))

    def result(self, future):
        self.until(future.done, 'a service')
        return future.result()

    def transition(self, label: str) -> bool:
        request = ChangeState.Request()
        request.transition.label = label
        return self.call(ChangeState, 'change_state', transition=request.transition).success

    def state(self) -> str:
        return self.call(GetState, 'get_state').current_state.label

    def set_parameter(self, name: str, value) -> tuple[bool, str]:
        client = AsyncParameterClient(self.client, 'estimator')
        assert client.wait_for_services(60)
        result = self.result(client.set_parameters([Parameter(name, value=value)])).results[0]
        return result.successful, result.reason

    def close(self) -> None:
        self.done.set_result(None)  # to shut down the executor first would destroy what its thread waits with
        for thread in self.threads:
            thread.join()
        for executor in self.executors:
            executor.shutdown()
        for node in (self.node, self.client):
            if node is not None:
                node.destroy_node()
        self.context.shutdown()


@pytest.fixture
def rig(weights: Path, ros_domain: int) -> Iterator[Rig]:
    rig = Rig(weights)
    yield rig
    rig.close()


@pytest.mark.parametrize('qos', [BEST_EFFORT, RELIABLE], ids=['best effort', 'reliable'])
def test_every_image_is_answered_once_with_its_own_stamp_and_frame(rig: Rig, qos: QoSProfile) -> None:
    rig.start()
    publish = rig.camera(qos, info=camera_info())
    for i in range(20):
        rig.answer(publish, image(depth_with_hand(), 1000 + 33 * i, f'frame_{i}'))
    time.sleep(0.1)
    answers = rig.received[HandJointsArray]
    assert [(stamp_of(a), a.header.frame_id) for a in answers] == [(1000 + 33 * i, f'frame_{i}') for i in range(20)]
    hand = answers[-1].hands[0]
    assert answers[-1].skeleton == 'hand21'
    assert len(hand.joints) == len(hand.confidence) == 21
    assert all(0 <= c <= 1 for c in hand.confidence)
    assert hand.cube_size == pytest.approx(0.3)
    # The cube is where the hand is: straight ahead at 0.6 m.
    assert (hand.cube_center.x, hand.cube_center.y, hand.cube_center.z) == pytest.approx((0, 0, 0.6), abs=0.15)


def test_no_hand_is_an_empty_answer_and_takes_the_markers_away(rig: Rig) -> None:
    rig.start(marker_lifetime=2.0)
    publish = rig.camera(info=camera_info())
    hand = rig.answer(publish, image(depth_with_hand(), 1)).hands[0]
    rig.until(lambda: rig.received[MarkerArray], 'markers')
    shown = {(m.ns, m.id): m for m in rig.received[MarkerArray][-1].markers}
    joints, bones = shown[f'{hand.id}/joints', 0], shown[f'{hand.id}/bones', 0]
    assert (joints.type, len(joints.points), len(joints.colors)) == (Marker.SPHERE_LIST, 21, 21)
    assert (bones.type, len(bones.points), len(bones.colors)) == (Marker.LINE_LIST, 40, 40)
    assert all(m.action == Marker.ADD and m.lifetime.sec == 2 and m.header.frame_id == 'camera_optical'
               for m in shown.values())

    nothing = rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0), 2))
    assert stamp_of(nothing) == 2 and nothing.hands == []
    rig.until(lambda: len(rig.received[MarkerArray]) > 1, 'deletions')
    deleted = rig.received[MarkerArray][1].markers
    assert {(m.ns, m.id) for m in deleted} == set(shown) and all(m.action == Marker.DELETE for m in deleted)

    rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0), 3))
    rig.until(lambda: len(rig.received[MarkerArray]) > 2)
    assert rig.received[MarkerArray][2].markers == []  # and once is enough

    rig.answer(publish, image(depth_with_hand(), 4))
    assert rig.set_parameter('publish_markers', False)[0]
    rig.answer(publish, image(depth_with_hand(), 5))
    rig.until(lambda: len(rig.received[MarkerArray]) > 4, 'deletions')
    assert all(m.action == Marker.DELETE for m in rig.received[MarkerArray][4].markers)


def test_a_late_joiner_still_learns_the_skeleton(rig: Rig) -> None:
    rig.start()
    rig.answer(rig.camera(info=camera_info()), image(depth_with_hand()))
    rig.listen(HandSkeleton, 'hand/skeleton', LATCHED)
    rig.until(lambda: rig.received[HandSkeleton], 'the skeleton')
    skeleton = rig.received[HandSkeleton][0]
    assert skeleton.name == 'hand21' and tuple(skeleton.joint_names) == HAND21.joint_names
    assert tuple(skeleton.parents) == HAND21.parents


def test_compressed_depth_is_answered_and_damage_is_named(rig: Rig) -> None:
    rig.start(transport='compressedDepth')
    publish = rig.camera(kind=CompressedImage, topic='depth/image_rect/compressedDepth', info=camera_info())
    for codec in ('png', 'rvl'):
        layout, data = encode_compressed(depth_with_hand(), codec)
        message = stamped(CompressedImage(format=layout, data=array('B', data)), 5, codec)
        answer = rig.answer(publish, message)
        assert len(answer.hands) == 1 and answer.header.frame_id == codec
    rig.answer(publish, message)
    publish(CompressedImage(format='16UC1; compressedDepth png', data=array('B', data[:40])))
    rig.until_said('/depth/image_rect/compressedDepth', 'PNG')
    rig.answer(publish, message)


def test_a_topic_may_be_named_with_its_transport(rig: Rig) -> None:
    """As `ros2 topic list` shows it."""
    rig.start('depth/image_rect:=/a/b/compressedDepth', transport='compressedDepth')
    publish = rig.camera(kind=CompressedImage, topic='/a/b/compressedDepth')
    infos = rig.client.create_publisher(CameraInfo, '/a/camera_info', RELIABLE)
    rig.connected(infos)
    infos.publish(camera_info())
    layout, data = encode_compressed(depth_with_hand())
    assert len(rig.answer(publish, stamped(CompressedImage(format=layout, data=array('B', data)), 5, 'x')).hands) == 1


@pytest.mark.parametrize('remaps, transport, topics', [
    ((), 'raw', ('/depth/image_rect', '/depth/camera_info')),
    (('depth/image_rect:=/a/b', 'depth/camera_info:=/c/info'), 'raw', ('/a/b', '/c/info')),
    (('depth/camera_info:=/c/info',), 'compressed', ('/depth/image_rect/compressed', '/c/info')),
    (('depth/image_rect:=/a/compressed',), 'raw', ('/a/compressed', '/a/camera_info')),
    (('depth/image_rect:=/a/compressed',), 'compressed', ('/a/compressed', '/camera_info')),
    (('__ns:=/left',), 'raw', ('/left/depth/image_rect', '/left/depth/camera_info'))])
def test_the_names_of_the_topics_follow_what_is_remapped(remaps: tuple[str, ...], transport: str,
                                                         topics: tuple[str, str]) -> None:
    context = rclpy.Context()
    context.init()
    node = Node('any', context=context, cli_args=['--ros-args', *(word for rule in remaps for word in ('-r', rule))])
    assert input_topics(node, transport) == topics
    node.destroy_node()
    context.shutdown()


def test_a_bag_that_begins_again_is_a_new_hand(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    ids = [rig.answer(publish, image(depth_with_hand(), stamp)).hands[0].id
           for stamp in (1000, 1033, 1032, 1066, 900, 933)]  # the third overtook another, or the clock was corrected
    assert len(set(ids[:4])) == 1 and ids[3] != ids[4] == ids[5]


def test_smoothing_holds_a_hand_still_that_jumps(rig: Rig) -> None:
    rig.start(smoothing=0.5)
    publish = rig.camera(info=camera_info())
    tip = HAND21.joint_names.index('index_tip')

    def jump(seconds: float = 0.033) -> float:
        before, after = (rig.answer(publish, image(depth_with_hand(z), stamp)).hands[0].joints[tip].z
                         for z, stamp in ((0.6, 1000), (0.62, 1000 + round(1000 * seconds))))
        return abs(after - before)

    smooth, slow = jump(), jump(seconds=4.0)  # by the stamps
    assert rig.set_parameter('smoothing', 0.0)[0]
    assert smooth < 0.5 * jump() < slow


def test_camera_info_that_was_published_once_before_the_node_came_is_taken(rig: Rig) -> None:
    rig.client.create_publisher(CameraInfo, 'depth/camera_info', LATCHED).publish(camera_info())
    rig.start()
    publish, answers = rig.camera(), rig.received[HandJointsArray]

    def answered() -> bool:  # the first images may come before it
        publish(image(depth_with_hand()))
        time.sleep(0.05)
        return bool(answers)
    rig.until(answered, 'an answer')
    assert answers[0].hands
    # One that is published all the time is heard beside it, without a word about quality of service.
    rig.until(lambda: rig.node._latched, 'the node to listen to what is kept')
    assert rig.transition('deactivate') and not list(rig.node.subscriptions) and rig.transition('activate')
    rig.until(lambda: rig.node._latched in rig.node.subscriptions, 'the node to listen to it again')
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', BEST_EFFORT)
    rig.connected(infos)
    before = len(answers)

    def answered_again() -> bool:  # what is kept may come once more after the first of these
        infos.publish(camera_info(WIDTH // 2, HEIGHT // 2, FOCAL / 2))
        publish(image(depth_with_hand()[::2, ::2]))
        time.sleep(0.05)
        return len(answers) > before
    rig.until(answered_again, 'an answer')
    assert answers[-1].hands
    assert rig.transition('deactivate') and rig.transition('activate')
    rig.until(lambda: sum('listening to' in text for text in rig.said()) == 3, 'to hear all that was said before')
    assert not any('incompatible' in text for text in rig.said())


def test_an_image_waits_for_the_camera_info_that_comes_after_it(rig: Rig) -> None:
    rig.start(camera_info_timeout=5.0)
    publish = rig.camera()
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    publish(image(depth_with_hand(), 7))
    infos.publish(camera_info())
    rig.until(lambda: rig.received[HandJointsArray], 'the answer')
    # The camera changes its resolution, and the image is here before its camera_info.
    publish(image(depth_with_hand()[::2, ::2], 8))
    infos.publish(camera_info(WIDTH // 2, HEIGHT // 2, FOCAL / 2))
    rig.until(lambda: len(rig.received[HandJointsArray]) == 2, 'the second answer')
    first, second = (answer.hands[0].cube_center for answer in rig.received[HandJointsArray])
    assert (first.x, first.y, first.z) == pytest.approx((second.x, second.y, second.z), abs=0.2)


def test_a_slow_network_gets_the_newest_image_never_a_queue(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    node = rig.start()
    publish = rig.camera(RELIABLE, info=camera_info())
    rig.answer(publish, image(depth_with_hand(), 1))
    entered, go = threading.Event(), threading.Event()
    convert = conversions.hands_to_msg

    def slow(*arguments) -> HandJointsArray:
        entered.set()
        go.wait(60)
        return convert(*arguments)

    monkeypatch.setattr(conversions, 'hands_to_msg', slow)
    publish(image(depth_with_hand(), 2))
    assert entered.wait(60)
    for stamp in range(3, 10):
        publish(image(depth_with_hand(), stamp))
        rig.until(lambda n=stamp: node._statistics._totals['received'] == n, f'image {stamp}')
    go.set()
    rig.until(lambda: len(rig.received[HandJointsArray]) == 3)
    time.sleep(0.1)
    assert [stamp_of(a) for a in rig.received[HandJointsArray]] == [1, 2, 9]
    go.clear()
    rig.until(lambda: publish(image(depth_with_hand(), 10)) or any('too slow' in text for text in rig.said()),
              'the log to say so')
    go.set()


def test_to_stop_is_to_finish_what_is_in_flight_and_to_forget_what_waits() -> None:
    entered, go, done = threading.Event(), threading.Event(), []

    def handle(item: int) -> None:
        entered.set()
        go.wait(60)
        done.append(item)

    worker = NewestWorker(handle)
    assert not worker.put(1) and entered.wait(60) and not worker.put(2)
    stopping = threading.Thread(target=lambda: (worker.stop(), done.append('stopped')))
    stopping.start()
    stopping.join(0.1)  # in which it must not end
    go.set()
    stopping.join()
    assert done == [1, 'stopped']
