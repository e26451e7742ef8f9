"""Publishes a bag on ROS topics as it was recorded: with its types, stamps, order and pace."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import chain
from os import PathLike
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosbags.convert.converter import migrate_bytes
from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from hand_pose_ros import ros
from hand_pose_ros.bags import Bag
from hand_pose_ros.bags.bag import typestore
from hand_pose_ros.errors import InputError
from hand_pose_ros.ros import qos

CLOCK_PERIOD_S = 0.025
"""Time between two messages on /clock."""
SETTLE_S = 0.5
"""After a discovery, or after a message was published, the other side may need this time."""
PATIENCE_S = 3.0
"""Maximum waiting time for a listener that is not ready."""
MAX_LATCHED = 1000
"""Maximum number of messages of a latched topic that are kept for subscribers that come later."""
_RENAMED = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}  # between ROS 1 and ROS 2


class Replay:
    """Node `replay`: one publisher for each topic of a bag, and the service `~/pause` (std_srvs/SetBool).

    Serialized messages of ROS 2 bags are published unchanged. Messages of ROS 1 bags are converted. Topics whose type
    is not installed are left out with a warning.

    Args:
        bag: open for reading.
        topics: publish only these; None = all.
        rate: how many times faster than recorded.
        reliability: 'recorded', 'reliable' or 'best_effort'. ROS 1 recordings count as reliable.
        clock: publish /clock with the time of recording, for nodes with use_sim_time.
        paused: wait for the service before the first message.

    Raises:
        InputError: one of the given topics cannot be published, or no topic can.
    """

    def __init__(self, bag: Bag, *, topics: Collection[str] | None = None, rate: float = 1.0,
                 reliability: str = 'recorded', clock: bool = False, paused: bool = False) -> None:
        self._bag, self._rate, self._paused = bag, rate, paused
        self.published: dict[str, int] = {}
        """Number of messages published so far on each topic."""
        self.lateness_s = 0.0
        """The largest delay of a message after its time, so far."""
        self.node = rclpy.create_node('replay')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._clock = self.node.create_publisher(Clock, '/clock', 10) if clock else None
        self._outputs: dict[str, Publisher] = {}
        self._connections: list[Connection] = []
        self._cache: dict[str, object] = {}  # of the conversion from ROS 1
        for connection in bag.connections:
            if connection.msgcount and (topics is None or connection.topic in topics):
                self._add(connection, reliability)
        if missing := set(topics or ()) - set(self._outputs):
            raise InputError(f'{bag.path}: cannot publish {", ".join(sorted(missing))}: choose from '
                             f'{", ".join(sorted({c.topic for c in bag.connections}))}')
        if not self._outputs:
            raise InputError(f'{bag.path}: there is nothing to publish: no topic has messages of an installed type')
        self.node.create_service(SetBool, '~/pause', self._on_pause)

    def name(self, topic: str) -> str:
        """The name under which a topic of the bag is published. It may be remapped."""
        return str(self._outputs[topic].topic_name)

    def wait_for_subscribers(self, timeout_s: float, number: int | None = None) -> None:
        """Give subscribers time to find the topics. Messages that are published earlier never reach them.

        Args:
            timeout_s: maximum waiting time. If DDS participants miss each other at first, they announce themselves
                again every 3 s.
            number: of subscriptions to all topics together. As soon as there are this many, the waiting ends.
        """
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(left, 0.05))
            if number is not None and sum(o.get_subscription_count() for o in self._outputs.values()) >= number:
                # The other side also needs a moment, before it receives best-effort messages.
                number, end = None, min(end, time.monotonic() + SETTLE_S)

    def play(self, start_s: float = 0.0, ready: Callable[[], bool] | None = None) -> None:
        """Publish the bag once, from `start_s` seconds after its beginning. Earlier latched messages come first.

        Args:
            ready: each message waits until this returns True. If it does not within PATIENCE_S, it is not called again.

        Raises:
            InputError: the bag is damaged (everything before the damage is published first), or nothing was recorded
                after start_s.
        """
        start_ns = self._bag.start_ns + round(start_s * 1e9)
        latched = list(self._latched_before(start_ns))  # as a list, because a bag is not read in two places at once
        messages = self._bag.messages(self._connections, start=start_ns)
        first = next(messages, None)
        if first is None:
            raise InputError(f'{self._bag.path}: nothing was recorded later than {start_s} s: give a smaller --start')
        first_ns, self._origin = first[1], time.monotonic()
        damage = None
        try:
            for connection, recorded_ns, data in chain(latched, [first], messages):
                message = self._to_ros2(connection, data)
                self._wait_for(max(recorded_ns, first_ns), first_ns)
                if ready is not None and not self._hold(ready):
                    ready = None
                self._outputs[connection.topic].publish(message)
                self.published[connection.topic] += 1
        except InputError as error:  # what was published before is still on its way
            damage = error
        for output in self._outputs.values():
            output.wait_for_all_acked(Duration(seconds=1))
        time.sleep(SETTLE_S)  # best effort is not acknowledged; messages on the way are lost when the publisher closes
        if damage is not None:
            raise damage

    def close(self) -> None:
        """Destroy the node and its topics."""
        self._executor.shutdown()
        self.node.destroy_node()

    def _add(self, connection: Connection, reliability: str) -> None:
        msgtype = _RENAMED.get(connection.msgtype, connection.msgtype)
        if self._clock is not None and connection.topic == '/clock':
            return
        try:
            package, _, name = msgtype.split('/')
            cls = getattr(importlib.import_module(f'{package}.msg'), name)
            if self._bag.is_ros1 and msgtype not in typestore().fielddefs:
                raise ImportError(f'{msgtype} cannot be converted from ROS 1')
            if connection.topic not in self._outputs:
                number = sum(other.msgcount for other in self._bag.connections if other.topic == connection.topic)
                self._outputs[connection.topic] = self.node.create_publisher(
                    cls, connection.topic, _quality(connection, reliability, number))
                self.published[connection.topic] = 0
        except (ImportError, AttributeError, ValueError, InvalidTopicNameException) as error:
            self.node.get_logger().warning(f'{connection.topic} is left out: {error}')
            return
        self._connections.append(connection)

    def _latched_before(self, end_ns: int) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages on latched topics, such as /tf_static, that were recorded before this time."""
        latched = [connection for connection in self._connections if _is_latched(connection)]
        if not latched or end_ns <= self._bag.start_ns:
            return
        with suppress(InputError):  # damage in this part does not matter for what comes after it
            for message in self._bag.messages(latched):
                if message[1] >= end_ns:
                    return
                yield message

    def _to_ros2(self, connection: Connection, data: bytes) -> bytes:
        """The message, serialized for ROS 2."""
        if not self._bag.is_ros1:
            return bytes(data)
        try:
            return bytes(migrate_bytes(
                self._bag.typestore, typestore(), connection.msgtype,
                _RENAMED.get(connection.msgtype, connection.msgtype), self._cache, data, src_is2=False, dst_is2=True))
        except Exception as error:  # random bytes can cause any error
            raise InputError(f'{self._bag.path}: a message on {connection.topic} is damaged ({error}): record or '
                             'copy the bag again') from error

    def _wait_for(self, recorded_ns: int, first_ns: int) -> None:
        """Serve the pause, keep /clock running, and return when a message is due."""
        while True:
            if self._paused:
                stopped = time.monotonic()
                while self._paused:
                    self._executor.spin_once(timeout_sec=0.1)
                self._origin += time.monotonic() - stopped
            left = self._origin + (recorded_ns - first_ns) / 1e9 / self._rate - time.monotonic()
            if self._clock is not None:
                now_ns = min(recorded_ns, recorded_ns - round(left * self._rate * 1e9))
                clock = Clock()
                clock.clock.sec, clock.clock.nanosec = divmod(now_ns, 1_000_000_000)
                self._clock.publish(clock)
            self._executor.spin_once(timeout_sec=min(max(left, 0.0), CLOCK_PERIOD_S))
            if left <= 0:
                self.lateness_s = max(self.lateness_s, -left)
                return

    def _hold(self, ready: Callable[[], bool]) -> bool:
        """Stop the time of the bag until the listener is ready. False if it is still not ready after PATIENCE_S."""
        stopped = time.monotonic()
        while not (done := ready()) and time.monotonic() - stopped < PATIENCE_S:
            self._executor.spin_once(timeout_sec=0.002)
        self._origin += time.monotonic() - stopped
        return done

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        response.success, response.message = True, 'paused' if request.data else 'playing'
        return response


