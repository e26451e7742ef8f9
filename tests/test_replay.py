"""What `replay` promises: a bag on ROS topics as it was recorded. The real node, over real DDS."""

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

import itertools
import os
import struct
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import QosReliability
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool
from test_bags import CAMERA, STAMPS, depths, write_ros1  # noqa: F401 (depths is a fixture)

from hand_pose_ros.bags import Bag, BagWriter, writer
from hand_pose_ros.cli import main
from hand_pose_ros.depth import decode_image
from hand_pose_ros.errors import InputError
from hand_pose_ros.msg import HandJointsArray, HandSkeleton
from hand_pose_ros.ros import qos
from hand_pose_ros.ros.replay import SETTLE_S, Replay
from hand_pose_ros.skeleton import HAND21

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def bag(tmp_path, depths):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as writer:
        writer.write_skeleton(STAMPS[0], 'camera', HAND21, 'a network', '1')
        for stamp, depth in zip(STAMPS, depths, strict=True):
            writer.write_depth(stamp, 'camera', depth, CAMERA, codec=None)
    return path


class Listener:
    """Collects what is published; its node spins whenever `until` waits."""

    def __init__(self):
        self.node = rclpy.create_node('listener')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.heard = {}

    def on(self, topic, kind, qos=50):
        self.heard[topic] = []
        self.node.create_subscription(kind, topic, self.heard[topic].append, qos)
        return self

    def until(self, condition, seconds=60.0):
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        return condition()


@pytest.fixture
def listener(ros_domain):
    rclpy.init()
    yield Listener()
    rclpy.try_shutdown()


@pytest.fixture
def play():
    """Open a bag and a Replay of it; closed at the end."""
    opened = []

    def make(path, **options):
        bag = Bag(path)
        opened.append(bag)
        replay = Replay(bag, **options)
        opened.append(replay)
        return replay
    yield make
    for each in reversed(opened):
        each.close()


def stamps(messages):
    return [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages]


def test_types_stamps_and_content_are_those_of_the_recording(bag, depths, listener, play):
    listener.on('/depth/image_rect', Image).on('/depth/camera_info', CameraInfo)
    listener.on('/hand/skeleton', HandSkeleton, LATCHED)
    replay = play(bag, rate=4)
    replay.wait_for_subscribers(60, number=3)
    replay.play()
    images, infos = listener.heard['/depth/image_rect'], listener.heard['/depth/camera_info']
    assert listener.until(lambda: len(images) == len(infos) == len(STAMPS) and listener.heard['/hand/skeleton'])
    assert stamps(images) == stamps(infos) == STAMPS
    assert {image.header.frame_id for image in images} == {'camera'}
    for image, depth in zip(images, depths, strict=True):
        np.testing.assert_array_equal(decode_image(image), depth)
    assert replay.published == {'/depth/image_rect': 12, '/depth/camera_info': 12, '/hand/skeleton': 1}


def test_ros1_bags_become_ros2_messages(tmp_path, depths, listener, play):
    listener.on('/cam/image', Image).on('/cam/camera_info', CameraInfo)
    replay = play(write_ros1(tmp_path / 'old.bag', depths), rate=4)
    replay.wait_for_subscribers(60, number=2)
    replay.play()
    images, infos = listener.heard['/cam/image'], listener.heard['/cam/camera_info']
    assert listener.until(lambda: len(images) == len(infos) == len(STAMPS))
    assert stamps(images) == stamps(infos) == STAMPS
    np.testing.assert_array_equal(decode_image(images[5]), depths[5])
    assert infos[0].k[0] == CAMERA.fx and infos[0].p[5] == CAMERA.fy and infos[0].width == 64


def test_what_is_latched_in_a_ros1_bag_stays_so_and_what_is_unknown_is_left_out(tmp_path, listener, play, capfd):
    store, kind = get_typestore(Stores.ROS1_NOETIC), 'rosgraph_msgs/msg/Clock'
    with Writer1(tmp_path / 'old.bag') as bag:
        still = bag.add_connection('/still', kind, typestore=store, latching=1)
        clock, _ = (bag.add_connection(topic, kind, typestore=store) for topic in ('/clock', '/empty'))
        other = bag.add_connection('/other', 'nobody_msgs/msg/Thing', msgdef='int8 x\n',
                                   md5sum='6b7838fc0c9ab0287a0bf785874d405b')
        for connection, data in ((still, bytes(8)), (clock, bytes(8)), (other, bytes(1))):
            bag.write(connection, STAMPS[0], data)
    replay = play(tmp_path / 'old.bag', clock=True)
    assert '/other is left out: ' in capfd.readouterr().err
    replay.play()
    assert replay.published == {'/still': 1}  # the clock is that of the replay
    listener.on('/still', Clock, LATCHED)
    assert listener.until(lambda: listener.heard['/still'])
    with pytest.raises(InputError, match='there is nothing to publish'):
        play(tmp_path / 'old.bag', topics=[])


