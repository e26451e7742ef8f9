"""What all engines have in common: patches in, named arrays out. Also the plain engine, which is the reference."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.dense import HandDense

Array = NDArray[np.float32]


class Pipeline(nn.Module):
    """A network and the refiner of its joints, as one module. It returns a tuple of tensors, named by `outputs`."""

    def __init__(self, network: nn.Module, refiner: nn.Module | None = None) -> None:
        super().__init__()
        self.network, self.refiner = network, refiner
        self.outputs: tuple[str, ...] = getattr(network, 'outputs', ('joints',))

    def reduce_precision(self) -> Pipeline:
        """Convert the weights to half precision where this moves no joint by half a millimetre.

        These stay in single precision:

        - Everything, if there is a refiner: it needs exact positions.
        - Everything, if there is a norm that is not merged into the weights (`fused.fuse`): the layer before it may
          give values that are too large for half precision.
        - The first look of two: the view of the second look is rounded, and must not depend on the precision.
        - The stem of a dense network: its rounded weights move joints by more than all other weights together.
        """
        if self.refiner is not None or any(isinstance(module, nn.BatchNorm2d) for module in self.modules()):
            return self
        dense = [each for each in self.modules() if isinstance(each, HandDense)]
        exact = [*(each.stem for each in dense), getattr(self.network, 'first', None)]
        kept = {id(tensor) for module in exact if module is not None for tensor in _tensors(module)}
        for tensor in _tensors(self):
            if tensor.is_floating_point() and id(tensor) not in kept:
                tensor.data = tensor.data.half()
        for each in dense:
            each.stem = nn.Sequential(each.stem, _As(each.summary.weight.dtype))
        return self

    @property
    def precision(self) -> torch.dtype:
        """The precision of the patches that the network takes."""
        return next((parameter.dtype for parameter in self.network.parameters()), torch.float32)

    def forward(self, patches: Tensor) -> tuple[Tensor, ...]:
        """Patches (B, 1, 128, 128) -> the tensors named by `outputs`, float32."""
        full = getattr(self.network, 'forward_full', None)
        own = patches.to(self.precision)
        answer: dict[str, Tensor] = {'joints': self.network(own)} if full is None else full(own)
        if self.refiner is not None:
            answer['joints'] = self.refiner(own, answer['joints'])
        # Cast only if needed, so that the exported graph has no needless casts.
        return tuple(value if value.dtype == torch.float32 else value.float()
                     for value in (answer[name] for name in self.outputs))


class _As(nn.Module):
    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self.dtype = dtype

    def forward(self, x: Tensor) -> Tensor:
        return x.to(self.dtype)


def _tensors(module: nn.Module) -> Iterator[Tensor]:
    yield from module.parameters()
    yield from module.buffers()


class Engine(ABC):
    """Runs one network, and its refiner if it has one.

    Attributes:
        name: of the engine.
        outputs: names of the arrays that `run_full` returns.
    """

    name: str
    outputs: tuple[str, ...]

    def run(self, patches: Array) -> Array:
        """Patches (B, 1, 128, 128) float32 in [-1, 1] -> joints (B, J, 3) float32 in cube units.

        Raises:
            InputError: the patches have another shape or type.
        """
        return self.run_full(patches)['joints']

    def run_full(self, patches: Array) -> dict[str, Array]:
        """As `run`, but all outputs of the network by name (for hand_dense, see `HandDense.forward_full`)."""
        if patches.shape[1:] != (1, PATCH_SIZE, PATCH_SIZE) or patches.dtype != np.float32:
            raise InputError(f'patches must be (B, 1, {PATCH_SIZE}, {PATCH_SIZE}) float32, '
                             f'not {patches.shape} {patches.dtype}')
        return dict(zip(self.outputs, self._run(patches), strict=True))

    @abstractmethod
    def _run(self, patches: Array) -> list[Array]:
        """Checked patches -> arrays in the order of `outputs`. The caller may keep them."""


class TorchEngine(Engine):
    """Plain PyTorch in float32, one operation after the other."""

    name = 'pytorch'

    def __init__(self, pipeline: Pipeline, device: str = 'cpu') -> None:
        self.outputs, self.device = pipeline.outputs, torch.device(device)
        self.pipeline = pipeline.to(self.device)

    def _run(self, patches: Array) -> list[Array]:
        with torch.inference_mode():
            answer = self.pipeline(torch.from_numpy(np.ascontiguousarray(patches)).to(self.device))
            return [tensor.cpu().numpy() for tensor in answer]
