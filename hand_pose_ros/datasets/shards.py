"""Samples rendered or decoded once and read many times.

Shard i of a dataset always holds the samples [i N, (i + 1) N), so it is the same whoever makes it, and whenever.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from pathlib import Path

import torch
from filelock import FileLock
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from hand_pose_ros.datasets.base import Batch, Dataset, DatasetError
from hand_pose_ros.datasets.memory import keep_freed_memory
from hand_pose_ros.files import in_one_step
from hand_pose_ros.processes import blocked, leave_with_parent

log = logging.getLogger(__name__)


def make_shard(dataset: Dataset, shard: int, shard_size: int) -> Batch:
    """The samples of one shard. Patches are float16, which is exact to 0.04 mm in a cube of 0.3 m."""
    end = (shard + 1) * shard_size if dataset.size is None else min((shard + 1) * shard_size, dataset.size)
    parts = []
    for indices in torch.arange(shard * shard_size, end).split(dataset.chunk):
        part = dataset.batch(indices)
        parts.append({**part, 'patch': part['patch'].half()})
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


class MemoryShards:
    """Shards for rendering on a GPU, made when they are first asked for, and kept on the device that made them."""

    ahead = 0

    def __init__(self, dataset: Dataset, shard_size: int) -> None:
        self.dataset, self.shard_size = dataset, shard_size
        self._shards: dict[int, Batch] = {}

    def keep(self, shards: Iterable[int]) -> None:
        """From now on only these are needed."""
        self._shards = {i: self._shards[i] for i in shards if i in self._shards}

    def read(self, shard: int) -> Batch:
        if shard not in self._shards:
            self._shards[shard] = make_shard(self.dataset, shard, self.shard_size)
        return self._shards[shard]

    def close(self) -> None:
        self._shards.clear()


class DiskShards:
    """Shards in files, made ahead by processes of their own and mapped into memory.

    A file appears under its name only when it is complete, and it carries a checksum. So a run that is killed leaves
    nothing half-made, and several runs can share a folder.

    Args:
        open_dataset: makes the dataset. It is called here and in every process, so it must be picklable.
        folder: where the shards of all datasets are kept.
        workers: processes that make shards.
        limit_gb: size of the folder beyond which the shards that were not used for longest are deleted.
        device: where the shards are read to.
    """

    def __init__(self, open_dataset: Callable[[], Dataset], folder: Path, shard_size: int, workers: int = 1,
                 limit_gb: float = 40, device: torch.device | None = None) -> None:
        self.dataset, self.shard_size = open_dataset(), shard_size
        self.ahead = max(4, 2 * workers)
        """How many shards beyond the needed ones are made in advance, so that every worker has the next one waiting."""
        self._device = device or torch.device('cpu')
        self._folder = folder / f'{self.dataset.fingerprint}-{shard_size}'
        self._folder.mkdir(parents=True, exist_ok=True)
        self._start_pool = partial(
            ProcessPoolExecutor, workers, multiprocessing.get_context('spawn'), _start_worker,
            (open_dataset, shard_size, folder, int(limit_gb * 1e9)))
        self._pool: ProcessPoolExecutor | None = None
        self._making: dict[int, Future[None]] = {}
        self._open: dict[int, Batch] = {}

    def path(self, shard: int) -> Path:
        return self._folder / f'{shard:06d}.safetensors'

    def keep(self, shards: Iterable[int]) -> None:
        """From now on only these are needed: make those that are missing, in this order."""
        needed = list(shards)
        self._open = {i: self._open[i] for i in needed if i in self._open}
        for shard in needed:
            if shard not in self._making and not self.path(shard).exists():
                if self._pool is None:
                    log.info('making samples of %s, which may take minutes; they are kept in %s',
                             self.dataset.name, self._folder)
                    self._pool = self._start_pool()
                with blocked(signal.SIGINT, signal.SIGTERM):
                    self._making[shard] = self._pool.submit(_make_file, shard, self.path(shard))

    def read(self, shard: int) -> Batch:
        """The shard, as soon as it is there.

        Raises:
            DatasetError: a file of the dataset is missing or damaged.
        """
        while shard not in self._open:
            if fresh := shard in self._making:
                self._wait(shard)
            try:
                tensors = read_shard(self.path(shard), check=not fresh)
                self._open[shard] = {key: value.to(self._device) for key, value in tensors.items()}
            except PermissionError as error:  # made by another user, so it is not ours to make again
                raise DatasetError(f'{self.path(shard)} cannot be read ({error.strerror}): correct its permissions, or '
                                   'choose another --cache') from None
            except (FileNotFoundError, DatasetError):  # not made yet, deleted to make room, or damaged: make it
                self.path(shard).unlink(missing_ok=True)
                self.keep([*self._open, shard])
        return self._open[shard]

    def _wait(self, shard: int) -> None:
        try:
            self._making.pop(shard).result()
        except BrokenProcessPool as error:
            raise DatasetError(f'the process that makes samples of {self.dataset.name} was killed '
                               '(is there enough memory?); continue with --resume') from error

    def close(self) -> None:
        """Stop making shards at once. Those that are not complete are lost."""
        pool, self._pool = self._pool, None
        self._making.clear()
        if pool is None:
            return
        workers = list(pool._processes.values())
        for worker in workers:
            worker.kill()
        pool.shutdown(wait=True, cancel_futures=True)
        for worker in workers:
            for path in self._folder.glob(f'.*.{worker.pid}.part'):
                path.unlink(missing_ok=True)


def read_shard(path: Path, check: bool = True) -> Batch:
    """The tensors of a shard, mapped from its file. With `check`, they must be those that were written.

    Raises:
        FileNotFoundError: there is no such file.
        PermissionError: it may not be read.
        DatasetError: the file is damaged, or, with `check`, does not match its checksum.
    """
    os.close(os.open(path, os.O_RDONLY))  # safetensors says of a file that may not be read that it is missing
    try:
        with safe_open(path, 'pt') as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
            checksum = (file.metadata() or {}).get('sha256')
    except SafetensorError as error:
        raise DatasetError(f'{path} is damaged ({error}); delete it and it is made again') from error
    if check and checksum != _checksum(tensors):
        raise DatasetError(f'{path} does not match its checksum; delete it and it is made again')
    with suppress(PermissionError):  # made by another user, so it may be deleted sooner
        os.utime(path)
    return tensors


def _checksum(tensors: Batch) -> str:
    digest = hashlib.sha256()
    for key in sorted(tensors):
        digest.update(f'{key}{tuple(tensors[key].shape)}'.encode())
        digest.update(tensors[key].contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


_worker: tuple[Dataset, int, Path, int]
"""In a process that makes shards: the dataset, the shard size, the folder of all shards and its limit in bytes."""


def _start_worker(open_dataset: Callable[[], Dataset], shard_size: int, root: Path, limit: int) -> None:
    global _worker
    torch.set_num_threads(1)
    keep_freed_memory()
    leave_with_parent()
    _worker = open_dataset(), shard_size, root, limit


def _make_file(shard: int, path: Path) -> None:
    dataset, shard_size, root, limit = _worker
    # The processes of a run under torchrun all ask for the same shards. Those that wait here find the shard made.
    with FileLock(path.with_suffix('.lock')):
        if path.exists():
            return
        for left in path.parent.glob(f'.{path.name}.*.part'):  # by a process that was killed while it held the lock
            left.unlink(missing_ok=True)
        tensors = {key: value.cpu().contiguous() for key, value in make_shard(dataset, shard, shard_size).items()}
        with in_one_step(path) as part:
            save_file(tensors, part, metadata={'sha256': _checksum(tensors)})
    _limit_size(root, limit, path)


def _limit_size(root: Path, limit: int, made: Path) -> None:
    """Delete the shards that were used longest ago, but not the one just made. Who has one open can still read it."""
    files = []
    for path in root.glob('*/*.safetensors'):
        with suppress(FileNotFoundError):  # another process may make room, too
            files.append((path.stat().st_mtime, path.stat().st_size, path))
    used = 0
    for _, size, path in sorted(files, reverse=True):
        used += size
        if used > limit and path != made:
            path.unlink(missing_ok=True)
