"""Engines that run a network fast, all with the same call: `make_engine(network).run(patches)`."""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models import NO_JOINTS
from hand_pose_ros.runtime.engine import Engine, Pipeline, TorchEngine
from hand_pose_ros.runtime.lanes import fill_lanes
from hand_pose_ros.runtime.onnx_engine import OnnxEngine

__all__ = ['Engine', 'check_device', 'cores', 'default_threads', 'make_engine']

_log = logging.getLogger(__name__)
_T = TypeVar('_T')


def cores() -> int:
    """The number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


def default_threads() -> int:
    """Number of threads for one network on this machine. At most 4: more do not help such small networks.

    With more than two cores, one core is left for ROS.
    """
    return min(4, cores() if cores() <= 2 else cores() - 1)


def make_engine(network: nn.Module, device: str = 'auto', num_threads: int | None = None,
                refiner: nn.Module | None = None) -> Engine:
    """The fastest engine for a network (and the refiner of its joints) on a device.

    The given modules are not changed.

    Args:
        device: 'cpu', 'cuda', 'cuda:N', any other device of PyTorch, or 'auto': a CUDA GPU if PyTorch can use one,
            otherwise the CPU. On a CPU, ONNX Runtime runs the network; on a GPU, CUDA graphs (in half precision); on
            other devices, PyTorch.
        num_threads: maximum number of threads on the CPU, see `OnnxEngine`. None = `default_threads()`.

    Raises:
        HandPoseError: the device cannot be used here, `num_threads` is below 1, or the network gives no joints.
    """
    if (architecture := getattr(network, 'architecture', '')) in NO_JOINTS:
        raise HandPoseError(f'weights of {architecture} give no joints: choose those of a network that does '
                            '(docs/models.md)')
    if num_threads is not None and num_threads < 1:
        raise HandPoseError(f'num_threads is {num_threads}, but a network needs at least one')
    why = f"device '{device}' was asked for"
    if device == 'auto':
        device, why = _chosen()
    pipeline = Pipeline(copy.deepcopy(network), copy.deepcopy(refiner)).requires_grad_(False).eval().cpu()
    engine: Engine
    if device == 'cpu':
        threads = num_threads or default_threads()
        if torch.backends.cpu.get_cpu_capability() == 'AVX512':
            fill_lanes(pipeline)
        engine = OnnxEngine(pipeline, threads)
        why += f'; {engine.threads} of {threads} threads for one hand'
    elif device.startswith('cuda'):
        from hand_pose_ros.runtime.cuda_engine import fastest
        check_device(device)
        engine = _on(device, lambda: fastest(pipeline, device))
    else:
        engine = _on(device, lambda: TorchEngine(pipeline, device))
    _log.info('runs on %s (%s)', engine.name, why)
    return engine


def _chosen() -> tuple[str, str]:
    """The device that 'auto' chooses, and why."""
    if not torch.cuda.is_available():
        return 'cpu', 'no GPU was found'
    try:
        check_device('cuda')
    except HandPoseError as error:  # for example, the GPU is too old for this PyTorch, or its memory is full
        _log.warning('a hand takes longer than it could, as the network runs on the CPU: %s', error)
        return 'cpu', 'the GPU cannot be used'
    return 'cuda', 'a GPU was found'


def check_device(device: str) -> None:
    """Raise HandPoseError if PyTorch cannot work on a device."""
    _on(device, lambda: torch.zeros(1, device=device))


def _on(device: str, work: Callable[[], _T]) -> _T:
    try:
        torch.device(device)
    except RuntimeError:  # its message lists twenty names
        raise HandPoseError(f"device '{device}' cannot be used here (PyTorch knows none of this name): "
                            "use 'cpu' or 'cuda'") from None
    if device.startswith('cuda') and not torch.cuda.is_available():
        raise HandPoseError(f"device '{device}' was asked for, but PyTorch {torch.__version__} finds no GPU: "
                            "use 'cpu', or install a PyTorch for CUDA and its driver")
    try:
        return work()
    except (RuntimeError, AssertionError) as error:  # one of them, depending on what the device lacks
        remedy = "'cpu', or a PyTorch for this GPU" if device == 'cuda' else "'cpu' or 'cuda'"
        raise HandPoseError(f"device '{device}' cannot be used here ({str(error).splitlines()[0]}): "
                            f'use {remedy}') from error
