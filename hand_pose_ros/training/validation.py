"""How good a network is on samples that training does not see."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards


def some_samples(shards: DiskShards | MemoryShards, count: int) -> list[Batch]:
    """`count` samples, shard by shard.

    From an endless dataset, these are the first ones. A finite dataset is in the order of recording. So its samples are
    spread evenly over it, or all are taken if there are fewer.
    """
    size, n = shards.dataset.size, shards.shard_size
    numbers = torch.arange(count) if size is None else torch.linspace(
        0, size - 1, min(count, size), dtype=torch.float64).round().long()
    needed = (numbers // n).unique().tolist()
    shards.keep(needed)
    batches = []
    for shard in needed:
        rows = numbers[numbers // n == shard] - shard * n
        batches.append({key: value[rows.to(value.device)] for key, value in shards.read(shard).items()})
    return batches


@torch.no_grad()
def estimate(predict: Callable[[Tensor], Tensor], batches: Iterable[Batch], device: torch.device,
             joints: list[int] | slice = slice(None), batch_size: int = 256) -> tuple[Tensor, Tensor]:
    """Estimated and true joints (N, J, 3) in metres, of the samples that show a hand.

    Args:
        predict: patches (B, 1, 128, 128) -> joints (B, J, 3) in cube units.
        joints: numbers of the joints of the skeleton that are predicted.
    """
    estimates, truths = [], []
    for whole in batches:
        for start in range(0, len(whole['patch']), batch_size):
            batch = {key: value[start:start + batch_size].to(device) for key, value in whole.items()}
            present, cube = batch['hand_present'], (batch['cube_center'], batch['cube_side'])
            estimates.append(joints_in_metres(predict(batch['patch'].float()).float(), *cube)[present].cpu())
            truths.append(joints_in_metres(batch['joints'][:, joints], *cube)[present].cpu())
    return torch.cat(estimates), torch.cat(truths)
