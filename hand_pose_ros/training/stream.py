"""Which samples a training step sees. They depend only on the seed and the step, so a resumed run is the same."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from hand_pose_ros.datasets import Batch, DatasetError
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards


class SampleStream:
    """Samples in stages. A stage shows every sample of a window of shards once, in random order.

    - In a finite dataset, the window is the whole dataset. So a stage is an epoch.
    - In an endless dataset, the window slides. Stage s shows the `reuse` shards up to the s-th, while later shards are
      rendered. So each sample is used `reuse` times, and is augmented differently each time. Training starts as soon
      as the first shard is there.

    Args:
        first: shards before this one are left out.
        last: shards from this one on are left out (finite datasets only).
        part: (rank, world size). This process takes its equal part of every batch.

    Raises:
        DatasetError: no shard is left.
    """

    def __init__(self, shards: DiskShards | MemoryShards, batch_size: int, seed: int, reuse: int = 1,
                 first: int = 0, last: int | None = None, part: tuple[int, int] = (0, 1)) -> None:
        self.shards, self.batch_size, self.seed, self.reuse = shards, batch_size, seed, reuse
        self.first, self.part = first, part
        size, n = shards.dataset.size, shards.shard_size
        self._window: range | None = None
        self.epoch_size: int | None = None
        """Number of samples in a pass over a finite dataset; None = endless."""
        if size is not None:
            self._window = range(first, min(-(-size // n), last if last is not None else size))
            self.epoch_size = min(self._window.stop * n, size) - first * n
            if self.epoch_size <= 0:
                raise DatasetError(f'{shards.dataset.name} has {-(-size // n)} shards of {n} samples: none is left '
                                   f'from first_shard={first} to last_shard={last}')
        self._stage: tuple[int, NDArray[np.int64]] | None = None

    def batch(self, step: int) -> tuple[Batch, torch.Tensor]:
        """The samples of a step, with patches as float32, and their numbers (B,) in the order of use."""
        rank, world = self.part
        share = self.batch_size // world
        start = step * self.batch_size + rank * share
        numbers: NDArray[np.int64] = np.arange(start, start + share)
        parts: list[Batch] = []
        while len(numbers):
            stage, offset, size = self._locate(int(numbers[0]))
            here = numbers[:size - offset]
            parts += self._read(stage, size, offset, here)
            numbers = numbers[len(here):]
        batch = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
        batch['patch'] = batch['patch'].float()
        return batch, batch.pop('number')

    def shards_used(self, step: int) -> int:
        """The steps before this one have seen only shards with a lower number than this."""
        if self._window is not None:
            return self._window.stop
        return self.first + self._locate(max(0, step * self.batch_size - 1))[0] + 1

    def window(self, stage: int) -> range:
        """The shards that a stage shows."""
        if self._window is not None:
            return self._window
        return range(self.first + max(0, stage - self.reuse + 1), self.first + stage + 1)

    def _locate(self, number: int) -> tuple[int, int, int]:
        """The stage of a sample, its place in the stage, and the size of the stage."""
        if self.epoch_size is not None:
            return number // self.epoch_size, number % self.epoch_size, self.epoch_size
        n, k = self.shards.shard_size, self.reuse
        rising = n * k * (k - 1) // 2  # the first k - 1 stages show 1, 2, ... k - 1 shards
        if number >= rising:
            return k - 1 + (number - rising) // (n * k), (number - rising) % (n * k), n * k
        stage = next(s for s in range(k) if number < n * (s + 1) * (s + 2) // 2)
        return stage, number - n * stage * (stage + 1) // 2, n * (stage + 1)

    def _read(self, stage: int, size: int, offset: int, numbers: NDArray[np.int64]) -> Iterator[Batch]:
        """The samples with these numbers, shard by shard. Their places in the stage begin at `offset`."""
        n, window = self.shards.shard_size, self.window(stage)
        if self._stage is None or self._stage[0] != stage:
            self._stage = stage, np.random.default_rng((self.seed, stage)).permutation(size)
            ahead = range(window.stop, window.stop + self.shards.ahead) if self._window is None else ()
            self.shards.keep([*window, *ahead])
        shards, rows = np.divmod(self._stage[1][offset:offset + len(numbers)], n)
        for shard in np.unique(shards):
            tensors, here = self.shards.read(window[int(shard)]), shards == shard
            wanted = torch.from_numpy(rows[here]).to(tensors['joints'].device)
            yield {'number': torch.from_numpy(numbers[here]), **{key: value[wanted] for key, value in tensors.items()}}