def test_the_latched_skeleton_reaches_who_comes_later(bag, listener, play):
    replay = play(bag, topics=['/hand/skeleton'])
    replay.wait_for_subscribers(0)
    replay.play()
    listener.on('/hand/skeleton', HandSkeleton, LATCHED)
    assert listener.until(lambda: listener.heard['/hand/skeleton'])
    assert tuple(listener.heard['/hand/skeleton'][0].joint_names) == HAND21.joint_names


def test_what_was_latched_before_the_start_reaches_everybody(listener, play, tmp_path):
    path = tmp_path / 'latched.mcap'
    with BagWriter(path) as writer:
        for i in range(30):
            writer.write_skeleton(STAMPS[0] + i, f'frame_{i}', HAND21, 'a network', '1')
        for stamp in STAMPS:
            writer.write_hands(stamp, 'camera', [])
    everything = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listener.on('/hand/skeleton', HandSkeleton, everything).on('/hand/joints', HandJointsArray)
    listener.on('/clock', Clock)
    replay = play(path, clock=True)
    replay.wait_for_subscribers(60, number=2)
    replay.play(start_s=0.264)
    early, hands = listener.heard['/hand/skeleton'], listener.heard['/hand/joints']
    assert listener.until(lambda: len(early) == 30 and len(hands) == 4)
    assert stamps(hands) == STAMPS[8:]
    assert all(m.clock.sec * 10**9 + m.clock.nanosec >= STAMPS[8] for m in listener.heard['/clock'])
    listener.on('/hand/skeleton', HandSkeleton, everything)
    late = listener.heard['/hand/skeleton']
    assert listener.until(lambda: len(late) == 30)
    for heard in (early, late):
        assert [message.header.frame_id for message in heard] == [f'frame_{i}' for i in range(30)]


def test_start_rate_and_topics(bag, listener, play):
    listener.on('/depth/image_rect', Image).on('/depth/camera_info', CameraInfo)
    replay = play(bag, topics=['/depth/image_rect'], rate=0.25)
    replay.wait_for_subscribers(60, number=1)
    began = time.monotonic()
    replay.play(start_s=0.264)  # the last four images, 33 ms apart
    assert time.monotonic() - began >= 3 * 0.033 / 0.25 + SETTLE_S
    assert listener.until(lambda: len(listener.heard['/depth/image_rect']) == 4)
    assert stamps(listener.heard['/depth/image_rect']) == STAMPS[8:]
    assert not listener.heard['/depth/camera_info']
    with pytest.raises(InputError, match=r'nothing was recorded later than 99 s: give a smaller --start'):
        replay.play(start_s=99)


def test_the_clock_tells_the_time_of_recording(bag, listener, play, monkeypatch):
    listener.on('/clock', Clock, 1000).on('/depth/image_rect', Image)
    replay, asked = play(bag, clock=True), itertools.count()
    replay.wait_for_subscribers(60, number=1)
    monkeypatch.setattr('hand_pose_ros.ros.replay.CLOCK_PERIOD_S', 0.001)
    monkeypatch.setattr('hand_pose_ros.ros.replay.time', SimpleNamespace(  # 5 ms each time that somebody looks
        monotonic=lambda: 0.005 * next(asked), sleep=time.sleep))
    replay.play()
    assert listener.until(lambda: len(listener.heard['/depth/image_rect']) == len(STAMPS))

    def times():
        return [m.clock.sec * 10**9 + m.clock.nanosec for m in listener.heard['/clock']]
    assert listener.until(lambda: times()[-1:] == STAMPS[-1:])
    assert len(set(times())) > len(STAMPS), 'it goes on between two messages'
    assert times() == sorted(times()) and times()[0] >= STAMPS[0]


@pytest.fixture
def pass_time(monkeypatch):
    """Let so many seconds pass for the replay."""
    passed = []
    monkeypatch.setattr('hand_pose_ros.ros.replay.time', SimpleNamespace(
        monotonic=lambda: time.monotonic() + sum(passed), sleep=time.sleep))
    return passed.append


