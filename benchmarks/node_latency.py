"""From the publishing of a VGA depth image in one process to the arrival of its joints, through the node in another.

    python benchmarks/node_latency.py --json node_latency.json
    python benchmarks/node_latency.py --rates 30 60 90 --seconds 60 --profiles both --reliability best_effort
    python benchmarks/node_latency.py --parameters side:=right

Each row is one setting: the rate, the reliability that the camera offers, and which of the two processes has the Fast
DDS profile for large images. `lost` images were published and never answered. `node` says where the time goes inside
of the node (its own medians, from /diagnostics). The rest is transport and waiting for the processor.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hand_pose_ros.files import write_json
from hand_pose_ros.ros import qos

WIDTH, HEIGHT, FOCAL = 640, 480, 570.0
PROFILES = {'none': (False, False), 'camera': (True, False), 'node': (False, True), 'both': (True, True)}
"""Which processes have the profile: (camera, node)."""
COMMAND = [sys.executable, '-m', 'hand_pose_ros.cli']
WARM_UP = 15
"""Images that are published first and do not count."""


def main() -> int:
    """Run every setting in new processes, because a process reads the profile only once."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the rows')
    parser.add_argument('--rates', nargs='+', type=float, default=[30.0], metavar='HZ')
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--reliability', nargs='+', default=['best_effort', 'reliable'],
                        choices=['best_effort', 'reliable'])
    parser.add_argument('--profiles', nargs='+', default=list(PROFILES), choices=list(PROFILES))
    parser.add_argument('--parameters', nargs='+', default=[], metavar='NAME:=VALUE', help='of the node')
    parser.add_argument('--one', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(**json.loads(args.one))))
        return 0
    rows = {}
    print(f'{"setting":<40}{"sent":>6}{"lost":>6}{"p50 ms":>9}{"p99 ms":>9}  in the node')
    for rate, reliability, profile in itertools.product(args.rates, args.reliability, args.profiles):
        camera_has, node_has = PROFILES[profile]
        setting = {'rate': rate, 'seconds': args.seconds, 'reliability': reliability, 'parameters': args.parameters,
                   'node_has_profile': node_has}
        done = subprocess.run([sys.executable, __file__, '--one', json.dumps(setting)], env=environment(camera_has),
                              stdout=subprocess.PIPE, text=True, check=True)
        row = rows[f'{rate:g} Hz, {reliability}, profile: {profile}'] = json.loads(done.stdout.splitlines()[-1])
        print(f'{next(reversed(rows)):<40}{row["published"]:>6}{row["lost"]:>6}{row["p50_ms"]:>9.2f}'
              f'{row["p99_ms"]:>9.2f}  {row["node"]}', flush=True)
    if args.json:
        write_json(args.json, rows)
    return 0


def environment(profile: bool) -> dict[str, str]:
    """This process's environment, with the profile or without any."""
    variables = {name: value for name, value in os.environ.items() if name not in qos.PROFILE_VARIABLES}
    return variables | dict([qos.large_image_profile()] if profile else [])


def hand_image() -> np.ndarray:
    """A flat hand with spread fingers at 0.6 m before a wall, in millimetres, (H, W) uint16."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    scale = FOCAL / 0.6
    palm = np.array([WIDTH / 2, HEIGHT / 2])
    cv2.circle(mask, tuple(palm.astype(int)), round(0.042 * scale), 1, -1)
    for degrees, length in ((-150, 0.085), (-115, 0.115), (-92, 0.125), (-70, 0.115), (-45, 0.095)):
        tip = palm + scale * length * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        cv2.line(mask, tuple(palm.astype(int)), tuple(tip.round().astype(int)), 1, round(0.017 * scale))
    return np.where(mask > 0, 600, 2500).astype(np.uint16)


def measure(rate: float, seconds: float, reliability: str, parameters: list[str],
            node_has_profile: bool) -> dict[str, Any]:
    """One setting: this process is the camera and the listener."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.task import Future
    from sensor_msgs.msg import CameraInfo, Image

    from hand_pose_ros.conventions import stamp_ns
    from hand_pose_ros.msg import HandJointsArray

    sent: dict[int, float] = {}
    received: dict[int, float] = {}
    inside: list[dict[str, str]] = []

    def on_joints(hands: HandJointsArray) -> None:
        received.setdefault(stamp_ns(hands.header), time.perf_counter())

    def on_diagnostics(message: DiagnosticArray) -> None:
        inside.append({value.key: value.value for value in message.status[0].values})

    rclpy.init()
    node = rclpy.create_node('camera')
    offered = QoSProfile(depth=5, reliability=ReliabilityPolicy[reliability.upper()])
    images = node.create_publisher(Image, 'depth/image_rect', offered)
    infos = node.create_publisher(CameraInfo, 'depth/camera_info', offered)
    node.create_subscription(HandJointsArray, 'hand/joints', on_joints, QoSProfile(depth=100))
    node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, QoSProfile(depth=10))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    done: Future[None] = Future()
    thread = threading.Thread(target=executor.spin_until_future_complete, args=(done,), daemon=True)
    thread.start()

    arguments = [item for each in ('min_score:=0.0', *parameters) for item in ('-p', each)]
    process = subprocess.Popen([*COMMAND, 'estimator', '--ros-args', *arguments], env=environment(node_has_profile))
    try:
        while not (images.get_subscription_count() and node.count_publishers('hand/joints')):
            if process.poll() is not None:
                raise SystemExit(f'the node ended with exit code {process.returncode}')
            time.sleep(0.05)
        time.sleep(1.0)
        depth = array('B', hand_image().tobytes())
        image = Image(height=HEIGHT, width=WIDTH, encoding='16UC1', step=2 * WIDTH, data=depth)
        info = CameraInfo(height=HEIGHT, width=WIDTH,
                          k=[FOCAL, 0.0, WIDTH / 2, 0.0, FOCAL, HEIGHT / 2, 0.0, 0.0, 1.0])
        count = WARM_UP + round(rate * seconds)
        start = time.perf_counter()
        for i in range(count):
            time.sleep(max(0.0, start + i / rate - time.perf_counter()))
            image.header.stamp.sec, image.header.stamp.nanosec = divmod(10**9 + round(i / rate * 1e9), 10**9)
            info.header.stamp = image.header.stamp
            infos.publish(info)
            if i >= WARM_UP:
                sent[stamp_ns(image.header)] = time.perf_counter()
            images.publish(image)
        time.sleep(1.0)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=20)
        done.set_result(None)  # to shut down the executor first would destroy what its thread waits with
        thread.join()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    latency = np.array([received[stamp] - at for stamp, at in sent.items() if stamp in received]) * 1e3
    p50, p99 = np.percentile(latency, [50, 99]) if len(latency) else (float('nan'), float('nan'))
    busy = next((report for report in reversed(inside) if 'total_p50_ms' in report), {})
    return {'published': len(sent), 'lost': len(sent) - len(latency), 'p50_ms': float(p50), 'p99_ms': float(p99),
            'node': {key.removesuffix('_p50_ms'): float(value) for key, value in busy.items()
                     if key.endswith('_p50_ms')}}


if __name__ == '__main__':
    sys.exit(main())
