"""Loss and gradients of one batch after another, on a GPU in one launch."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn

from hand_pose_ros.datasets import Batch
from hand_pose_ros.runtime.cuda_engine import WARM_UP
from hand_pose_ros.training.losses import Terms


class Gradients:
    """`gradients(batch)` returns the terms of the loss. Afterwards the parameters hold the gradients of their sum.

    A step has a thousand small kernels. A CPU needs longer to launch them than a GPU needs to run them. So they are
    captured as one CUDA graph after a few batches, and later batches run through the graph. All batches must have the
    same shapes, and the module must neither wait for the GPU nor copy anything to it.

    Args:
        module: maps a batch to the terms of the loss.
        precision: makes the context in which the module runs.
        captured: whether to capture a CUDA graph.
    """

    def __init__(self, module: nn.Module, precision: Callable[[], AbstractContextManager[Any]], captured: bool) -> None:
        self._module, self._precision = module, precision
        self._parameters = [parameter for parameter in module.parameters() if parameter.requires_grad]
        self._captured, self._calls = captured, 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: Batch = {}
        self._terms: Terms = {}
        self._gradients: list[Tensor | None] = []

    def __call__(self, batch: Batch) -> Terms:
        self._calls += 1
        if not self._captured or self._calls <= WARM_UP:
            return self._compute(batch)
        if self._graph is None:
            self._graph = self._capture(batch)
        for name, tensor in self._inputs.items():
            tensor.copy_(batch[name])
        self._graph.replay()
        for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
            parameter.grad = gradient  # an optimiser may have removed it
        return self._terms

    def _compute(self, batch: Batch) -> Terms:
        self._module.train()
        for parameter in self._parameters:
            parameter.grad = None
        with self._precision():
            terms: dict[str, Tensor] = self._module(batch)
        torch.stack(list(terms.values())).sum().backward()
        return {name: value.detach() for name, value in terms.items()}

    def _capture(self, batch: Batch) -> torch.cuda.CUDAGraph:
        self._inputs = {name: tensor.clone() for name, tensor in batch.items()}
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._terms = self._compute(self._inputs)
        self._gradients = [parameter.grad for parameter in self._parameters]
        return graph