@contextmanager
def replaying(path: str | PathLike[str], ros_args: Sequence[str] = (), **options: Any) -> Iterator[Replay]:
    """Open a bag and initialise ROS to replay it. Ctrl-C raises KeyboardInterrupt.

    Args:
        ros_args: remappings (`-r from:=to`) and other ROS arguments.
        options: the other arguments of Replay.

    Raises:
        InputError: the bag cannot be read, or one of the topics cannot be published.
    """
    qos.let_large_images_through()
    # Without the signal handlers of rclpy, Ctrl-C arrives between two messages.
    ros.init(['--ros-args', *ros_args], signal_handler_options=SignalHandlerOptions.NO)
    try:
        with Bag(path) as bag, closing(Replay(bag, **options)) as replay:
            yield replay
    finally:
        ros.shutdown()


def _is_latched(connection: Connection) -> bool:
    ext = connection.ext
    if isinstance(ext, ConnectionExtRosbag2):
        return any(offer.durability == QosDurability.TRANSIENT_LOCAL for offer in ext.offered_qos_profiles)
    return bool(ext.latching)


def _quality(connection: Connection, reliability: str, number: int) -> QoSProfile:
    """The QoS of the publisher of a topic with `number` messages: as recorded, unless `reliability` says otherwise."""
    ext = connection.ext
    profile = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
    if isinstance(ext, ConnectionExtRosbag2) and any(
            offer.reliability == QosReliability.BEST_EFFORT for offer in ext.offered_qos_profiles):
        profile.reliability = QoSReliabilityPolicy.BEST_EFFORT
    if _is_latched(connection):
        profile.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
        profile.depth = min(max(profile.depth, number), MAX_LATCHED)
    if reliability != 'recorded':
        profile.reliability = getattr(QoSReliabilityPolicy, reliability.upper())
    return profile
