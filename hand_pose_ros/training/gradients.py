"""Loss and gradients of one batch after another."""

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
    """`gradients(batch)` returns the terms of the loss; of their sum the parameters hold the gradients afterwards.

    Launching the thousand small kernels of a step takes a processor longer than a GPU needs for them. There they are
    launched as one, a CUDA graph, captured after a few batches, which later ones run through; so all are of the same
    shapes, and nothing in the module may wait for the GPU or copy something there.

    Args:
        module: from a batch to the terms.
        precision: makes the context in which it runs.
        captured: as a CUDA graph.
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
            parameter.grad = gradient  # which an optimiser may have taken away
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
