"""Times of calls. The calls take turns, so that their times can be compared."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hand_pose_ros.geometry import PATCH_SIZE

WARM_UP = 5
CALLS = 10
"""Number of times that one call is made before the next takes its turn."""


def measure(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, dict[str, float]]:
    """Time each call `rounds` x CALLS times, in turns. Returns one row per call, by name."""
    for call in calls.values():
        for _ in range(WARM_UP):
            call()
    wall: dict[str, list[float]] = {name: [] for name in calls}
    cpu: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            for _ in range(CALLS):
                start, start_cpu = time.perf_counter(), time.process_time()
                call()
                cpu[name].append(time.process_time() - start_cpu)
                wall[name].append(time.perf_counter() - start)
    return {name: {**summary(wall[name]), 'cpu_ms': summary(cpu[name])['p50_ms']} for name in calls}


def summary(seconds: list[float]) -> dict[str, float]:
    """Times in seconds -> one row: {p50_ms, p99_ms, min_ms, calls}."""
    p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
    return {'p50_ms': float(p50), 'p99_ms': float(p99), 'min_ms': min(seconds) * 1e3, 'calls': len(seconds)}


def some_patches(count: int) -> Tensor:
    """(count, 1, 128, 128): one half is hand, the other is background, as in real patches."""
    patches = torch.rand(count, 1, PATCH_SIZE, PATCH_SIZE) - 0.5
    patches[..., PATCH_SIZE // 2:] = 1
    return patches
