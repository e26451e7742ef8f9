"""Samples per second that one core renders, augments and trains on: `python benchmarks/training_speed.py`.

Time of the process and not of the clock is taken, so the numbers hold on a machine that is busy with other things.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from hand_pose_ros.datasets import open_dataset
from hand_pose_ros.datasets.memory import keep_freed_memory
from hand_pose_ros.models import build
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.training.augmentation import PRESETS, augment
from hand_pose_ros.training.objectives import objective_for
from hand_pose_ros.training.optimizers import make_optimizer
from hand_pose_ros.training.recipes import get_recipe


def rate(samples: int, work: Callable[[], object], repeats: int = 5) -> float:
    """Samples per second, after a warm-up."""
    work()
    start = time.process_time()
    for _ in range(repeats):
        work()
    return samples * repeats / (time.process_time() - start)


def training(network: str, recipe_name: str, precision: torch.dtype | None) -> float:
    """Steps of a recipe on samples that are there already."""
    recipe = get_recipe(recipe_name)
    module = build(network, joints=21, bottleneck=30)
    objective = objective_for(module, recipe, HAND21)
    objective.train().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = make_optimizer(recipe, objective)
    numbers = torch.arange(recipe.batch_size)
    batch = augment(open_dataset('synthetic', 'train').batch(numbers), PRESETS['none'], numbers, seed=0)

    def step() -> None:
        with torch.autocast('cpu', precision, enabled=precision is not None):
            loss = torch.stack(list(objective(batch).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return rate(recipe.batch_size, step)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    data, numbers = open_dataset('synthetic', 'train'), torch.arange(128)
    batch = data.batch(numbers)
    print(f'render             {rate(128, lambda: data.batch(numbers)):7.0f}')
    print(f'augment (modern)   {rate(128, lambda: augment(batch, PRESETS["modern"], numbers, seed=0)):7.0f}')
    for network in ('shallow', 'deep', 'multi_scale', 'hand_dense', 'two_looks'):
        recipe = 'modern' if network in ('hand_dense', 'two_looks') else 'paper'
        single, half = (training(network, recipe, precision) for precision in (None, torch.bfloat16))
        print(f'{network:18s} {single:7.0f}   bfloat16 {half:7.0f}')


if __name__ == '__main__':
    main()
