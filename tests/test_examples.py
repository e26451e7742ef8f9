"""The scripts in examples/ do what they say, with the weights that ship, on synthetic hands."""

import csv
import json
import re
import runpy
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hand_pose_ros.bags import BagWriter
from hand_pose_ros.depth import to_units
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.generator import SyntheticHands
from hand_pose_ros.synthetic.hand import rest_pose
from hand_pose_ros.synthetic.kinematics import POSE, forward
from hand_pose_ros.synthetic.shapes import mean_shape
from hand_pose_ros.synthetic.stages import Ingredients

CHECKOUT = Path(__file__).resolve().parents[1]
EXAMPLES = CHECKOUT / 'examples'
FRAMES = 8
FAR_OFF_M = 0.04
"""Whoever mixes up axes, units or joints is further off than this; whoever only guesses badly is not."""

Film = list[tuple[np.ndarray, Intrinsics, np.ndarray, str]]


@pytest.fixture(scope='module')
def film() -> Film:
    """A hand that moves before a perfect sensor: depth, camera, joints [m] and side of each image."""
    hands = SyntheticHands('test', sensors=['senz3d'], ingredients=Ingredients(noise=False, scenes=False))
    return list(hands.sequence(0, FRAMES))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs an example in an empty folder, and gives what it prints."""
    def call(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, 'argv', [name, *map(str, arguments)])
        try:
            runpy.run_path(str(EXAMPLES / name), run_name='__main__')
        except SystemExit as end:
            assert not end.code
        return capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    return call


def write_bag(path: Path, film: Film) -> None:
    with BagWriter(path) as bag:
        for i, (depth, intrinsics, _, _) in enumerate(film):
            bag.write_depth(10**9 + i * 33_333_333, 'camera', depth, intrinsics)


def camera(intrinsics: Intrinsics) -> list[float]:
    return [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]


def test_depth_png(run: Callable[..., str], film: Film) -> None:
    depth, intrinsics, truth, side = film[0]
    cv2.imwrite('depth.png', to_units(depth))
    said = run('depth_png.py', 'depth.png', '--intrinsics', *camera(intrinsics), '--picture', 'joints.png')
    assert re.match(rf'{side} hand, score 0\.\d\d|{side} hand, score 1\.00', said)
    joints = {line.split()[0]: [float(value) for value in line.split()[1:4]] for line in said.splitlines()[1:]}
    assert tuple(joints) == HAND21.joint_names
    assert np.linalg.norm(np.array(list(joints.values())) - truth, axis=1).mean() < FAR_OFF_M
    assert cv2.imread('joints.png').shape[0] == 480

    cv2.imwrite('nothing.png', np.zeros_like(to_units(depth)))
    assert run('depth_png.py', 'nothing.png', '--intrinsics', *camera(intrinsics)) == 'no hand\n'


def test_code_of_the_readme(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r'^```python\n(.*?)^```', (CHECKOUT / 'README.md').read_text(), re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(CHECKOUT)
    exec(code, {})
    assert len(re.findall(r'^index_tip( +-?\d\.\d{3}){3}$', capsys.readouterr().out, re.MULTILINE)) == 1


def test_bag_without_ros(run: Callable[..., str], film: Film) -> None:
    write_bag(Path('film.mcap'), film)
    table = list(csv.DictReader(run('bag_without_ros.py', 'film.mcap').splitlines()))
    assert {row['frame_id'] for row in table} == {'camera'} and {row['side'] for row in table} <= {'left', 'right'}
    found = sorted({int(row['stamp_ns']) for row in table})
    assert len(found) >= FRAMES // 2, 'most images have a hand'
    assert len(table) == len(found) * len(HAND21)
    errors = []
    for stamp in found:
        truth = film[round((stamp - 10**9) / 33_333_333)][2]
        joints = [[float(row[axis]) for axis in ('x_m', 'y_m', 'z_m')]
                  for row in table if int(row['stamp_ns']) == stamp]
        errors.append(np.linalg.norm(np.array(joints) - truth, axis=1).mean())
    assert np.median(errors) < FAR_OFF_M


@pytest.mark.parametrize('command', [
    'depth_png.py missing.png --intrinsics 140 140 80 60',
    f'depth_png.py "{CHECKOUT}/demo/depth.png" --intrinsics 364.5 364.5 256 208 --picture missing',
    'bag_without_ros.py missing.mcap',
    'train_on_your_bags.py --train missing.mcap --val missing.mcap --out mine'])
def test_bad_input_is_one_sentence(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, *arguments = shlex.split(command)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', [name, *arguments])
    with pytest.raises(SystemExit, match=r'missing(\.\w+)?: '):
        runpy.run_path(str(EXAMPLES / name), run_name='__main__')


def test_train_on_your_bags(run: Callable[..., str], film: Film) -> None:
    write_bag(Path('monday.mcap'), film[:6])
    write_bag(Path('tuesday.mcap'), film[6:])
    settings = ('samples=32', 'batch_size=16', 'shard_size=16', 'options.bottleneck=2', 'val_samples=2')
    said = run('train_on_your_bags.py', '--train', 'monday.mcap', '--val', 'tuesday.mcap', '--out', 'mine',
               '--intrinsics', *camera(film[0][1]), '--min-score', 0.3, '--workers', 0,
               *(f'--set={setting}' for setting in settings))
    assert re.search(r'train: [3-6] images of monday.mcap\nval: [12] images of tuesday.mcap', said)
    checkpoint = load_checkpoint('mine/run/best.safetensors')
    assert checkpoint.metadata['skeleton'] == 'hand21' and checkpoint.metadata['architecture'] == 'deep'


@contextmanager
def running(name: str, *arguments: str, said: Path) -> Iterator[None]:
    """An example that runs until Ctrl-C, which is no error, and prints into a file."""
    with said.open('w') as file:
        process = subprocess.Popen([sys.executable, EXAMPLES / name, *arguments], stdout=file)
    try:
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()


def hands_message(joints: np.ndarray, score: float = 0.9, skeleton: str = 'hand21') -> Any:
    from geometry_msgs.msg import Point

    from hand_pose_ros.msg import HandJoints, HandJointsArray
    hand = HandJoints(id='hand_1', side=HandJoints.RIGHT, score=score, confidence=[0.75] * len(joints),
                      joints=[Point(x=x, y=y, z=z) for x, y, z in joints.tolist()])
    return HandJointsArray(skeleton=skeleton, hands=[hand])


@contextmanager
def publishing() -> Iterator[tuple[Any, Callable[[Any, Callable[[], bool]], None]]]:
    """A node, and a function that publishes a message on /hand/joints again and again until something is true."""
    import rclpy

    from hand_pose_ros.msg import HandJointsArray
    rclpy.init()
    node = rclpy.create_node('test')
    publisher = node.create_publisher(HandJointsArray, 'hand/joints', 10)

    def until(message: Any, done: Callable[[], bool]) -> None:
        end = time.monotonic() + 60
        while not done():
            assert time.monotonic() < end, 'nothing came of it in a minute'
            publisher.publish(message)
            rclpy.spin_once(node, timeout_sec=0.02)
    try:
        yield node, until
    finally:
        node.destroy_node()
        rclpy.shutdown()


def pose(**degrees: float) -> np.ndarray:
    """Joints (21, 3) in metres of a right hand whose fingers are bent so."""
    angles = rest_pose()
    for name, value in degrees.items():
        for i, angle in enumerate(POSE):
            if angle.endswith(name):
                angles[i] = float(np.deg2rad(value))
    return forward(mean_shape(), angles[None], rest_pose())[2][0].numpy().astype(np.float64) + np.array([0, 0, 0.5])


def test_subscribe(ros_domain: int, tmp_path: Path) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='needs ROS 2 and the compiled messages')
    joints = np.full((21, 3), 0.5)
    joints[HAND21.joint_names.index('index_tip')] = 0.1, -0.2, 0.6
    nobody = hands_message(joints)
    nobody.hands = []
    said = tmp_path / 'said.txt'
    with publishing() as (_, until), running('subscribe.py', said=said):
        wanted = 'hand_1 right   index tip at +0.100 -0.200 0.600 m, confidence 0.75'
        until(hands_message(joints), lambda: wanted in said.read_text())
        until(nobody, lambda: 'no hand' in said.read_text())
        wanted = 'index tip at +6.000 +0.000 1.000 m'  # the seventh joint of nyu14
        until(hands_message(np.array([[i, 0, 1] for i in range(14)], float), skeleton='nyu14'),
              lambda: wanted in said.read_text())


def test_examples_end_without_a_word_when_nobody_reads_on(ros_domain: int, film: Film, tmp_path: Path) -> None:
    """As after `| head`."""
    write_bag(tmp_path / 'film.mcap', film)
    command = [sys.executable, EXAMPLES / 'bag_without_ros.py', tmp_path / 'film.mcap']
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.wait(timeout=60) == 0 and process.stderr.read() == b''
    pytest.importorskip('hand_pose_ros.msg', reason='needs ROS 2 and the compiled messages')
    command = [sys.executable, EXAMPLES / 'subscribe.py']
    with publishing() as (_, until), subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        try:
            until(hands_message(pose()), lambda: process.poll() is not None)
        finally:
            process.kill()
        assert process.returncode == 0 and process.stderr.read() == b''


def test_gripper(ros_domain: int, tmp_path: Path) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='needs ROS 2 and the compiled messages')
    from std_msgs.msg import Float64MultiArray
    opening: list[float] = []
    arguments = ('--ros-args', '-p', 'max_opening:=0.1')
    with publishing() as (node, until), running('gripper.py', *arguments, said=tmp_path / 'said.txt'):
        node.create_subscription(Float64MultiArray, 'gripper/commands', lambda m: opening.append(m.data[0]), 10)
        until(hands_message(pose()), lambda: bool(opening) and opening[-1] > 0.09)
        fist = pose(mcp_flexion=80, pip_flexion=95, dip_flexion=55)
        until(hands_message(fist), lambda: opening[-1] < 0.005)
        steps = np.diff(opening)
        assert np.abs(steps).max() < 0.05, 'it moves, and does not jump'
        later = time.monotonic() + 0.5
        until(hands_message(pose(), score=0.2), lambda: time.monotonic() > later)
        assert opening[-1] < 0.005, 'a hand that cannot be trusted moves nothing'


@pytest.mark.parametrize('opening, said', [
    ('', 'ROS cannot be used'), (':=wide', "'wide'"), (':=-0.1', '-0.1'), (':=.nan', 'nan')])
def test_gripper_names_an_opening_that_cannot_be_used(
        opening: str, said: str, ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='needs ROS 2 and the compiled messages')
    monkeypatch.setattr(sys, 'argv', ['gripper.py', '--ros-args', '-p', f'max_opening{opening}'])
    with pytest.raises(SystemExit, match=said) as end:
        runpy.run_path(str(EXAMPLES / 'gripper.py'), run_name='__main__')
    assert '\n' not in str(end.value)


@pytest.fixture
def gripper(ros_domain: int) -> Iterator[Any]:
    """The node of gripper.py, open by 0.1 m and in simulated time; its commands are in `openings`."""
    rclpy = pytest.importorskip('rclpy', reason='needs ROS 2')
    pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')
    rclpy.init(args=['--ros-args', '-p', 'max_opening:=0.1', '-p', 'use_sim_time:=true'])
    node = runpy.run_path(str(EXAMPLES / 'gripper.py'))['Gripper']()
    node.openings = []
    node.commands = SimpleNamespace(publish=lambda command: node.openings.extend(command.data))
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_gripper_keeps_its_speed_from_the_first_command_on_and_when_the_clock_steps_back(gripper: Any) -> None:
    from rclpy.clock import ClockType
    from rclpy.time import Time
    fist = hands_message(pose(mcp_flexion=80, pip_flexion=95, dip_flexion=55))
    for seconds in (100.0, 100.1, 1.0, 1.1):  # a bag that begins again
        gripper.get_clock().set_ros_time_override(Time(seconds=seconds, clock_type=ClockType.ROS_TIME))
        gripper.on_hands(fist)
    np.testing.assert_allclose(gripper.openings, [0.08, 0.06, 0.06, 0.04], atol=1e-6)


def test_gripper_follows_one_of_two_hands_until_it_is_gone(gripper: Any) -> None:
    from rclpy.clock import ClockType
    from rclpy.time import Time
    both = hands_message(pose())
    both.hands += hands_message(pose(mcp_flexion=80, pip_flexion=95, dip_flexion=55)).hands
    both.hands[1].id = 'hand_2'
    for tenths in range(1, 7):
        gripper.get_clock().set_ros_time_override(Time(seconds=tenths / 10, clock_type=ClockType.ROS_TIME))
        both.hands[0].score, both.hands[1].score = (0.99, 0.98) if tenths % 2 else (0.98, 0.99)
        gripper.on_hands(both)
    open_wide = gripper.openings[-1]
    assert open_wide > 0.09 and min(gripper.openings) == pytest.approx(open_wide), 'the other is a fist'
    del both.hands[0]
    gripper.get_clock().set_ros_time_override(Time(seconds=0.7, clock_type=ClockType.ROS_TIME))
    gripper.on_hands(both)
    assert gripper.openings[-1] < open_wide - 0.01


def test_gripper_says_once_that_it_needs_the_joints_of_hand21(gripper: Any, capfd: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        gripper.on_hands(hands_message(pose(), skeleton='msra21'))
    gripper.on_hands(hands_message(pose()[:14], skeleton='nyu14'))
    assert not gripper.openings
    said = capfd.readouterr().err
    assert said.count('hand21') == 1 and "'msra21': start the node with a model of hand21" in said


def test_annotated_frames_in_which_no_hand_is_found_are_counted_in_json(tmp_path, shared_data):
    subprocess.run([sys.executable, CHECKOUT / 'benchmarks' / 'annotated_frames.py', shared_data / 'frames',
                    '--model', 'deep_prior', '--min-score', '1', '--json', tmp_path / 'new' / 'a.json'], check=True)

    def no_number(text: str) -> None:
        raise AssertionError(f'{text} is not JSON')

    rows = json.loads((tmp_path / 'new' / 'a.json').read_text(), parse_constant=no_number)
    assert all(row['missed'] == row['tips'] > 0 and row['median_mm'] is None for row in rows.values())
