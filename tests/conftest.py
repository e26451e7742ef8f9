"""Fixtures for every test: the recorded data, weights, and a ROS domain of one's own."""

import functools
import itertools
import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from unittest.mock import patch

import pytest

# Generated messages check the type of every field only if asked to before they are imported; ROS 2 Humble always does.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'

_CHECKOUT = Path(__file__).resolve().parents[1]
_numbers = itertools.count(os.getpid())


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Folder of recorded test data: $HAND_POSE_DATA, else ../shared/data beside the checkout; skips where absent."""
    folder = Path(os.environ.get('HAND_POSE_DATA') or _CHECKOUT.parent / 'shared' / 'data')
    if not folder.is_dir():
        pytest.skip(f'no recorded test data in {folder}: set HAND_POSE_DATA to the folder that holds it')
    return folder


@pytest.fixture(scope='session')
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that has learned nothing, where it does not matter what it says, only that it says something."""
    import torch

    from hand_pose_ros.models import build
    from hand_pose_ros.models.checkpoints import save_checkpoint
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp('weights') / 'untrained.safetensors'
    save_checkpoint(path, build('deep_prior', joints=21), {'skeleton': 'hand21', 'cube_side': 0.3})
    return path


@pytest.fixture(scope='module')
def load_once() -> Iterator[None]:
    """Where many estimators are made of the same weights, to load them each time would take most of the time."""
    from hand_pose_ros import estimator
    with pytest.MonkeyPatch.context() as caching:
        for where, name in ((estimator, 'load_checkpoint'), (estimator, 'make_engine'),
                            (estimator.Finder, 'from_pretrained')):
            caching.setattr(where, name, functools.cache(getattr(where, name)))
        yield


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that no other test on this machine uses at the same time; also in the environment, which is
    afterwards as before: commands set the profile of DDS there.

    Ask for it before rclpy.init(), or for a whole file: `pytestmark = pytest.mark.usefixtures("ros_domain")`.
    """
    with socket.socket() as lock, patch.dict(os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST'):
        for number in _numbers:
            domain = 1 + number % 100  # above 101 the ports meet the ephemeral ones
            with suppress(OSError):  # another test has this domain
                lock.bind(('127.0.0.1', 7400 + 250 * domain))  # over TCP, DDS does not use its port
                break
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        yield domain


@pytest.fixture(scope='module')
def one_thread() -> Iterator[None]:
    """Small batches gain nothing from threads, and lose much on a machine that runs other tests beside."""
    torch = pytest.importorskip('torch')
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
