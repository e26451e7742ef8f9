"""Layers that a GPU computes with one kernel instead of three: for one hand, the number of kernels is the time."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from hand_pose_ros.models.dense import Residual


class ConvolutionReLU(nn.Module):
    """A convolution, what is to be added to it, and ReLU."""

    def __init__(self, convolution: nn.Conv2d) -> None:
        super().__init__()
        self.convolution = convolution
        self._one_kernel = True

    def forward(self, x: Tensor, added: Tensor | None = None) -> Tensor:
        layer = self.convolution
        if x.is_cuda and self._one_kernel:
            sizes: list[Any] = [layer.stride, layer.padding, layer.dilation, layer.groups]
            try:
                if added is None:
                    return torch.cudnn_convolution_relu(x, layer.weight, layer.bias, *sizes)
                return torch.cudnn_convolution_add_relu(x, layer.weight, added, 1.0, layer.bias, *sizes)
            except RuntimeError:  # cuDNN has none for these sizes on this GPU
                self._one_kernel = False
        y = layer(x)
        return F.relu(y if added is None else y + added)


class FusedResidual(nn.Module):
    """`Residual` of three kernels at most."""

    def __init__(self, block: Residual) -> None:
        super().__init__()
        first, _, last = block.body
        self.first, self.last = ConvolutionReLU(_plain(first)), ConvolutionReLU(_plain(last))
        self.shortcut = block.shortcut if isinstance(block.shortcut, nn.Identity) else _plain(block.shortcut)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(self.first(x), self.shortcut(x))


def fuse(module: nn.Module) -> None:
    """Replace what can be fused of a network that does not train."""
    for name, child in module.named_children():
        if isinstance(child, Residual):
            setattr(module, name, FusedResidual(child))
        else:
            fuse(child)
    if not isinstance(module, nn.Sequential):
        return
    for i, layer in enumerate(module):
        behind = i + 1
        if behind < len(module) and isinstance(module[behind], nn.MaxPool2d):
            behind += 1  # ReLU before it gives the same
        if _is_convolution(layer) and behind < len(module) and isinstance(module[behind], nn.ReLU):
            module[i], module[behind] = ConvolutionReLU(_plain(layer)), nn.Identity()


def _is_convolution(layer: nn.Module) -> bool:
    """One, or one with its norm: see `dense.conv_norm`."""
    if isinstance(layer, nn.Sequential):
        return len(layer) == 2 and isinstance(layer[0], nn.Conv2d) and isinstance(layer[1], nn.BatchNorm2d)
    return isinstance(layer, nn.Conv2d)


def _plain(layer: nn.Module) -> nn.Conv2d:
    """The norm in the weights."""
    return fuse_conv_bn_eval(layer[0], layer[1]) if isinstance(layer, nn.Sequential) else layer  # type: ignore
