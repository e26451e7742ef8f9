"""Fixtures for every test: the recorded data, and a ROS domain of one's own."""

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# Generated messages check the type of every field only if asked to before they are imported; ROS 2 Humble always does.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'

_CHECKOUT = Path(__file__).resolve().parents[1]
_domain = itertools.count(os.getpid())


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Folder of recorded test data: $HAND_POSE_DATA, else ../shared/data beside the checkout; skips where absent."""
    folder = Path(os.environ.get('HAND_POSE_DATA') or _CHECKOUT.parent / 'shared' / 'data')
    if not folder.is_dir():
        pytest.skip(f'no recorded test data in {folder}: set HAND_POSE_DATA to the folder that holds it')
    return folder


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A ROS_DOMAIN_ID that no other test uses at the same time, on this machine only; returned and in the environment.

    Ask for it before rclpy.init(), or for a whole file: `pytestmark = pytest.mark.usefixtures("ros_domain")`.
    """
    worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
    workers = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
    domain = 1 + (next(_domain) * workers + worker) % 100  # above 101 the ports meet the ephemeral ones
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return domain


@pytest.fixture(scope='module')
def one_thread() -> Iterator[None]:
    """Small batches gain nothing from threads, and lose much on a machine that runs other tests beside."""
    torch = pytest.importorskip('torch')
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
