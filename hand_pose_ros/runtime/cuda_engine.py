"""CUDA graphs: the whole network, with its copies, as one launch, in half precision."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, field
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.runtime.engine import Array, Engine, Pipeline
from hand_pose_ros.runtime.fused import fuse

WARM_UP = 3
"""Runs before the capture: libraries choose algorithms and allocate in the first ones, which a graph must not hold."""
LARGEST = 1024
"""Hands of one graph. Of more, the next are brought to pinned memory while the GPU is at these."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Captured:
    graph: torch.cuda.CUDAGraph
    patches: Tensor
    """Pinned (N, 1, 128, 128), where the graph reads from, in the precision that the network takes."""
    answer: tuple[Tensor, ...]
    """Pinned, where the graph writes to."""
    done: torch.cuda.Event = field(default_factory=torch.cuda.Event)

    def finish(self, count: int) -> list[Array]:
        """Wait for the replay; the first `count` answers, copied, for the next replay writes to the same memory."""
        self.done.synchronize()
        return [tensor[:count].numpy().copy() for tensor in self.answer]


class CudaEngine(Engine):
    """One CUDA graph for each batch size that is a power of two, captured when first needed.

    Other sizes run in the next larger graph, or, beyond the largest, in two of its size by turns. Input and output lie
    in pinned host memory, and the copies are part of the graph, so that a call is one launch and one wait.
    """

    name = 'cuda graph'

    def __init__(self, pipeline: Pipeline, device: str = 'cuda') -> None:
        self.outputs, self.device = pipeline.outputs, torch.device(device)
        fuse(pipeline, _own_kernels(self.device))
        pipeline.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.pipeline = pipeline.to(self.device).reduce_precision()
        self.stream = torch.cuda.Stream(self.device)
        self._captured: dict[tuple[int, int], _Captured] = {}
        self.captured_for(1)  # the first image shall not wait

    def _run(self, patches: Array) -> list[Array]:
        parts: list[list[Array]] = []
        running: deque[tuple[_Captured, int]] = deque()
        for turn, start in enumerate(range(0, max(len(patches), 1), LARGEST)):
            if len(running) == 2:
                captured, count = running.popleft()
                parts.append(captured.finish(count))
            some = patches[start:start + LARGEST]
            captured = self.captured_for(len(some), turn % 2)
            captured.patches[:len(some)].copy_(torch.from_numpy(np.ascontiguousarray(some)))
            with torch.cuda.stream(self.stream):
                captured.graph.replay()
                captured.done.record()
            running.append((captured, len(some)))
        parts += [captured.finish(count) for captured, count in running]
        return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]

    def captured_for(self, count: int, turn: int = 0) -> _Captured:
        """The graph for this many hands, at most LARGEST; of another `turn` another one."""
        size = 1 << max(count - 1, 0).bit_length()
        if (size, turn) not in self._captured:
            self._captured[size, turn] = self._capture(size)
        return self._captured[size, turn]

    def _capture(self, size: int) -> _Captured:
        source = torch.ones(size, 1, PATCH_SIZE, PATCH_SIZE, dtype=self.pipeline.precision, pin_memory=True)
        # Nor may what is not halved be rounded as much by the convolutions of a tensor core.
        exact = torch.backends.cudnn.flags(enabled=True, allow_tf32=False)
        with torch.inference_mode(), torch.cuda.device(self.device), exact:
            with torch.cuda.stream(self.stream):
                for _ in range(WARM_UP):
                    answer = self._compute(source)
                targets = tuple(torch.empty(tensor.shape, pin_memory=True) for tensor in answer)
            self.stream.synchronize()
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, stream=self.stream):
                for target, tensor in zip(targets, self._compute(source), strict=True):
                    target.copy_(tensor, non_blocking=True)
        return _Captured(graph, source, targets)

    def _compute(self, source: Tensor) -> tuple[Tensor, ...]:
        return self.pipeline(source.to(self.device, non_blocking=True))


def _own_kernels(device: torch.device) -> ModuleType | None:
    """`runtime.kernels`, where Triton (which PyTorch for CUDA brings along on Linux) can compile them."""
    try:
        from hand_pose_ros.runtime import kernels
        with torch.cuda.device(device):
            one = torch.ones(1, 1, device=device)
            kernels.linear(one, one, one[0], relu=False).cpu()
    except Exception as error:  # no Triton, no C compiler, a GPU too old: each has an error of its own
        _log.warning('a hand takes longer than it could, as kernels cannot be compiled here: %s',
                     (str(error) or type(error).__name__).splitlines()[0])
        return None
    return kernels
