"""Samples per second that one core, or a GPU, renders, augments and trains on: `python benchmarks/training_speed.py`.

On a core, the time of the process is measured, not that of the clock. So the numbers also hold on a busy machine. On a
GPU (`--device cuda`), a batch has 1,024 samples (2,048 to render), and a step is a CUDA graph.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import torch

from hand_pose_ros.datasets import open_dataset
from hand_pose_ros.datasets.memory import keep_freed_memory
from hand_pose_ros.models import build
from hand_pose_ros.runtime.cuda_engine import WARM_UP
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.training.augmentation import PRESETS, augment
from hand_pose_ros.training.gradients import Gradients
from hand_pose_ros.training.objectives import objective_for
from hand_pose_ros.training.optimizers import make_optimizer
from hand_pose_ros.training.recipes import get_recipe


def rate(samples: int, work: Callable[[], object], device: str, repeats: int = 5) -> float:
    """Samples per second, after a warm-up."""
    def now() -> float:
        if device == 'cpu':
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    work()
    start = now()
    for _ in range(repeats):
        work()
    return samples * repeats / (now() - start)


def training(network: str, recipe_name: str, precision: torch.dtype | None, device: str) -> float:
    """Steps of a recipe on samples that are there already."""
    recipe = get_recipe(recipe_name, [] if device == 'cpu' else ['batch_size=1024'])
    module = build(network, joints=21, bottleneck=30)
    objective = objective_for(module, recipe, HAND21)
    objective.train().to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = make_optimizer(recipe, objective)
    numbers = torch.arange(recipe.batch_size)
    batch = augment(open_dataset('synthetic', 'train', device=device).batch(numbers), PRESETS['none'], numbers, seed=0)

    half = partial(torch.autocast, device, precision, enabled=precision is not None)
    gradients = Gradients(objective, half, captured=device == 'cuda')

    def step() -> None:
        gradients(batch)
        optimizer.step()

    for _ in range(WARM_UP):
        step()
    return rate(recipe.batch_size, step, device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--device', choices=('cpu', 'cuda'), default='cpu')
    device = parser.parse_args().device
    torch.set_num_threads(1)
    torch.backends.cudnn.benchmark = True
    keep_freed_memory()
    count = 128 if device == 'cpu' else 2048
    data, numbers = open_dataset('synthetic', 'train', device=device), torch.arange(count)
    batch = data.batch(numbers)
    print(f'render             {rate(count, lambda: data.batch(numbers), device):7.0f}')
    print(f'augment (modern)   {rate(count, lambda: augment(batch, PRESETS["modern"], numbers, 0), device):7.0f}')
    for network in ('shallow', 'deep', 'multi_scale', 'hand_dense', 'two_looks'):
        recipe = 'modern' if network in ('hand_dense', 'two_looks') else 'paper'
        single, half = (training(network, recipe, precision, device) for precision in (None, torch.bfloat16))
        print(f'{network:18s} {single:7.0f}   bfloat16 {half:7.0f}')


if __name__ == '__main__':
    main()
