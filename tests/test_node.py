"""What the node promises: the real node, over real DDS."""

import functools
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from hand_pose_ros import estimator as estimator_module
from hand_pose_ros.depth import encode_compressed
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import save_checkpoint
from hand_pose_ros.msg import HandJointsArray, HandSkeleton
from hand_pose_ros.ros import conversions
from hand_pose_ros.ros import node as node_module
from hand_pose_ros.ros.node import EstimatorNode
from hand_pose_ros.ros.topics import input_topics
from hand_pose_ros.ros.worker import NewestWorker
from hand_pose_ros.skeleton import HAND21

pytestmark = pytest.mark.usefixtures('ros_domain')

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
COMMAND = [sys.executable, '-m', 'hand_pose_ros.cli']
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope='module')
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that has learned nothing: what it says does not matter here, only that it says something."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp('weights') / 'untrained.safetensors'
    save_checkpoint(path, build('deep_prior', joints=21), {'skeleton': 'hand21', 'cube_side': 0.3})
    return path


@pytest.fixture(scope='module', autouse=True)
def _load_once() -> Iterator[None]:
    """Many nodes are started here, with the same weights: loading them each time would take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ('load_checkpoint', 'make_engine'):
            patch.setattr(estimator_module, name, functools.cache(getattr(estimator_module, name)))
        yield


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

    def until(self, condition: Callable[[], object], what: str = 'it', seconds: float = 10.0) -> None:
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
        assert client.wait_for_service(5)
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
        assert client.wait_for_services(5)
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


@pytest.mark.parametrize('encoding', ['16UC1', '32FC1'])
def test_both_encodings_give_the_same_hand(rig: Rig, encoding: str) -> None:
    rig.start(tracking=False)
    answer = rig.answer(rig.camera(info=camera_info()), image(depth_with_hand(), encoding=encoding))
    assert len(answer.hands) == 1


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


def test_compressed_depth(rig: Rig) -> None:
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


def test_a_remapped_image_takes_its_camera_info_along(rig: Rig) -> None:
    rig.start('depth/image_rect:=/front/depth/image_raw')
    publish = rig.camera(topic='/front/depth/image_raw')
    infos = rig.client.create_publisher(CameraInfo, '/front/depth/camera_info', RELIABLE)
    rig.connected(infos)
    infos.publish(camera_info())
    assert rig.answer(publish, image(depth_with_hand())).hands


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


def test_lifecycle(rig: Rig) -> None:
    node = rig.start(autostart=False)
    assert rig.state() == 'unconfigured'
    assert rig.client.count_publishers('/hand/joints') == 0
    assert rig.transition('configure') and rig.state() == 'inactive'
    assert not rig.call(SetBool, 'enable', data=True).success
    for _ in range(2):
        assert rig.transition('activate')
        publish = rig.camera(info=camera_info())
        rig.answer(publish, image(depth_with_hand()))
        assert rig.transition('deactivate') and rig.state() == 'inactive'
        assert rig.client.count_subscribers('/depth/image_rect') == 0
    estimator = weakref.ref(node._estimator)
    assert rig.transition('cleanup') and rig.state() == 'unconfigured'
    assert estimator() is None, 'the network must be gone after cleanup'
    assert rig.transition('configure') and rig.transition('activate')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands
    assert rig.transition('shutdown') and rig.state() == 'finalized'


def test_a_transition_out_of_place_is_refused(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    node = rig.start()
    monkeypatch.setattr(node, '_LifecycleNodeMixin__change_state',  # up to Jazzy rclpy raises what this does
                        lambda number: node._state_machine.trigger_transition_by_id(number, True))
    assert not rig.call(ChangeState, 'change_state', transition=Transition(id=Transition.TRANSITION_ACTIVATE)).success
    rig.until_said('there is no transition 3 from the state active', 'ros2 lifecycle list /estimator')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def test_unknown_weights_are_named_and_can_be_corrected(rig: Rig) -> None:
    rig.start(model='/nowhere/weights.safetensors')
    assert rig.state() == 'unconfigured'
    rig.until_said('/nowhere/weights.safetensors')
    rig.until_said('the node does nothing')
    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and reports[-1].status[0].level == b'\x02', 'an error')
    assert '/nowhere/weights.safetensors' in reports[-1].status[0].message
    assert rig.set_parameter('model', str(rig.weights))[0]
    assert rig.transition('configure') and rig.transition('activate')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands
    rig.until(lambda: reports[-1].status[0].level == b'\x00', 'the error to be gone')


def test_enable_and_reset(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    first = rig.answer(publish, image(depth_with_hand(), 1)).hands[0].id
    assert rig.answer(publish, image(depth_with_hand(), 2)).hands[0].id == first
    assert rig.call(Trigger, 'reset').success
    second = rig.answer(publish, image(depth_with_hand(), 3)).hands[0].id
    assert second != first

    assert rig.call(SetBool, 'enable', data=False).message == 'disabled'
    rig.until(lambda: rig.client.count_subscribers('/depth/image_rect') == 0)
    rig.until(lambda: {(m.ns.split('/')[0], m.action) for m in rig.received[MarkerArray][-1].markers}
              == {(second, Marker.DELETE)}, 'deletions')
    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and reports[-1].status[0].message == 'the node is disabled', 'diagnostics')
    assert rig.call(SetBool, 'enable', data=True).success
    hand, = rig.answer(rig.camera(), image(depth_with_hand(), 4)).hands  # the camera_info is known already
    assert hand.id not in (first, second)  # somebody else may be there by now


def test_a_bag_that_begins_again_is_a_new_hand(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    ids = [rig.answer(publish, image(depth_with_hand(), stamp)).hands[0].id
           for stamp in (1000, 1033, 1032, 1066, 900, 933)]  # the third overtook another, or the clock was corrected
    assert len(set(ids[:4])) == 1 and ids[3] != ids[4] == ids[5]


def test_parameters_change_between_images_or_are_refused_with_the_reason(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    assert len(rig.answer(publish, image(depth_with_hand())).hands) == 1
    assert rig.set_parameter('max_depth', 0.5)[0]
    assert len(rig.answer(publish, image(depth_with_hand())).hands) == 0
    assert rig.set_parameter('depth_scale', 0.0005)[0]  # the same numbers, half as far away
    hand, = rig.answer(publish, image(depth_with_hand())).hands
    assert hand.cube_center.z == pytest.approx(0.3, abs=0.1)
    assert rig.set_parameter('cube_size', 0.25)[0]
    assert rig.answer(publish, image(depth_with_hand())).hands[0].cube_size == pytest.approx(0.25)
    assert rig.set_parameter('cube_size', 0.0)[0]
    assert rig.answer(publish, image(depth_with_hand())).hands[0].cube_size == pytest.approx(0.3)

    for name, value, reason in (('depth_scale', 2.0, 'range'), ('depth_scale', -1.0, 'range'), ('side', 'both', 'auto'),
                                ('min_depth', 5.0, 'max_depth'), ('model', 'other', 'configured'),
                                ('device', 'cuda', 'configured'), ('autostart', False, 'read'),
                                ('max_hands', 0, 'range'), ('min_score', 'high', 'type')):
        done, why = rig.set_parameter(name, value)
        assert not done and reason in why.lower(), (name, why)
    assert rig.answer(publish, image(depth_with_hand())).hands


def test_a_parameter_that_there_is_not_is_named(rig: Rig) -> None:
    rig.start(max_depht=1.0)
    rig.until_said("no parameter 'max_depht'", 'no effect')


@pytest.mark.parametrize('arguments', [('estimator',), ('replay', 'demo/hand.mcap'),
                                       ('evaluate', 'demo/hand.mcap', '--via-ros')])
def test_a_log_of_ros_that_cannot_be_written_is_told_with_the_remedy(arguments: tuple[str, ...]) -> None:
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, cwd=Path(__file__).parents[1],
                          env=os.environ | {'ROS_LOG_DIR': '/proc/log'})
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert f'hand-pose {arguments[0]}: ROS cannot write its log' in done.stderr and 'ROS_LOG_DIR' in done.stderr


@pytest.mark.parametrize('arguments', [('--params-file', '/nowhere.yaml'), ('-r', 'depth/image_rect')])
def test_arguments_that_ros_cannot_read_are_one_sentence(arguments: tuple[str, ...]) -> None:
    done = subprocess.run([*COMMAND, 'estimator', '--ros-args', *arguments], capture_output=True, text=True)
    assert done.returncode == 1
    assert 'the arguments of ROS cannot be used' in done.stderr and 'Traceback' not in done.stderr
    assert '.c:' not in done.stderr.rpartition('cannot be used')[2]


@pytest.mark.parametrize(('value', 'sentence'), [
    ('min_score:=1', 'parameter min_score is 1: give a number with a point, as 1.0, from 0 to 1'),
    ('min_score:=1.5', 'parameter min_score is 1.5: give a number with a point, as 1.0, from 0 to 1'),
    ('max_hands:=two', "parameter max_hands is 'two': give a whole number from 1 to 8"),
    ('tracking:=1', 'parameter tracking is 1: give true or false')])
def test_a_parameter_of_another_kind_is_one_sentence(value: str, sentence: str) -> None:
    done = subprocess.run([*COMMAND, 'estimator', '--ros-args', '-p', value], capture_output=True, text=True)
    assert done.returncode == 1 and sentence in done.stderr and 'Traceback' not in done.stderr


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


def test_without_camera_info_the_remedy_is_named_and_works(rig: Rig) -> None:
    rig.start(camera_info_timeout=0.05)
    publish = rig.camera()
    publish(image(depth_with_hand()))
    rig.until_said('/depth/camera_info', 'intrinsics.fx')
    assert not rig.received[HandJointsArray]
    node = rig.node
    node.set_parameters_atomically([Parameter(f'intrinsics.{name}', value=value) for name, value in
                                    (('fx', FOCAL), ('fy', FOCAL), ('cx', WIDTH / 2), ('cy', HEIGHT / 2))])
    assert rig.answer(publish, image(depth_with_hand())).hands


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


def test_a_machine_is_not_called_slow_while_camera_info_is_missing(rig: Rig) -> None:
    rig.start(camera_info_timeout=1.5, publish_diagnostics=False)  # images that wait are replaced by newer ones
    publish, picture = rig.camera(RELIABLE), image(depth_with_hand())
    end = time.monotonic() + 3.5
    while time.monotonic() < end:
        publish(picture)
        time.sleep(0.02)
    rig.until_said('/depth/camera_info')
    assert not any('too slow' in text for text in rig.said()) and not rig.received[DiagnosticArray]


def test_nor_where_camera_info_is_wrong_now_and_then(rig: Rig) -> None:
    node = rig.start(camera_info_timeout=9.0)
    publish, picture = rig.camera(RELIABLE), image(depth_with_hand())
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    reports = rig.received[DiagnosticArray]
    seen = len(reports)
    while len(reports) < seen + 4:
        infos.publish(camera_info())
        rig.answer(publish, picture)
        infos.publish(camera_info(2 * WIDTH, 2 * HEIGHT))
        rig.until(lambda: node._camera._info.width == 2 * WIDTH, 'the wrong one')
        received = node._statistics._totals['received']
        for number in range(received + 1, received + 21):
            publish(picture)
            rig.until(lambda n=number: node._statistics._totals['received'] == n, 'the image')
    assert not any('too slow' in text for text in rig.said())


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


def test_to_stop_while_an_image_waits_for_its_camera_info_is_no_complaint(rig: Rig) -> None:
    rig.start(camera_info_timeout=9.0)
    publish = rig.camera(RELIABLE)
    publish(image(depth_with_hand()))
    rig.until(lambda: rig.node._camera._changed._waiters, 'the image to wait')
    assert rig.transition('deactivate') and rig.transition('activate')
    rig.until(lambda: sum('listening to' in text for text in rig.said()) == 2, 'to hear all that was said before')
    assert not any('camera_info arrived' in text for text in rig.said())
    assert rig.node._statistics._totals['dropped'] == 1  # each image is answered, refused or dropped
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def no_data(message: Image) -> None:
    message.data = array('B')


def colour(message: Image) -> None:
    message.encoding = 'rgb8'


def short(message: Image) -> None:
    message.data = message.data[:-1]


def empty(message: Image) -> None:
    message.width = message.height = message.step = 0
    message.data = array('B')


def narrow_step(message: Image) -> None:
    message.step = 3


def wrong_size(message: Image) -> None:
    message.height //= 2


def test_bad_images_are_refused_with_one_sentence_each_and_the_next_one_is_answered(rig: Rig) -> None:
    rig.start(camera_info_timeout=0.01)
    publish = rig.camera(RELIABLE, info=camera_info())
    complaints = 0
    for harm, words in ((colour, ['rgb8', '16UC1']), (no_data, [' 0 bytes']), (short, ['bytes']), (empty, ['0x0']),
                        (narrow_step, ['step']), (wrong_size, ['camera_info', f'{WIDTH}x{HEIGHT // 2}'])):
        for stamp in range(3):
            bad = image(depth_with_hand(), stamp)
            harm(bad)
            publish(bad)
            time.sleep(0.02)
        rig.until_said('/depth/', *words)
        assert stamp_of(rig.answer(publish, image(depth_with_hand(), 99))) == 99
        said = [text for text in rig.said() if 'listening' not in text]
        assert len(said) <= complaints + 1, f'the same complaint more than once: {said}'
        complaints = len(said)
    assert len(rig.received[HandJointsArray]) == 6


def test_bad_camera_info_is_refused_and_a_good_one_is_taken(rig: Rig) -> None:
    rig.start(camera_info_timeout=0.01)
    images = rig.camera()
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    for info, words in ((camera_info(focal=0.0), ['not calibrated', 'intrinsics.fx']),
                        (camera_info(WIDTH * 2, HEIGHT * 2), ['320x240']), (camera_info(focal=float('nan')), ['nan'])):
        infos.publish(info)
        rig.until(lambda info=info: repr(rig.node._camera._info) == repr(info), 'the camera_info')
        images(image(depth_with_hand()))
        rig.until_said('/depth/camera_info', *words)
    assert not rig.received[HandJointsArray]
    infos.publish(camera_info())
    rig.until(lambda: rig.node._camera._info == camera_info(), 'the camera_info')
    assert rig.answer(images, image(depth_with_hand())).hands


def test_depth_without_readings_is_answered_and_explained(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    for value in (0.0, np.nan, np.inf, -np.inf, -1.0):
        answer = rig.answer(publish, image(np.full((HEIGHT, WIDTH), value), encoding='32FC1'))
        assert answer.hands == [], value
    rig.until_said('/depth/image_rect', 'no reading')
    assert rig.answer(publish, image(depth_with_hand())).hands


def test_a_wrong_depth_scale_is_suspected(rig: Rig) -> None:
    rig.start()
    rig.answer(rig.camera(info=camera_info()), image(depth_with_hand() * 10))
    rig.until_said('/depth/image_rect', 'depth_scale')


def test_an_empty_room_is_no_wrong_depth_scale_once_a_hand_was_seen(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    assert rig.answer(publish, image(depth_with_hand())).hands
    assert rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0))).hands == []
    rig.answer(publish, image(np.zeros((HEIGHT, WIDTH))))
    rig.until_said('no reading')  # which was said after all that there was to say before
    assert not any('depth_scale' in text for text in rig.said())
    assert rig.set_parameter('depth_scale', 0.0011)[0]  # of which nothing is known yet
    rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0)))
    rig.until_said('check depth_scale')


def test_silence_names_the_topic_and_its_publishers(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.client.create_publisher(Image, '/somewhere/else', RELIABLE)
    rig.start()
    rig.until_said('/depth/image_rect', 'without any publisher', '(sensor_msgs/msg/Image is published on /somewhere/')
    # In the diagnostics as long as it lasts: first as a warning, then as the reason of staleness.
    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and '/somewhere' in reports[-1].status[0].message
              and reports[-1].status[0].level == b'\x03', 'staleness')
    assert sum('/somewhere/else' in text for text in rig.said()) == 1


def test_who_has_just_come_is_not_said_to_be_missing(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.5)
    rig.start()

    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and 'without any publisher' in reports[-1].status[0].message, 'the silence to be told')
    before = len(reports)
    rig.client.create_publisher(Image, 'depth/image_rect', BEST_EFFORT)
    rig.until(lambda: any(report.status[0].message == 'no images' for report in reports[before:]),
              'the publisher to be seen, and given its time')


def test_a_transport_that_is_not_read_is_named(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.client.create_publisher(CompressedImage, 'depth/image_rect/zstd', RELIABLE)
    rig.start()
    rig.until_said('on /depth/image_rect/zstd there are images: the transport zstd is not read: convert it with')


def test_depth_that_is_only_raw_is_found(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.client.create_publisher(Image, 'depth/image_rect', RELIABLE)
    rig.start(transport='compressedDepth')
    rig.until_said('no image arrived on /depth/image_rect/compressedDepth',
                   'depth is published on /depth/image_rect: set the parameter transport to raw')


@pytest.mark.parametrize('transport', ['compressedDepth', 'compressed'])
def test_depth_that_is_only_compressed_is_found(rig: Rig, monkeypatch: pytest.MonkeyPatch, transport: str) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.start()
    rig.until_said('/depth/image_rect', 'without any publisher', 'start the camera')
    rig.client.create_publisher(CompressedImage, f'depth/image_rect/{transport}', RELIABLE)
    rig.until_said(f'depth is published on /depth/image_rect/{transport}: set the parameter transport to {transport}')

    def newest_message(infos: rclpy.publisher.Publisher, reports: int = 3) -> str:
        """Of the diagnostics, after some seconds of camera_info alone."""
        end = len(rig.received[DiagnosticArray]) + reports
        while len(rig.received[DiagnosticArray]) < end:
            infos.publish(camera_info())
            time.sleep(0.02)
        return rig.received[DiagnosticArray][-1].status[0].message

    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    assert f'set the parameter transport to {transport}' in newest_message(infos)
    assert not any('camera_info but only' in text for text in rig.said())
    rig.connected(rig.client.create_publisher(Image, 'depth/image_rect', RELIABLE))
    assert 'if it does publish, start the camera driver with' in newest_message(infos)


def test_incompatible_quality_of_service_is_named_with_its_remedy(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 1e9)  # images of others may arrive
    rig.start(**{'qos_overrides./depth/image_rect.subscription.reliability': 'reliable'})
    rig.client.create_publisher(Image, 'depth/image_rect', BEST_EFFORT)
    rig.until_said('does not offer', '/depth/image_rect', '/client', 'best effort',
                   '-p qos_overrides./depth/image_rect.subscription.reliability:=best_effort')
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    # In the diagnostics, too, as long as it lasts, whatever arrives beside the images.
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)

    def told() -> bool:
        infos.publish(camera_info())
        reports = [report.status[0] for report in rig.received[DiagnosticArray]]
        return len(reports) > 3 and all(':=best_effort' in status.message for status in reports[-2:])
    rig.until(told, 'diagnostics')


def test_a_quality_of_service_that_has_no_effect_is_named(rig: Rig) -> None:
    name = 'qos_overrides./camera/depth/image_raw.subscription'
    without = f'{name}.durability', 'qos_overrides.depth/image_rect.subscription.depth'
    rig.start('depth/image_rect:=/camera/depth/image_raw', **{f'{name}.reliability': 'reliable', without[0]: 'volatile',
                                                              without[1]: 5})
    for each in without:
        rig.until_said(f"there is no parameter '{each}', so it has no effect", 'of /camera/depth/camera_info')
    assert sum('has no effect' in text for text in rig.said()) == 2


@pytest.mark.parametrize('policy, value', [('reliability', 'perhaps'), ('depth', 'deep'), ('reliability', True)])
def test_a_wrong_quality_of_service_is_named(rig: Rig, policy: str, value: object) -> None:
    name = 'qos_overrides./depth/image_rect.subscription'
    rig.start(**{f'{name}.{policy}': value})
    rig.until_said('cannot listen to', name, str(value))
    assert rig.state() == 'inactive' and rig.client.count_subscribers('/depth/camera_info') == 0


def test_diagnostics_tell_rates_times_and_hints(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())

    def newest() -> dict[str, str]:
        status = rig.received[DiagnosticArray][-1].status[0]
        return {'name': status.name, 'message': status.message, 'level': status.level,
                **{v.key: v.value for v in status.values}}

    for stamp in (*range(4), time.time_ns() // 1_000_000):  # the others are from a bag, of whatever age
        rig.answer(publish, image(depth_with_hand(), stamp))
    rig.until(lambda: rig.received[DiagnosticArray] and newest().get('answered_total') == '5', 'diagnostics')
    report = newest()
    assert report['received_total'] == report['hands_total'] == '5' and report['dropped_total'] == '0'
    assert {'decode_p50_ms', 'predict_p50_ms', 'total_p95_ms', 'age_p50_ms', 'input_hz', 'output_hz'} <= report.keys()
    assert {key: report[key] for key in ('name', 'state', 'model', 'detector', 'intrinsics')} == {
        'name': 'estimator: hand pose', 'state': 'active', 'model': str(rig.weights), 'detector': 'nearest',
        'intrinsics': '/depth/camera_info'}
    assert report['engine'] == rig.node._estimator.engine.name
    assert report['image'].startswith('/depth/image_rect published by /client (sensor_msgs/msg/Image, best effort')
    assert rig.received[DiagnosticArray][-1].header.stamp.sec > 0
    assert report['level'] == b'\x00'
    publish(Image(encoding='rgb8', width=1, height=1, step=3, data=array('B', b'abc')))
    rig.until(lambda: 'rgb8' in newest()['message'] and newest()['level'] == b'\x01', 'a warning')
    assert newest()['refused_total'] == '1' and newest()['answered_total'] == '5'
    rig.until(lambda: newest()['level'] == b'\x03', 'staleness')


def test_camera_info_that_is_published_twice_does_not_make_images_missing(rig: Rig) -> None:
    """As by openni2_camera, which has two depth images, and for each of them publishes the same camera_info."""
    node = rig.start()
    publish = rig.camera()
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    for stamp in range(1, 21):
        for _ in range(2):
            before = node._camera._info
            infos.publish(stamped(camera_info(), stamp))
            rig.until(lambda before=before: node._camera._info is not before, 'the camera_info')
        rig.answer(publish, image(depth_with_hand(), stamp))
    reports = rig.received[DiagnosticArray]
    seen = len(reports)
    rig.until(lambda: len(reports) > seen + 1, 'diagnostics of all of them')
    assert not any('but only' in report.status[0].message for report in reports)


def test_two_nodes_that_publish_the_same_joints_are_told(rig: Rig) -> None:
    rig.start()
    assert not any('somebody else' in text for text in rig.said())
    other = rig.client.create_publisher(HandJointsArray, 'hand/joints', 1)
    rig.until_said('somebody else publishes /hand/joints', 'namespace')
    rig.client.destroy_publisher(other)


def test_a_slow_network_gets_the_newest_image_never_a_queue(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    node = rig.start()
    publish = rig.camera(RELIABLE, info=camera_info())
    rig.answer(publish, image(depth_with_hand(), 1))
    entered, go = threading.Event(), threading.Event()
    convert = conversions.hands_to_msg

    def slow(*arguments) -> HandJointsArray:
        entered.set()
        go.wait(20)
        return convert(*arguments)

    monkeypatch.setattr(conversions, 'hands_to_msg', slow)
    publish(image(depth_with_hand(), 2))
    assert entered.wait(10)
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
        go.wait(20)
        done.append(item)

    worker = NewestWorker(handle)
    assert not worker.put(1) and entered.wait(10) and not worker.put(2)
    stopping = threading.Thread(target=lambda: (worker.stop(), done.append('stopped')))
    stopping.start()
    stopping.join(0.1)  # in which it must not end
    go.set()
    stopping.join()
    assert done == [1, 'stopped']


def test_many_activations_leave_nothing_behind(rig: Rig) -> None:
    node = rig.start()
    threads = threading.active_count()
    for _ in range(30):
        assert rig.transition('deactivate') and rig.transition('activate')
    assert len(list(node.subscriptions)) == 2
    assert threading.active_count() == threads
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def test_the_command_starts_and_ends_cleanly(rig: Rig) -> None:
    process = subprocess.Popen(
        [*COMMAND, 'estimator', '--ros-args', '-p', f'model:={rig.weights}',
         '-p', 'min_score:=0.0'], stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        rig.until(lambda: rig.client.count_publishers('/hand/joints'), 'the node', seconds=90)
        publish = rig.camera(info=camera_info())
        while not rig.received[HandJointsArray]:
            publish(image(depth_with_hand()))
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    assert 'Traceback' not in errors


def test_a_wrong_parameter_at_start_is_one_sentence() -> None:
    done = subprocess.run([*COMMAND, 'estimator', '--ros-args', '-p', 'depth_scale:=7.0'],
                          capture_output=True, text=True, timeout=100)
    assert done.returncode == 1
    assert 'depth_scale' in done.stderr and 'Traceback' not in done.stderr


def test_a_camera_info_of_another_frame_is_suspected(rig: Rig) -> None:
    rig.start()
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand(), frame='other_camera')).hands
    rig.until_said('/depth/camera_info', 'other_camera', 'camera_optical')
