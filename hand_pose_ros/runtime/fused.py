"""Layers that a GPU computes with one kernel instead of three. For one hand, the number of kernels decides the time."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from hand_pose_ros.models.dense import Residual
from hand_pose_ros.models.refiner import Refiner


class ConvolutionReLU(nn.Module):
    """A convolution, an optional addition, max-pooling, and ReLU."""

    def __init__(self, convolution: nn.Conv2d, pool: int = 1, kernels: ModuleType | None = None) -> None:
        super().__init__()
        self.convolution, self.pool = convolution, pool
        self._kernels = kernels if kernels and kernels.fits(convolution, pool) else None
        self._one_kernel = convolution.groups == 1

    def forward(self, x: Tensor, added: Tensor | None = None) -> Tensor:
        if self._kernels and added is None and len(x) <= self._kernels.HANDS:
            return self._kernels.convolve(x, self.convolution, self.pool)
        y = self._convolved(x, added)
        return F.max_pool2d(y, self.pool) if self.pool > 1 else y  # after ReLU, the result is the same

    def _convolved(self, x: Tensor, added: Tensor | None) -> Tensor:
        layer = self.convolution
        if x.is_cuda and self._one_kernel:
            sizes: list[Any] = [layer.stride, layer.padding, layer.dilation, layer.groups]
            try:
                if added is None:
                    return torch.cudnn_convolution_relu(x, layer.weight, layer.bias, *sizes)
                return torch.cudnn_convolution_add_relu(x, layer.weight, added, 1.0, layer.bias, *sizes)
            except RuntimeError:  # cuDNN has no such kernel for these sizes on this GPU
                self._one_kernel = False
        y = layer(x)
        return F.relu(y if added is None else y + added)


class FusedResidual(nn.Module):
    """`Residual` with at most three kernels."""

    def __init__(self, block: Residual) -> None:
        super().__init__()
        first, _, last = block.body
        self.first, self.last = ConvolutionReLU(_plain(first)), ConvolutionReLU(_plain(last))
        self.shortcut = block.shortcut if isinstance(block.shortcut, nn.Identity) else _plain(block.shortcut)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(self.first(x), self.shortcut(x))


class LinearReLU(nn.Linear):
    """A linear layer with or without ReLU. For few hands, `kernels` computes it."""

    def __init__(self, layer: nn.Linear, relu: bool, kernels: ModuleType) -> None:
        super().__init__(layer.in_features, layer.out_features, device='meta')
        self.weight, self.bias, self.relu, self._kernels = layer.weight, layer.bias, relu, kernels

    def forward(self, x: Tensor) -> Tensor:
        if x.dim() == 2 and len(x) <= self._kernels.HANDS:
            return self._kernels.linear(x, self.weight, self.bias, self.relu)
        y = super().forward(x)
        return F.relu(y) if self.relu else y


def fuse(module: nn.Module, kernels: ModuleType | None = None) -> None:
    """Replace the layers that can be fused. The network must not be trained any more.

    Args:
        kernels: `runtime.kernels`, if it can be used.
    """
    if isinstance(module, nn.Sequential):
        _fuse_neighbours(module, kernels)
    for name, child in module.named_children():
        if isinstance(child, Residual):
            setattr(module, name, FusedResidual(child))
        elif kernels and type(child) is nn.Linear:
            setattr(module, name, LinearReLU(child, relu=False, kernels=kernels))
        else:
            fuse(child, kernels)
    if kernels and isinstance(module, Refiner):
        module.cut = kernels.cut


def _fuse_neighbours(layers: nn.Sequential, kernels: ModuleType | None) -> None:
    """Fuse each convolution with its pooling and ReLU, and each linear layer with its ReLU."""
    for i, layer in enumerate(layers):
        behind, pool = i + 1, 1
        if behind < len(layers) and isinstance(pooling := layers[behind], nn.MaxPool2d):
            behind, pool = behind + 1, int(pooling.kernel_size)  # type: ignore[arg-type]  # squares, all of them
        if behind == len(layers) or not isinstance(layers[behind], nn.ReLU):
            continue
        if _is_convolution(layer):
            layers[i] = ConvolutionReLU(_plain(layer), pool, kernels)
        elif kernels and type(layer) is nn.Linear:
            layers[i] = LinearReLU(layer, relu=True, kernels=kernels)
        else:
            continue
        for j in range(i + 1, behind + 1):
            layers[j] = nn.Identity()


def _is_convolution(layer: nn.Module) -> bool:
    """Whether this is a convolution, or a convolution with its norm (see `dense.conv_norm`)."""
    if isinstance(layer, nn.Sequential):
        return len(layer) == 2 and isinstance(layer[0], nn.Conv2d) and isinstance(layer[1], nn.BatchNorm2d)
    return isinstance(layer, nn.Conv2d)


def _plain(layer: nn.Module) -> nn.Conv2d:
    """The convolution, with its norm merged into the weights."""
    return fuse_conv_bn_eval(layer[0], layer[1]) if isinstance(layer, nn.Sequential) else layer  # type: ignore