def test_pause_by_service(bag, listener, play, pass_time):
    replay = play(bag, paused=True, topics=['/depth/image_rect'], rate=10)
    client = listener.node.create_client(SetBool, '/replay/pause')
    answer = []

    def go_on():
        # Played from within the loop of the replay, which waits: the timer stands for another terminal.
        if client.service_is_ready() and not answer:
            pass_time(3600)
            answer.append(client.call_async(SetBool.Request(data=False)))
    replay.node.create_timer(0.3, go_on)
    replay.play()
    assert answer and replay.published['/depth/image_rect'] == 12
    assert replay.lateness_s < 1800, 'the time of the bag stands still in a pause'
    assert listener.until(lambda: answer[0].done()) and answer[0].result().message == 'playing'


def test_the_time_of_the_bag_stands_still_until_the_listener_is_ready(bag, listener, play, pass_time):
    replay, asked = play(bag, topics=['/depth/image_rect'], rate=10), []

    def ready():
        asked.append(len(asked))
        pass_time(1)
        return len(asked) % 2 == 0  # only when it is asked again
    replay.play(ready=ready)
    assert len(asked) == 2 * len(STAMPS) and replay.lateness_s < 12


def test_what_came_late_is_told(bag, listener, play, pass_time):
    replay = play(bag)
    delay = replay.node.create_timer(0, lambda: (pass_time(0.2), delay.cancel()))
    replay.play()
    assert replay.lateness_s > 0.1


def test_best_effort_on_request(bag, listener, play):
    replay = play(bag, reliability='best_effort')
    [info] = replay.node.get_publishers_info_by_topic('/depth/image_rect')
    assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


def test_best_effort_where_it_was_recorded_so(tmp_path, listener, play, monkeypatch):
    monkeypatch.setattr(writer, 'QosReliability', SimpleNamespace(RELIABLE=QosReliability.BEST_EFFORT))
    with BagWriter(tmp_path / 'lossy.mcap') as bag:
        bag.write_hands(STAMPS[0], 'camera', [])
    offered = {}
    for reliability in ('recorded', 'reliable'):
        replay = play(tmp_path / 'lossy.mcap', reliability=reliability)
        [publisher] = replay._outputs.values()
        offered[reliability] = publisher.qos_profile.reliability
    assert offered == {'recorded': ReliabilityPolicy.BEST_EFFORT, 'reliable': ReliabilityPolicy.RELIABLE}


def test_topics_that_are_not_there_are_named(bag, listener, play):
    with pytest.raises(InputError, match=r'cannot publish /depth/imaje: choose from .*/depth/image_rect'):
        play(bag, topics=['/depth/imaje'])


def test_the_command_publishes_and_counts(bag, ros_domain, capsys, monkeypatch):
    for name in qos.PROFILE_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    assert main(['replay', str(bag), '--rate', '100', '--wait', '0', '--ros-args', '-r', '__ns:=/robot',
                 '-r', '/depth/image_rect:=/front/depth']) == 0
    said = capsys.readouterr().out
    assert 'publishing /depth/camera_info, /front/depth, /' in said and '12  /front/depth' in said
    assert '/depth/image_rect' not in said
    name, profile = qos.large_image_profile()
    assert os.environ[name] == profile, 'large images get through'
    assert main(['replay', str(bag.with_name('missing.bag'))]) == 1
    assert 'missing.bag: there is no such bag' in capsys.readouterr().err
    for option, value in (('--rate', '0'), ('--start', '-1'), ('--start', 'nan'), ('--start', 'inf'),
                          ('--start', '1e300'), ('--rate', 'inf'), ('--rate', '1e306'), ('--wait', '-1'),
                          ('--wait', 'nan')):
        with pytest.raises(SystemExit) as leaving:
            main(['replay', str(bag), option, value, '--clock'])
        assert leaving.value.code == 2


def test_a_loop_tells_of_damage_once_and_goes_on(tmp_path, ros_domain, capsys, monkeypatch):
    whole, cut, ends = tmp_path / 'whole.mcap', tmp_path / 'cut.mcap', iter([False, False, True])
    with BagWriter(whole) as writer:
        for stamp in STAMPS:
            writer.write_hands(stamp, 'camera', [])
    data = whole.read_bytes()
    cut.write_bytes(data[:data.rindex(struct.pack('<BQ', 0x0f, 4))])  # without its end

    def sleep(_):  # at the end of each turn
        if next(ends):
            raise KeyboardInterrupt
    monkeypatch.setattr('hand_pose_ros.ros.replay.time', SimpleNamespace(monotonic=time.monotonic, sleep=sleep))
    assert main(['replay', str(cut), '--loop', '--rate', '1000', '--wait', '0']) == 0
    said = capsys.readouterr()
    assert f'{3 * len(STAMPS)}  /hand/joints' in said.out
    assert said.err.count('cut.mcap: the bag was cut short') == 1
