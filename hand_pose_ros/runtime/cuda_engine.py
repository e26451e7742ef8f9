"""CUDA graphs: the whole network, including the copies, in one launch and in half precision."""

from __future__ import annotations

import copy
import logging
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.runtime.engine import Array, Engine, Pipeline, TorchEngine
from hand_pose_ros.runtime.fused import fuse

WARM_UP = 3
"""Number of runs before the capture. In the first runs, libraries choose algorithms and allocate memory. A graph must
not contain this."""
LARGEST = 1024
"""Maximum number of hands in one graph. If there are more, the next ones are copied to pinned memory while the GPU
works on these."""
ROUNDING = 0.02
"""In cube units. Rounding to half precision moves half of the joints of a palm by less than half of this (tested)."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Captured:
    graph: torch.cuda.CUDAGraph
    patches: Tensor
    """(N, 1, 128, 128) in pinned memory, in the precision of the network. The graph reads them."""
    answer: tuple[Tensor, ...]
    """In pinned memory. The graph writes them."""
    stream: torch.cuda.Stream
    done: torch.cuda.Event = field(default_factory=torch.cuda.Event)

    def start(self) -> None:
        """Launch the replay."""
        # `with torch.cuda.stream` does the same, but takes microseconds longer.
        before = torch.cuda.current_stream()
        torch.cuda.set_stream(self.stream)
        try:
            self.graph.replay()
            self.done.record(self.stream)
        finally:
            torch.cuda.set_stream(before)

    def finish(self, count: int) -> list[Array]:
        """Wait for the replay. Returns copies of the first `count` answers: the next replay overwrites the memory."""
        self.done.synchronize()
        return [tensor[:count].numpy().copy() for tensor in self.answer]


class CudaEngine(Engine):
    """One CUDA graph for each batch size that is a power of two. It is captured when it is first needed.

    Other batch sizes run in the next larger graph. Batches beyond the largest graph run in two graphs of that size, in
    turns, and one copies while the other computes. Input and output are in pinned host memory, and the copies are part
    of the graph. So a call is one launch and one wait.

    Args:
        kernels: `runtime.kernels`, or None to use no kernels of our own.
    """

    name = 'cuda graph'

    def __init__(self, pipeline: Pipeline, device: str, kernels: ModuleType | None) -> None:
        self.outputs, self.device, self.kernels = pipeline.outputs, torch.device(device), kernels
        fuse(pipeline, kernels)
        pipeline.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.pipeline = pipeline.to(self.device).reduce_precision()
        self.streams = torch.cuda.Stream(self.device), torch.cuda.Stream(self.device)
        self._captured: dict[tuple[int, int], _Captured] = {}
        self.captured_for(1)  # so that the first image does not wait

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
            captured.start()
            running.append((captured, len(some)))
        parts += [captured.finish(count) for captured, count in running]
        return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]

    def captured_for(self, count: int, turn: int = 0) -> _Captured:
        """The graph for this many hands, at most LARGEST. Each `turn` has its own graph and stream."""
        size = 1 << max(count - 1, 0).bit_length()
        if (size, turn) not in self._captured:
            self._captured[size, turn] = self._capture(size, self.streams[turn])
        return self._captured[size, turn]

    def _capture(self, size: int, stream: torch.cuda.Stream) -> _Captured:
        source = torch.ones(size, 1, PATCH_SIZE, PATCH_SIZE, dtype=self.pipeline.precision, pin_memory=True)
        # If a capture fails, torch.cuda.graph leaves its stream the current one. The end of this block puts it back.
        with torch.inference_mode(), torch.cuda.device(self.device), torch.cuda.stream(stream), exact_convolutions():
            targets = tuple(torch.empty(tensor.shape, pin_memory=True) for tensor in self.pipeline(self._there(source)))
            for _ in range(WARM_UP):
                self._compute(source, targets)
            graph = torch.cuda.CUDAGraph()
            # Other threads may use the GPU meanwhile: by default, the memory that they allocate would end the capture.
            with torch.cuda.graph(graph, stream=stream, capture_error_mode='thread_local'):
                self._compute(source, targets)
        return _Captured(graph, source, targets, stream)

    def _compute(self, source: Tensor, targets: tuple[Tensor, ...]) -> None:
        for tensor, target in zip(self.pipeline(self._there(source)), targets, strict=True):
            self._copy(tensor, target)

    def _there(self, source: Tensor) -> Tensor:
        patches = torch.empty_like(source, device=self.device, pin_memory=False)
        self._copy(source, patches)
        return patches

    def _copy(self, source: Tensor, target: Tensor) -> None:
        if self.kernels and len(source) <= self.kernels.HANDS:
            self.kernels.copy(source, target)
        else:
            target.copy_(source, non_blocking=True)


@contextmanager
def exact_convolutions() -> Iterator[None]:
    """Convolutions in full float32. Tensor cores would otherwise round weights that must stay in single precision."""
    cudnn: Any = torch.backends.cudnn
    settings: list[tuple[Any, str, Any]] = [(cudnn, 'allow_tf32', False)]
    if hasattr(cudnn, 'conv'):  # since PyTorch 2.9; it must agree with the older flag
        settings += [(cudnn.conv, 'fp32_precision', 'ieee'), (cudnn.rnn, 'fp32_precision', 'ieee')]
    before = []
    for owner, name, _ in settings:
        try:
            before.append(getattr(owner, name))
        except RuntimeError:  # a program used the new way, so the old flag cannot be read: it still has its default
            before.append(True)
    for owner, name, exact in settings:
        setattr(owner, name, exact)
    try:
        yield
    finally:
        for (owner, name, _), value in zip(settings, before, strict=True):
            setattr(owner, name, value)


def fastest(pipeline: Pipeline, device: str) -> Engine:
    """The fastest engine that gives the same joints as the CPU.

    Kernels are compiled and chosen for the GPU that is there, and it may be the first of its kind. What fails is not
    used.
    """
    plain = TorchEngine(pipeline)
    for kernels in dict.fromkeys((_own_kernels(), None)):
        try:
            engine = CudaEngine(copy.deepcopy(pipeline), device, kernels)
            problem = '' if _agree(engine, plain) else 'the joints are not those of the CPU'
        except Exception as error:  # PyTorch, CUDA and Triton have errors of their own
            problem = (str(error).strip() or type(error).__name__).splitlines()[0]
        if not problem:
            return engine
        _log.warning('a hand takes longer than it could, as %s cannot be used on %s: %s',
                     'kernels of our own' if kernels else 'CUDA graphs', device, problem)
    return TorchEngine(pipeline, device)


def _own_kernels() -> ModuleType | None:
    """`runtime.kernels`, if Triton is installed. On Linux, PyTorch for CUDA brings it along."""
    try:
        from hand_pose_ros.runtime import kernels
        if kernels.COMPILED:
            return kernels
        problem = 'TRITON_INTERPRET is set, and no CUDA graph can hold what is interpreted'
    except ImportError as error:
        problem = str(error)
    _log.warning('a hand takes longer than it could, as kernels cannot be compiled here: %s', problem)
    return None


def _agree(engine: Engine, plain: Engine) -> bool:
    """Whether both engines give the same joints for a palm, except for rounding."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, PATCH_SIZE, dtype=np.float32)] * 2)
    palm = np.where(x ** 2 + y ** 2 < 0.4, 0.3 * x - 0.2 * y, np.float32(1))[None, None]
    moved = np.linalg.norm(engine.run(palm) - plain.run(palm), axis=-1)
    return bool(np.median(moved) < ROUNDING)  # False for NaN
