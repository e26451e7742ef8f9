"""How well a network does on samples that training does not see."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards


def first_samples(shards: DiskShards | MemoryShards, count: int) -> list[Batch]:
    """The first `count` samples, or all where there are fewer, shard by shard."""
    size = shards.dataset.size
    count = count if size is None else min(count, size)
    numbers = range(-(-count // shards.shard_size))
    shards.keep(numbers)
    batches = [shards.read(number) for number in numbers]
    batches[-1] = {key: value[:count - numbers[-1] * shards.shard_size] for key, value in batches[-1].items()}
    return batches


@torch.no_grad()
def estimate(predict: Callable[[Tensor], Tensor], batches: Iterable[Batch], device: torch.device,
             joints: list[int] | slice = slice(None), batch_size: int = 256) -> tuple[Tensor, Tensor]:
    """Estimated and true joints (N, J, 3) in metres of the samples that show a hand.

    Args:
        predict: patches (B, 1, 128, 128) -> joints (B, J, 3) in cube units.
        joints: those of the skeleton that are predicted.
    """
    estimates, truths = [], []
    for whole in batches:
        for start in range(0, len(whole['patch']), batch_size):
            batch = {key: value[start:start + batch_size].to(device) for key, value in whole.items()}
            present, cube = batch['hand_present'], (batch['cube_center'], batch['cube_side'])
            estimates.append(joints_in_metres(predict(batch['patch'].float()).float(), *cube)[present].cpu())
            truths.append(joints_in_metres(batch['joints'][:, joints], *cube)[present].cpu())
    return torch.cat(estimates), torch.cat(truths)
