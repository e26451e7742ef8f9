"""`hand-pose doctor`: what is installed here, whether it works, and what to do if it does not."""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

from hand_pose_ros import __version__
from hand_pose_ros.errors import HandPoseError

DESCRIPTION = 'Check what is installed here and whether it works, and say what to do if it does not.'

EXAMPLES = """examples:
  hand-pose doctor
  hand-pose doctor > report.txt        # to be pasted into an issue

Each line begins with ok, note (worth knowing) or WRONG (with what to do). The exit code is 1 if anything is WRONG.
"""
LIBRARIES = ('numpy', 'cv2', 'torch', 'safetensors', 'onnx', 'onnxruntime', 'rosbags', 'scipy', 'matplotlib', 'tqdm',
             'filelock')
SHARED_MEMORY = Path('/dev/shm')
DEFAULT_SEGMENT = 512 * 1024
"""Bytes of the shared-memory segment of Fast DDS without a profile."""
VGA_IMAGE = 640 * 480 * 2
ENOUGH_SHARED_MEMORY = 64 << 20
"""Bytes. Every process with the profile for large images takes a segment of 16 MB."""

Findings = Iterator[tuple[Literal['ok', 'note', 'WRONG'], str]]
"""What a check finds: level and text of each line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""


def run(args: argparse.Namespace) -> int:
    """Print the report. Returns 1 if anything is wrong."""
    wrong = 0
    for about, check in CHECKS.items():
        for level, text in _examine(check):
            wrong += level == 'WRONG'
            print(f'{level:<6}{about:<16}{text}', flush=True)
    print(f'{wrong} of these {"is" if wrong == 1 else "are"} wrong' if wrong else 'nothing is wrong')
    return int(wrong > 0)


def _examine(check: Callable[[], Findings]) -> Findings:
    """The findings of one check. If the check fails, this is a finding, too."""
    try:
        yield from check()
    except HandPoseError as error:
        yield 'WRONG', str(error)
    except Exception as error:  # a broken installation can cause any error
        yield 'WRONG', f'cannot be used ({type(error).__name__}: {error}): reinstall the package'


def _package() -> Findings:
    yield 'ok', f'hand_pose_ros {__version__} in {Path(__file__).parents[1]}'


def _python() -> Findings:
    yield 'ok', f'{platform.python_version()} on {platform.system()} {platform.machine()}: {sys.executable}'


def _libraries() -> Findings:
    versions = []
    for name in LIBRARIES:
        try:
            module = importlib.import_module(name)
            versions.append(f'{name} {getattr(module, "__version__", None) or importlib.metadata.version(name)}')
        except Exception as error:  # ImportError, or what a library compiled against another one raises
            yield 'WRONG', (f'{name} cannot be imported ({error}): install it into this Python with '
                            f'{sys.executable} -m pip install --upgrade, as pyproject.toml names it')
    yield 'ok', ', '.join(versions)


def _device() -> Findings:
    import numpy as np
    import torch

    from hand_pose_ros.models import build
    from hand_pose_ros.runtime import check_device, default_threads, make_engine
    from hand_pose_ros.runtime.onnx_engine import OnnxEngine

    count = torch.cuda.device_count()
    gpu = torch.cuda.get_device_name(0) if count else ''  # the one that is used
    if count > 1:
        gpu += f' (cuda:0 of {count}; device cuda:N chooses another)'
    engine = make_engine(build('deep_prior'))
    engine.run(np.zeros((1, 1, 128, 128), np.float32))  # builds and runs the real thing
    on_cpu = isinstance(engine, OnnxEngine)
    yield 'ok', f'{engine.name} on {f"the CPU, {default_threads()} threads of {os.cpu_count()}" if on_cpu else gpu}'
    if gpu and on_cpu:
        try:
            check_device('cuda')
        except HandPoseError as error:
            yield 'note', f'there is {gpu}, but {error}'
    elif not gpu and shutil.which('nvidia-smi'):
        yield 'note', (f'there is an NVIDIA driver, but PyTorch {torch.__version__} sees no GPU: install a PyTorch '
                       'for CUDA if the network should run there')


def _weights() -> Findings:
    from hand_pose_ros.models.checkpoints import DEFAULT, available, load_checkpoint
    from hand_pose_ros.runtime.finder import SHIPPED

    for name in available():
        about = load_checkpoint(name).metadata
        yield 'ok', (f'{name}{" (default)" if name == DEFAULT else ""}: {about["architecture"]}, {about["skeleton"]}, '
                     f'cube of {about["cube_side"]:g} m')
    if DEFAULT not in available():
        yield 'WRONG', f'the default weights {DEFAULT} are missing: reinstall the package, or name others with --model'
    try:
        load_checkpoint(SHIPPED)
        yield 'ok', f'{SHIPPED.stem}: finds hands in whole images'
    except HandPoseError as error:
        yield 'WRONG', f'{error}; or set the parameter detector to nearest'


def _ros() -> Findings:
    distro = os.environ.get('ROS_DISTRO')
    if importlib.util.find_spec('rclpy') is None:
        if distro:
            yield 'WRONG', (f'ROS 2 {distro} is sourced, but {sys.executable} finds no rclpy: use the Python that this '
                            'ROS was built for, in a virtual environment made with --system-site-packages')
        else:
            yield 'note', ('none: the node, replay and demo need it, and all else works without it. Source its setup '
                           "file, or run pip install '.[ros]' in the checkout")
        return
    settings = _ros_settings()
    if failure := _ros_failure(settings):
        remedy = f'; correct or unset {", ".join(settings)}' if settings else ''
        yield 'WRONG', f'no node can be started: {failure}{remedy}'
        return
    from hand_pose_ros.ros.qos import middleware
    yield 'ok', ', '.join([distro or 'from wheels', middleware(), 'messages built', *settings])


def _ros_settings() -> tuple[str, ...]:
    """The environment variables that ROS reads, as NAME=value."""
    return tuple(f'{name}={os.environ[name]}' for name in (
        'RMW_IMPLEMENTATION', 'ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY')
        if name in os.environ)


@lru_cache(maxsize=1)
def _ros_failure(_settings: tuple[str, ...]) -> str:
    """Why no node can be started with these settings; empty if one can. ROS may end the process that tries it."""
    code = ('import sys\nfrom hand_pose_ros.errors import HandPoseError\ntry:\n    from hand_pose_ros import ros\n'
            '    import rclpy\n    ros.init()\n    rclpy.create_node("doctor")\n'
            'except HandPoseError as error:\n    sys.exit(str(error))')
    tried = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    said = [line for line in tried.stderr.splitlines() if line.strip()] or [f'exit code {tried.returncode}']
    return said[-1] if tried.returncode else ''


def _dds_profile() -> Findings:
    if importlib.util.find_spec('rclpy') is None or _ros_failure(_ros_settings()):
        return
    from hand_pose_ros.ros.qos import PROFILE_VARIABLES, large_image_profile, middleware

    variable, ours = large_image_profile()
    given = os.environ.get(variable)
    if 'fastrtps' not in middleware():
        yield 'ok', f'not needed with {middleware()}'
    elif given is None:
        for other in set(PROFILE_VARIABLES) & set(os.environ):
            yield 'WRONG', f'{other} is set, which this ROS does not read: name it {variable}'
        yield 'note', (f'none: publishers in this shell get a shared-memory segment of {DEFAULT_SEGMENT // 1024} kB, '
                       f'too small for a VGA depth image ({VGA_IMAGE // 1000} kB). Before you start the camera driver, '
                       f'export {variable}={ours} (replay and demo do so themselves)')
    else:
        try:
            segment = segment_size(Path(given))
        except (OSError, ElementTree.ParseError, ValueError) as error:
            yield 'WRONG', f'{variable}={given} cannot be read ({error}): name a profile such as {ours}'
        else:
            text = f'{variable}={given}: shared-memory segment of {segment // 1024} kB'
            if segment > VGA_IMAGE:
                yield 'ok', text
            else:
                yield 'note', f'{text}, too small for a VGA depth image: {ours} has a larger one'


def segment_size(profile: Path) -> int:
    """Bytes of the shared-memory segment that a Fast DDS profile asks for.

    Raises:
        OSError, xml.etree.ElementTree.ParseError, ValueError: the file is missing or damaged.
    """
    sizes = [int(element.text or '') for element in ElementTree.parse(profile).iter()
             if element.tag.rpartition('}')[2] == 'segment_size']
    return max(sizes, default=DEFAULT_SEGMENT)


def _shared_memory() -> Findings:
    if importlib.util.find_spec('rclpy') is None or not SHARED_MEMORY.is_dir():
        return
    usage = shutil.disk_usage(SHARED_MEMORY)
    segments = [path for pattern in ('fastdds_*', 'fastrtps_*') for path in SHARED_MEMORY.glob(pattern)]
    foreign = [path for path in segments if not os.access(path, os.W_OK)]
    text = f'{usage.free >> 20} MB of {usage.total >> 20} MB free in {SHARED_MEMORY}'
    if usage.free < ENOUGH_SHARED_MEMORY:
        yield 'WRONG', f'{text}, too little for large images: start the container with --ipc=host or --shm-size=1g'
    else:
        yield 'ok', text
    if foreign:
        yield 'WRONG', (f'{len(foreign)} segments of Fast DDS there belong to another user, so processes of that user '
                        'are not heard here: run all as the same user')


CHECKS = {'package': _package, 'python': _python, 'libraries': _libraries, 'device': _device, 'weights': _weights,
          'ROS 2': _ros, 'DDS profile': _dds_profile, 'shared memory': _shared_memory}
