"""`hand-pose doctor` says what is there, and what is wrong, whatever state the installation is in."""

import importlib
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from hand_pose_ros import __version__
from hand_pose_ros.cli import doctor, main
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models import checkpoints
from hand_pose_ros.resources import resource
from hand_pose_ros.runtime import finder

PROFILE = resource('config/fastdds_large_images.xml')


@pytest.fixture
def weights(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of weights that holds the default ones."""
    monkeypatch.setattr(checkpoints, 'WEIGHTS', tmp_path)
    return shutil.copy(weights, tmp_path / f'{checkpoints.DEFAULT}.safetensors')


def report(capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, list[str]]]:
    """Exit code, and the lines about each thing with their level."""
    code = main(['doctor'])
    *lines, end = capsys.readouterr().out.splitlines()
    about: dict[str, list[str]] = {}
    for line in lines:
        level, thing, text = line[:6].strip(), line[6:22].strip(), line[22:]
        about.setdefault(thing, []).append(f'{level}: {text}')
    wrong = sum(line.startswith('WRONG') for line in lines)
    assert end == {0: 'nothing is wrong', 1: '1 of these is wrong'}.get(wrong, f'{wrong} of these are wrong')
    assert code == int(wrong > 0)
    return code, about


def test_a_good_installation(weights: Path, monkeypatch: pytest.MonkeyPatch,
                             capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='needs ROS 2 and the compiled messages')
    from hand_pose_ros.ros.qos import large_image_profile
    monkeypatch.setenv(*large_image_profile())
    monkeypatch.setattr(doctor, 'SHARED_MEMORY', Path('/nonexistent'))  # whatever this machine has
    code, about = report(capsys)
    assert code == 0
    assert about['package'][0].startswith(f'ok: hand_pose_ros {__version__}')
    assert 'torch' in about['libraries'][0] and 'rosbags' in about['libraries'][0]
    assert about['weights'] == ['ok: hand_dense (default): deep_prior, hand21, cube of 0.3 m',
                                'ok: hand_finder: finds hands in whole images']
    assert 'onnxruntime on the CPU' in about['device'][0] or 'cuda' in about['device'][0]
    assert 'rmw_' in about['ROS 2'][0] and 'messages built' in about['ROS 2'][0]
    assert '16384 kB' in about['DDS profile'][0]


def test_a_gpu_that_this_pytorch_cannot_use(weights: Path, monkeypatch: pytest.MonkeyPatch,
                                            capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(device: str) -> None:
        raise HandPoseError(f'{device} is too old')
    monkeypatch.setattr('torch.cuda.is_available', lambda: True)
    monkeypatch.setattr('torch.cuda.device_count', lambda: 1)
    monkeypatch.setattr('torch.cuda.get_device_name', ['GTX 780 Ti', 'GTX 680'].__getitem__)
    monkeypatch.setattr('hand_pose_ros.runtime.check_device', refuse)
    _, about = report(capsys)
    assert about['device'][0].startswith('ok: onnxruntime on the CPU')
    assert about['device'][1] == 'note: there is GTX 780 Ti, but cuda is too old'
    engine = SimpleNamespace(name='cuda graph', run=lambda patches: None)
    monkeypatch.setattr('hand_pose_ros.runtime.make_engine', lambda network: engine)
    for count, told in ((1, 'GTX 780 Ti'), (2, 'GTX 780 Ti (cuda:0 of 2; device cuda:N chooses another)')):
        monkeypatch.setattr('torch.cuda.device_count', lambda count=count: count)
        assert report(capsys)[1]['device'] == [f'ok: cuda graph on {told}'], 'one GPU is used, not all'


def test_a_gpu_that_pytorch_does_not_see_and_a_check_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('torch.cuda.is_available', lambda: False)
    monkeypatch.setattr('torch.cuda.device_count', lambda: 0)
    monkeypatch.setattr(doctor.shutil, 'which', {'nvidia-smi': '/usr/bin/nvidia-smi'}.get)
    (_, first), (level, text) = doctor.CHECKS['device']()
    assert first.startswith('onnxruntime on the CPU') and level == 'note' and 'sees no GPU: install a PyTorch' in text

    def broken(_: str) -> None:
        raise RuntimeError('no kernels')
    monkeypatch.setattr('hand_pose_ros.models.build', broken)
    assert list(doctor._examine(doctor.CHECKS['device'])) == [
        ('WRONG', 'cannot be used (RuntimeError: no kernels): reinstall the package')]


def test_missing_and_damaged_weights(weights: Path, monkeypatch: pytest.MonkeyPatch,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(finder, 'SHIPPED', weights.with_name('none.safetensors'))
        code, about = report(capsys)
        assert code == 1 and 'none.safetensors' in about['weights'][1] and 'to nearest' in about['weights'][1]
    weights.write_bytes(weights.read_bytes()[:1000])
    code, about = report(capsys)
    assert code == 1 and about['weights'][0].startswith('WRONG: ') and 'damaged' in about['weights'][0]
    weights.unlink()
    code, about = report(capsys)
    assert code == 1 and 'the default weights hand_dense are missing' in about['weights'][0]


def test_without_ros_all_else_is_examined(weights: Path, monkeypatch: pytest.MonkeyPatch,
                                          capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: None)
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    code, about = report(capsys)
    assert code == 0 and about['ROS 2'][0].startswith('note: none') and 'DDS profile' not in about
    monkeypatch.setenv('ROS_DISTRO', 'jazzy')
    code, about = report(capsys)
    assert code == 1 and 'jazzy is sourced, but' in about['ROS 2'][0]


@pytest.mark.parametrize('name, value', [('ROS_DOMAIN_ID', 'seven'), ('RMW_IMPLEMENTATION', 'rmw_of_nobody')])
def test_an_environment_in_which_no_node_starts(name: str, value: str, weights: Path, monkeypatch: pytest.MonkeyPatch,
                                                capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='needs ROS 2 and the compiled messages')
    monkeypatch.setenv(name, value)
    code, about = report(capsys)
    assert code == 1 and about['ROS 2'][0].startswith('WRONG: no node can be started')
    assert f'{name}={value}' in about['ROS 2'][0] and 'DDS profile' not in about


def test_a_library_that_cannot_be_imported(weights: Path, monkeypatch: pytest.MonkeyPatch,
                                           capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, 'rosbags', None)
    code, about = report(capsys)
    assert code == 1 and 'rosbags cannot be imported' in about['libraries'][0] and 'numpy' in about['libraries'][1]


def test_every_dependency_is_examined() -> None:
    text = (Path(__file__).parents[1] / 'pyproject.toml').read_text()
    names = re.findall(r'"([\w-]+)', text[text.index('\ndependencies = ['):text.index('[project.optional')])
    assert {{'opencv-python-headless': 'cv2'}.get(name, name) for name in names} == set(doctor.LIBRARIES)


def test_profiles_of_the_middleware(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2')
    from hand_pose_ros.ros.qos import PROFILE_VARIABLES, large_image_profile
    ours = large_image_profile()[0]
    (other,) = set(PROFILE_VARIABLES) - {ours}

    def lines() -> list[str]:
        return [f'{level}: {text}' for level, text in doctor.CHECKS['DDS profile']()]

    for name in PROFILE_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    assert lines()[0].startswith('note: none') and str(PROFILE) in lines()[0]
    monkeypatch.setenv(other, str(PROFILE))
    assert lines()[0] == f'WRONG: {other} is set, which this ROS does not read: name it {ours}'
    monkeypatch.setenv(ours, str(tmp_path / 'none.xml'))
    assert lines()[0].startswith('WRONG') and 'none.xml cannot be read' in lines()[0]
    small = tmp_path / 'small.xml'
    small.write_text(PROFILE.read_text().replace('16777216', '524288'))
    monkeypatch.setenv(ours, str(small))
    assert lines()[0].startswith('note') and '512 kB, too small' in lines()[0]
    small.write_text('<profiles/>')  # that says nothing of segments
    assert lines()[0].startswith('note') and '512 kB, too small' in lines()[0]
    monkeypatch.setattr('hand_pose_ros.ros.qos.middleware', lambda: 'rmw_cyclonedds_cpp')
    assert lines() == ['ok: not needed with rmw_cyclonedds_cpp']


@pytest.mark.parametrize('distro, version, name', [
    ('jazzy', '9.1.2', 'FASTRTPS_DEFAULT_PROFILES_FILE'), ('kilted', '7.1.5', 'FASTDDS_DEFAULT_PROFILES_FILE'),
    (None, '7.1.5', 'FASTRTPS_DEFAULT_PROFILES_FILE'), (None, '9.1.2', 'FASTDDS_DEFAULT_PROFILES_FILE')])
def test_the_variable_is_that_of_the_release_from_wheels_too(distro: str | None, version: str, name: str,
                                                             monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2')
    from hand_pose_ros.ros import qos
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    if distro:
        monkeypatch.setenv('ROS_DISTRO', distro)
    monkeypatch.setattr(qos, 'version', lambda package: version)
    assert qos.large_image_profile()[0] == name


def test_shared_memory_that_is_too_little_or_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2')
    monkeypatch.setattr(doctor, 'SHARED_MEMORY', tmp_path)
    monkeypatch.setattr(doctor, 'ENOUGH_SHARED_MEMORY', 0)
    (tmp_path / 'fastrtps_port7411').touch()
    [(level, text)] = doctor.CHECKS['shared memory']()
    assert level == 'ok' and text.endswith(f'MB free in {tmp_path}')
    monkeypatch.setattr(doctor.os, 'access', lambda *_: False)
    monkeypatch.setattr(doctor, 'ENOUGH_SHARED_MEMORY', 1 << 60)
    (first, small), (second, foreign) = doctor.CHECKS['shared memory']()
    assert first == second == 'WRONG' and 'too little for large images' in small
    assert foreign.startswith('1 segments of Fast DDS there belong to another user')
