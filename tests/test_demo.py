"""`hand-pose demo`: a bag goes through the live node, and pictures and numbers come out."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

from hand_pose_ros.bags import BagWriter, DepthBag
from hand_pose_ros.cli import main
from hand_pose_ros.cli.demo import _truth, summarise
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandEstimate
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import live
from hand_pose_ros.ros.live import Answers
from hand_pose_ros.skeleton import HAND21, get_skeleton

COUNT = 6


def write_bag(path: Path) -> None:
    """A disc that moves to the right, and its centre as the truth of every joint."""
    intrinsics = Intrinsics(280, 280, 160, 120, 320, 240)
    with BagWriter(path) as bag:
        for i in range(COUNT):
            stamp, center = 10**9 + i * 40_000_000, (0.02 * i, 0.0, 0.6)
            v, u = np.mgrid[:240, :320]
            disc = np.hypot(u - intrinsics.project(center)[0], v - 120) < 28
            depth = np.where(disc, 0.6, 2.0).astype(np.float32)
            bag.write_depth(stamp, 'camera', depth, intrinsics)
            truth = HandEstimate(np.tile(np.float32(center), (21, 1)), HAND21.joint_names, np.ones(21, np.float32), 1.0,
                                 'right', Cube(center, 0.3), 'truth')
            bag.write_hands(stamp, 'camera', [truth], topic='/truth/joints')


def test_the_demo_leaves_pictures_and_numbers(tmp_path: Path, weights: Path, ros_domain: int,
                                              capfd: pytest.CaptureFixture[str]) -> None:
    write_bag(tmp_path / 'hand.mcap')
    out = tmp_path / 'out'
    assert main(['demo', '--bag', str(tmp_path / 'hand.mcap'), '--model', str(weights), '--out', str(out)]) == 0
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['frames_in'] == summary['frames_answered'] == COUNT
    assert 0 < summary['latency_p50_ms'] <= summary['latency_p99_ms']
    if summary['frames_with_a_hand']:  # an untrained network may not be sure enough
        assert 0 < summary['joint_error_mean_mm'] < 300
    sheet = cv2.imread(str(out / 'sheet.png'))
    assert sheet.shape[0] == 2 * 320  # three in a row
    from PIL import Image
    with Image.open(out / 'animation.webp') as animation:
        assert animation.n_frames > 1
        first = np.array(animation.convert('RGB'))[..., ::-1]
        assert animation.info['duration'] == 40  # as fast as it was recorded
    assert np.abs(first[:, :400].astype(int) - sheet[:320, :400]).mean() < 5  # and in the same colours
    said = capfd.readouterr().out
    assert 'frames answered' in said and 'latency p99 ms' in said


def test_a_node_that_cannot_start_is_not_waited_for(tmp_path: Path, ros_domain: int,
                                                    capfd: pytest.CaptureFixture[str]) -> None:
    write_bag(tmp_path / 'hand.mcap')
    assert main(['demo', '--bag', str(tmp_path / 'hand.mcap'), '--model', 'nope', '--out', str(tmp_path / 'out')]) == 1
    assert "hand-pose demo: the node does not start: there is no checkpoint named 'nope'" in capfd.readouterr().err


def test_a_bag_that_needs_options_is_told_at_once_and_who_has_them(tmp_path: Path,
                                                                   capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'uncalibrated.mcap'
    with BagWriter(path) as bag:
        bag.write_depth(1, 'camera', np.ones((120, 160), np.float32),
                        SimpleNamespace(fx=0.0, fy=0.0, cx=0.0, cy=0.0, width=160, height=120))
    assert main(['demo', '--bag', str(path), '--out', str(tmp_path / 'out')]) == 1
    said = capsys.readouterr().err
    assert 'give --intrinsics FX FY CX CY' in said and 'is for `hand-pose evaluate --via-ros` or' in said


def test_the_node_ends_with_the_command_that_started_it_also_if_that_is_killed(tmp_path: Path, weights: Path,
                                                                               ros_domain: int) -> None:
    process = subprocess.Popen(
        [sys.executable, '-m', 'hand_pose_ros.cli', 'demo', '--model', str(weights), '--out', str(tmp_path / 'out')],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        while 'listening to' not in (line := process.stderr.readline()):  # says the node
            assert line
        process.kill()
        assert 'Traceback' not in process.communicate(timeout=200)[1]  # which ends when the node no longer holds it
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def ends(code: int) -> list[str]:
    return [sys.executable, '-c', f'raise SystemExit({code})']


def test_a_node_that_ends_or_hangs_at_its_start_is_told() -> None:
    with subprocess.Popen(ends(3)) as process, pytest.raises(HandPoseError, match='ended with exit code 3 before'):
        live._wait_until(lambda: False, process, 60.0)
    with subprocess.Popen([sys.executable, '-c', 'input()'], stdin=subprocess.PIPE) as process, \
            pytest.raises(HandPoseError, match='the node was not ready after 0 s'):
        live._wait_until(lambda: False, process, 0.0)


@pytest.mark.parametrize('come', [3, 5])
def test_answers_are_waited_for_as_long_as_they_come(monkeypatch: pytest.MonkeyPatch, come: int) -> None:
    now, listener = [0.0], SimpleNamespace(seen=range(5), answers=[])

    def sleep(_: float) -> None:
        now[0] += 0.9 * live.QUIET_S
        if len(listener.answers) < come:
            listener.answers.append(now[0])

    monkeypatch.setattr(live, 'time', SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    live._Listener.wait_until_quiet(listener)
    assert len(listener.answers) == come and (now[0] == listener.answers[-1]) == (come == 5), 'no longer than needed'


@pytest.mark.parametrize(('patient', 'held'), [(False, [True]), (True, [False, True, True])])
def test_the_node_is_waited_for_on_request_and_that_it_dies_is_told(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ros_domain: int, patient: bool, held: list[bool]) -> None:
    asked: list[str] = []
    waited: list[bool] = []

    @contextmanager
    def dead(arguments: list[str]) -> Iterator[subprocess.Popen[bytes]]:
        asked.extend(arguments)
        process = subprocess.Popen(ends(7))
        process.wait()
        yield process

    def play(replay: live.Replay, ready: Callable[[], bool] | None = None) -> None:
        for _ in range(2):  # for the demo, each image but the first waits until the one before is answered
            waited.extend([not ready()] if ready else [])
            replay.published[bag.depth_topic] += 1

    monkeypatch.setattr(live, '_running', dead)
    monkeypatch.setattr(live.Replay, 'play', play)
    monkeypatch.setattr(live, '_wait_until', lambda *_: None)
    monkeypatch.setattr(live._Listener, 'wait_until_quiet', lambda _: waited.append(True))  # always, in the end
    monkeypatch.setattr(live.Replay, 'wait_for_subscribers', lambda *_: None)
    write_bag(tmp_path / 'hand.mcap')
    with DepthBag(tmp_path / 'hand.mcap') as bag, pytest.raises(HandPoseError, match='the node died with exit code 7'):
        live.play_through_node(bag, '/elsewhere/camera_info', {'model': 'a: b'}, patient)
    assert waited == held
    assert {'transport:="compressedDepth"', 'model:="a: b"', 'depth/camera_info:=/elsewhere/camera_info'} <= set(asked)
    own = f'/evaluation_{os.getpid()}'  # a node of the user that runs beside is not disturbed
    assert {f'__ns:={own}', f'/diagnostics:={own}/diagnostics'} <= set(asked)


def test_an_image_without_an_answer_is_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
                                               capsys: pytest.CaptureFixture[str]) -> None:
    answers = Answers('hand21', {1: HandJointsArray()}, {1: 0.012})
    summary = summarise([1, 2], answers, {1: []}, {})
    assert (summary['frames_in'], summary['frames_answered'], summary['frames_with_a_hand']) == (2, 1, 0)
    assert summary['latency_p50_ms'] == pytest.approx(12) and summary['joint_error_mean_mm'] is None
    write_bag(tmp_path / 'truth.mcap')
    truth = _truth(tmp_path / 'truth.mcap', HAND21)
    assert len(truth) == COUNT
    stamp, real = next(iter(truth.items()))
    hand = HandEstimate(real.joints[0] + [0.003, 0, 0.004], HAND21.joint_names, np.ones(21, np.float32), 1.0, 'right',
                        Cube((0, 0, 0.6), 0.3), 'a')
    summary = summarise([stamp, 1], answers, {stamp: [hand], 1: []}, truth)
    assert summary['frames_with_a_hand'] == 1
    assert [summary[f'joint_error_{kind}_mm'] for kind in ('mean', 'median')] == pytest.approx([5, 5])
    assert not _truth(tmp_path / 'truth.mcap', get_skeleton('msra21'))  # as many joints, but others

    write_bag(tmp_path / 'hand.mcap')
    monkeypatch.setattr('hand_pose_ros.ros.live.play_through_node', lambda *_, **__: answers)
    assert main(['demo', '--bag', str(tmp_path / 'hand.mcap'), '--out', str(tmp_path / 'out')]) == 1
    said = capsys.readouterr()
    assert f'{COUNT} images got no answer from the node' in said.err
    assert 'frames answered' in said.out and 'None' not in said.out and 'joint error' not in said.out


def test_an_image_that_cannot_be_decoded_is_left_out_of_the_pictures(monkeypatch: pytest.MonkeyPatch,
                                                                     tmp_path: Path) -> None:
    monkeypatch.setattr('hand_pose_ros.ros.live.play_through_node', lambda *_, **__: Answers('hand21', {}, {}))
    camera, bag = Intrinsics(280, 280, 160, 120, 320, 240), tmp_path / 'hole.mcap'
    with BagWriter(bag) as writer:
        for i, height in enumerate((120, 240, 240)):  # the first is no image of this camera
            writer.write_depth(10**9 + i, 'camera', np.full((height, 320), 2, np.float32), camera)
    assert main(['demo', '--bag', str(bag), '--out', str(tmp_path / 'out')]) == 1
    assert json.loads((tmp_path / 'out' / 'summary.json').read_text())['frames_in'] == 3
    assert (tmp_path / 'out' / 'animation.webp').exists()


def test_ctrl_c_is_one_sentence(ros_domain: int, tmp_path: Path) -> None:
    command = [sys.executable, '-m', 'hand_pose_ros.cli', 'demo', '--out', str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        next(line for line in process.stdout if 'listening to' in line)
        process.send_signal(signal.SIGINT)
        # ROS itself may tell that it could not publish that line any more.
        said = [line for line in process.stdout.read().splitlines() if 'log message to rosout' not in line]
        assert said == ['hand-pose demo: interrupted']
    assert process.returncode == 1
