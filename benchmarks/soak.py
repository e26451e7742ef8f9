"""The live node for a long time: memory over many images and lifecycle cycles, and how soon it is back after kill -9.

    python benchmarks/soak.py --json soak.json
    python benchmarks/soak.py --frames 2000 --cycles 10 --reloads 3 --kills 1

The images are those of node_latency.py, each published when the one before it is answered. A cycle deactivates and
activates the node. A reload also cleans it up and configures it, which loads the network again. After each of them, an
image is answered. Memory is the resident set of the node's process. Its growth is measured from the end of the warm-up,
a twentieth of the images or cycles, to the end.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState
from node_latency import COMMAND, FOCAL, HEIGHT, WIDTH, environment, hand_image
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image
from tqdm import tqdm

from hand_pose_ros.conventions import stamp_ns
from hand_pose_ros.files import write_json
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import qos

PATIENCE_S = 1.0
"""An image that is not answered within this time counts as lost."""
START_S = 120.0
SAMPLES = 100
RATE_HZ = 30.0
"""Of the camera while the node is killed."""


class Rig:
    """A camera and a listener in this process, and the node in another."""

    def __init__(self, model: str) -> None:
        self._arguments = ['-p', 'min_score:=0.0', *(['-p', f'model:={model}'] if model else [])]
        self.node = rclpy.create_node('camera')
        self._images = self.node.create_publisher(Image, 'depth/image_rect', QoSProfile(depth=1))
        self._infos = self.node.create_publisher(CameraInfo, 'depth/camera_info', QoSProfile(depth=1))
        self.node.create_subscription(HandJointsArray, 'hand/joints', self._on_joints, QoSProfile(depth=10))
        self._transitions = self.node.create_client(ChangeState, '/estimator/change_state')
        self._image = Image(height=HEIGHT, width=WIDTH, encoding='16UC1', step=2 * WIDTH,
                            data=array('B', hand_image().tobytes()))
        self._info = CameraInfo(height=HEIGHT, width=WIDTH,
                                k=[FOCAL, 0.0, WIDTH / 2, 0.0, FOCAL, HEIGHT / 2, 0.0, 0.0, 1.0])
        self._answered = threading.Condition()
        self._newest = self._sent = 0
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._done: Future[None] = Future()
        self._thread = threading.Thread(
            target=self._executor.spin_until_future_complete, args=(self._done,), daemon=True)
        self._thread.start()
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the node, in another process."""
        self.process = subprocess.Popen([*COMMAND, 'estimator', '--ros-args', *self._arguments],
                                        env=environment(profile=False))

    def publish(self) -> int:
        """Publish the next image, and return its stamp in ns."""
        self._sent += 33_333_333
        self._image.header.stamp.sec, self._image.header.stamp.nanosec = divmod(self._sent, 1_000_000_000)
        self._info.header.stamp = self._image.header.stamp
        self._infos.publish(self._info)
        self._images.publish(self._image)
        return self._sent

    def wait(self, stamp: int, seconds: float) -> bool:
        """Whether an image of this stamp, or a later one, is answered in time."""
        with self._answered:
            if self._answered.wait_for(lambda: self._newest >= stamp, seconds):
                return True
        if self.process is not None and self.process.poll() is not None:
            raise SystemExit(f'the node ended with exit code {self.process.returncode}')
        return False

    def wait_until_it_answers(self) -> float:
        """Publish at the rate of a camera until there is an answer. Returns the seconds that it took."""
        start, first = time.perf_counter(), self._sent + 1
        while not self.wait(first, 1 / RATE_HZ):
            if time.perf_counter() - start > START_S:
                raise SystemExit(f'the node did not answer within {START_S:.0f} s')
            self.publish()
        return time.perf_counter() - start

    def transition(self, label: str) -> None:
        """Take the node to another state."""
        request = ChangeState.Request()
        request.transition.label = label
        done = threading.Event()
        if not self._transitions.wait_for_service(START_S):
            raise SystemExit(f'the node offers no services, {START_S:.0f} s after it was started')
        future = self._transitions.call_async(request)
        future.add_done_callback(lambda _: done.set())
        if not done.wait(START_S) or not future.result().success:
            raise SystemExit(f'the node did not {label}')

    def usage(self) -> dict[str, int]:
        """Resident memory [kB], threads and open files of the node."""
        assert self.process is not None
        files = Path(f'/proc/{self.process.pid}')
        rollup = (files / 'smaps_rollup').read_text()  # exact; status counts up to 64 pages per thread too few
        return {'resident_kb': int(rollup.split('Rss:')[1].split()[0]), 'threads': len(os.listdir(files / 'task')),
                'files': len(os.listdir(files / 'fd'))}

    def stop(self, number: int = signal.SIGINT) -> None:
        """End the node by a signal."""
        assert self.process is not None
        self.process.send_signal(number)
        self.process.wait(timeout=30)

    def close(self) -> None:
        """Leave nothing running."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
        self._done.set_result(None)  # to shut down the executor first would destroy what its thread waits with
        self._thread.join(timeout=5)
        self._executor.shutdown()
        self.node.destroy_node()

    def _on_joints(self, hands: HandJointsArray) -> None:
        with self._answered:
            self._newest = max(self._newest, stamp_ns(hands.header))
            self._answered.notify()


def growth(samples: list[dict[str, int]]) -> dict[str, Any]:
    """From the end of the warm-up to the end: first, last and largest value, and the growth of memory in percent."""
    first, last = samples[0], samples[-1]
    result = {'first': first, 'last': last, 'largest_kb': max(sample['resident_kb'] for sample in samples),
              'growth_percent': round(100 * (last['resident_kb'] / first['resident_kb'] - 1), 3)}
    print(f'  resident memory {first["resident_kb"] / 1024:.1f} -> {last["resident_kb"] / 1024:.1f} MiB '
          f'({result["growth_percent"]:+.2f} %, at most {result["largest_kb"] / 1024:.1f}), '
          f'threads {first["threads"]} -> {last["threads"]}, files {first["files"]} -> {last["files"]}', flush=True)
    return result


def soak(rig: Rig, frames: int) -> dict[str, Any]:
    """Publish this many images, each as soon as the one before it is answered."""
    samples, lost, start = [], 0, time.perf_counter()
    for i in tqdm(range(frames), unit='image', disable=None):
        lost += not rig.wait(rig.publish(), PATIENCE_S)
        if i >= frames // 20 and (i % max(1, frames // SAMPLES) == 0 or i == frames - 1):
            samples.append(rig.usage())
    seconds = time.perf_counter() - start
    print(f'{frames} images in {seconds:.0f} s, {lost} not answered')
    return {'images': frames, 'lost': lost, 'images_per_second': round(frames / seconds, 1), **growth(samples)}


def cycle(rig: Rig, cycles: int, *transitions: str) -> dict[str, Any]:
    """Make the transitions again and again, with an answer in between."""
    samples = []
    for i in tqdm(range(cycles), unit='cycle', disable=None):
        for label in transitions:
            rig.transition(label)
        rig.wait_until_it_answers()
        if i >= cycles // 20:
            samples.append(rig.usage())
    print(f'{cycles} times {", ".join(transitions)}')
    return {'cycles': cycles, **growth(samples)}


def kill(rig: Rig) -> float:
    """Kill the node under load, and start it again at once. Returns the seconds from its start to the first joints."""
    for _ in range(30):
        rig.wait(rig.publish(), 1 / RATE_HZ)
    rig.stop(signal.SIGKILL)
    rig.start()
    return round(rig.wait_until_it_answers(), 3)


def main() -> int:
    """Run all four, and print and write what they gave."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--frames', type=int, default=100_000)
    parser.add_argument('--cycles', type=int, default=200)
    parser.add_argument('--reloads', type=int, default=20)
    parser.add_argument('--kills', type=int, default=5)
    parser.add_argument('--model', default='', help='name of weights that ship, or a checkpoint (the default weights)')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the numbers')
    args = parser.parse_args()
    if min(args.frames, args.cycles, args.reloads) < 1:
        parser.error('--frames, --cycles and --reloads must be at least 1')
    qos.let_large_images_through()
    rclpy.init()
    rig = Rig(args.model)
    try:
        rig.start()
        result: dict[str, Any] = {'start_s': round(rig.wait_until_it_answers(), 3)}
        result['soak'] = soak(rig, args.frames)
        result['lifecycle'] = cycle(rig, args.cycles, 'deactivate', 'activate')
        result['reload'] = cycle(rig, args.reloads, 'deactivate', 'cleanup', 'configure', 'activate')
        result['first_joints_after_kill_s'] = [kill(rig) for _ in range(args.kills)]
        print(f'first joints after kill -9 and restart: {result["first_joints_after_kill_s"]} s')
        rig.stop()
    finally:
        rig.close()
        rclpy.try_shutdown()
    if args.json:
        write_json(args.json, result)
    return 0


if __name__ == '__main__':
    sys.exit(main())
