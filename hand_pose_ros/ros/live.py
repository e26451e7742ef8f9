"""Play a bag through the real node, in its own process and over DDS. Record what the node answers, and when."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import CompressedImage, Image

from hand_pose_ros import ros
from hand_pose_ros.bags import DepthBag
from hand_pose_ros.conventions import camera_info_beside, split_transport, stamp_ns
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.msg import HandJointsArray, HandSkeleton
from hand_pose_ros.ros import qos
from hand_pose_ros.ros.replay import Replay
from hand_pose_ros.ros.topics import CAMERA_INFO, IMAGE

START_TIMEOUT_S = 60.0
"""Maximum time for the node to start. Loading the network takes most of it."""
QUIET_S = 2.0
"""If no answer comes for this time after the last one, none will come."""
_NODE = """\
import os, signal, sys, threading
def end():
    os.read(0, 1)  # nothing ever comes: it returns when the process that started this one has ended
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=end, daemon=True).start()
from hand_pose_ros.cli import main
sys.exit(main(['estimator', '--ros-args', *sys.argv[1:]]))
"""


@dataclass(frozen=True)
class Answers:
    """The answers of the node. An image and its answer have the same stamp, in ns.

    Attributes:
        skeleton: name of the joint set.
        hands: stamp -> the answer.
        latency_s: stamp -> seconds from the arrival of the image to the arrival of the answer, at the same subscriber.
    """

    skeleton: str
    hands: dict[int, HandJointsArray]
    latency_s: dict[int, float]


def play_through_node(bag: DepthBag, camera_info_topic: str | None = None,
                      parameters: Mapping[str, Any] | None = None, patient: bool = False) -> Answers:
    """Start the node `estimator` in its own namespace, play the depth images at their recorded pace, and stop the node.

    A damaged bag is played as far as possible.

    Args:
        camera_info_topic: needed if it is not beside the depth topic.
        parameters: of the node.
        patient: wait for each answer before the next image. So a machine that is too slow or busy plays slower. Without
            this, the node drops images, as it does with a camera.

    Raises:
        HandPoseError: the node does not start, or dies.
        InputError: the bag cannot be played, or two of its images have the same stamp.
    """
    stamps: Counter[int] = Counter()
    try:
        for frame in bag:
            stamps[frame.stamp_ns] += 1
    except InputError:
        if not stamps:
            raise
    if twice := [stamp for stamp, number in stamps.items() if number > 1]:
        raise InputError(f'{bag.path}: {stamps[twice[0]]} images have the stamp {twice[0]} ns, so which answer of the '
                         'node belongs to which image cannot be told: evaluate it without the node')
    namespace = f'/evaluation_{os.getpid()}'
    image, transport = split_transport(bag.depth_topic)
    info = camera_info_topic or camera_info_beside(image)
    infos = {info} & {connection.topic for connection in bag.connections}
    arguments = [item for name, value in {'transport': transport, **(parameters or {})}.items()
                 for item in ('-p', f'{name}:={json.dumps(value)}')]  # ROS reads YAML, in which 'a: b' must be quoted
    remappings = {'__ns': namespace, '/diagnostics': f'{namespace}/diagnostics', IMAGE: image, CAMERA_INFO: info}
    arguments += [item for name, topic in remappings.items() for item in ('-r', f'{name}:={topic}')]
    if ours := not rclpy.ok():
        qos.let_large_images_through()
        ros.init(signal_handler_options=SignalHandlerOptions.NO)  # else Ctrl-C ends the listener with a traceback
    try:
        with _listening(namespace, bag.depth_topic, Image if transport == 'raw' else CompressedImage) as listener, \
                _running(arguments) as process:
            _wait_until(lambda: bool(listener.skeleton or listener.failure), process, START_TIMEOUT_S)
            if listener.failure:
                raise HandPoseError(f'the node does not start: {listener.failure}')
            with closing(Replay(bag, topics={bag.depth_topic, *infos}, reliability='reliable')) as replay:
                def answered() -> bool:
                    return len(listener.answers) >= replay.published[bag.depth_topic]

                replay.wait_for_subscribers(START_TIMEOUT_S, 2 + len(infos))  # node and listener; camera_info: node
                try:
                    replay.play(ready=answered if patient else None)
                except InputError:
                    if not replay.published[bag.depth_topic]:
                        raise
                listener.wait_until_quiet()  # an image still on the way is lost when its publisher is closed
            if process.poll() is not None:
                raise HandPoseError(f'the node died with exit code {process.returncode}: its last words are above')
        answers, seen = listener.answers, listener.seen
        return Answers(listener.skeleton, {stamp: hands for stamp, (_, hands) in answers.items()},
                       {stamp: at - seen[stamp] for stamp, (at, _) in answers.items() if stamp in seen})
    finally:
        if ours:
            ros.shutdown()


class _Listener:
    """Notes when each image and each answer arrives."""

    def __init__(self, namespace: str, depth_topic: str, image_type: type) -> None:
        self.node = rclpy.create_node('listener', namespace=namespace)
        self.skeleton = self.failure = ''
        self.seen: dict[int, float] = {}
        self.answers: dict[int, tuple[float, HandJointsArray]] = {}
        # Serialized, because unpacking large images here would slow down what is measured.
        self.node.create_subscription(image_type, depth_topic, self._on_image, QoSProfile(depth=10), raw=True)
        self.node.create_subscription(HandJointsArray, 'hand/joints', self._on_answer, QoSProfile(depth=100))
        self.node.create_subscription(HandSkeleton, 'hand/skeleton', self._on_skeleton, qos.LATCHED)
        self.node.create_subscription(DiagnosticArray, 'diagnostics', self._on_diagnostics, qos.RESULTS)

    def wait_until_quiet(self) -> None:
        """Wait until all images are answered, or no answer has come for a while."""
        changed, count = time.monotonic(), -1
        while len(self.answers) < len(self.seen) and time.monotonic() - changed < QUIET_S:
            if len(self.answers) != count:
                changed, count = time.monotonic(), len(self.answers)
            time.sleep(0.05)

    def _on_image(self, data: bytes) -> None:
        # The first 4 bytes give the byte order. The header follows, and begins with the stamp.
        sec, nanosec = struct.unpack_from('<iI' if data[1] & 1 else '>iI', data, 4)
        self.seen.setdefault(sec * 1_000_000_000 + nanosec, time.monotonic())

    def _on_answer(self, hands: HandJointsArray) -> None:
        self.answers[stamp_ns(hands.header)] = time.monotonic(), hands

    def _on_skeleton(self, skeleton: HandSkeleton) -> None:
        self.skeleton = skeleton.name

    def _on_diagnostics(self, diagnostics: DiagnosticArray) -> None:
        self.failure = next((one.message for one in diagnostics.status if one.level == DiagnosticStatus.ERROR), '')


@contextmanager
def _listening(namespace: str, depth_topic: str, image_type: type) -> Iterator[_Listener]:
    listener, executor = _Listener(namespace, depth_topic, image_type), SingleThreadedExecutor()
    executor.add_node(listener.node)
    done: Future = Future()  # not generic with Jazzy
    thread = threading.Thread(target=executor.spin_until_future_complete, args=(done,), daemon=True)
    thread.start()
    try:
        yield listener
    finally:
        done.set_result(None)  # to shut down the executor first would destroy what its thread waits with
        thread.join(timeout=5)
        executor.shutdown()
        listener.node.destroy_node()


@contextmanager
def _running(arguments: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run the node in another process. At the end, stop it as Ctrl-C does. If this process is killed, it ends, too."""
    process = subprocess.Popen([sys.executable, '-c', _NODE, *arguments], stdin=subprocess.PIPE)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()


def _wait_until(done: Callable[[], bool], process: subprocess.Popen[bytes], timeout_s: float) -> None:
    start = time.monotonic()
    while not done():
        if process.poll() is not None:
            raise HandPoseError(f'the node ended with exit code {process.returncode} before it was ready: '
                                'its last words are above')
        if time.monotonic() - start > timeout_s:
            raise HandPoseError(f'the node was not ready after {timeout_s:.0f} s: does `hand-pose estimator` start?')
        time.sleep(0.05)
