"""Layers that a GPU computes with fewer kernels. For few hands, the number of kernels decides the time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import takewhile
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from hand_pose_ros.models.dense import LEAK, HandDense, JointRefinement, Lateral, Residual
from hand_pose_ros.models.prior import PriorOverVotes
from hand_pose_ros.models.refiner import Refiner
from hand_pose_ros.models.two_looks import TwoLooks


class Convolution(nn.Module):
    """A convolution, an optional addition, max-pooling, and ReLU if `relu`.

    Args:
        planes: what `kernels` answers is float32, and its pixels lie side by side.
        kernels: `runtime.kernels`, which computes it for few hands; None = PyTorch does.
    """

    def __init__(self, convolution: nn.Conv2d, kernels: ModuleType | None, pool: int = 1, relu: bool = True,
                 planes: bool = False) -> None:
        super().__init__()
        self.convolution, self.pool, self.relu, self.planes = convolution, pool, relu, planes
        self._kernels = kernels if kernels and kernels.fits(convolution, pool) else None
        self._one_kernel = relu and convolution.groups == 1

    def forward(self, x: Tensor, added: Tensor | None = None) -> Tensor:
        if self._kernels and self._kernels.gains(self.convolution, len(x)):
            return self._kernels.convolve(x, self.convolution, self.pool, self.relu, added, self.planes)
        if added is not None and added.shape[2] < x.shape[2]:
            added = F.interpolate(added, scale_factor=2, mode='nearest')
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
        y = y if added is None else y + added
        return F.relu(y) if self.relu else y


class FusedResidual(nn.Module):
    """`Residual` with at most three kernels."""

    def __init__(self, block: Residual, kernels: ModuleType | None) -> None:
        super().__init__()
        first, _, last = block.body
        self.first, self.last = Convolution(_plain(first), kernels), Convolution(_plain(last), kernels)
        same = isinstance(block.shortcut, nn.Identity)
        self.shortcut = block.shortcut if same else Convolution(_plain(block.shortcut), kernels, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(self.first(x), self.shortcut(x))


class Linear(nn.Linear):
    """A linear layer, leaky ReLU with this slope (1 = nothing, 0 = ReLU), and an optional addition."""

    def __init__(self, layer: nn.Linear, kernels: ModuleType, slope: float = 1) -> None:
        super().__init__(layer.in_features, layer.out_features, device='meta')
        self.weight, self.bias, self.slope, self._kernels = layer.weight, layer.bias, slope, kernels

    def forward(self, x: Tensor, added: Tensor | None = None) -> Tensor:
        if x.dim() == 2 and len(x) <= self._kernels.HANDS:
            return self._kernels.linear(x, self.weight, self.bias, self.slope, added)
        y = F.leaky_relu(super().forward(x.to(self.weight.dtype)), self.slope)
        return y if added is None else y + added


class FusedPrior(nn.Module):
    """`PriorOverVotes` with six kernels."""

    def __init__(self, prior: PriorOverVotes, kernels: ModuleType) -> None:
        super().__init__()
        self.hidden = Linear(prior.hidden, kernels, slope=0)
        self.output, self.projection, self.reconstruction = (
            Linear(layer, kernels) for layer in (prior.output, prior.projection, prior.reconstruction))

    def forward(self, joints: Tensor, confidence: Tensor) -> Tensor:
        flat = joints.flatten(1)
        moved = self.output(self.hidden(torch.cat([flat, confidence / 4], dim=1)))
        return self.reconstruction(self.projection(flat, moved)).view_as(joints)


class FusedRefinement(nn.Module):
    """`JointRefinement` with five kernels, for few hands. Its norms are part of its weights (`_merge_norms`)."""

    def __init__(self, refinement: JointRefinement, kernels: ModuleType) -> None:
        super().__init__()
        self.plain, self._kernels = refinement, kernels
        self.all, self.hidden = (Linear(layer, kernels, LEAK) for layer in (refinement.all, refinement.hidden))
        self.output = Linear(refinement.output, kernels)

    def forward(self, joints: Tensor, votes: Tensor, confidence: Tensor, local: Sequence[Tensor],
                whole: Tensor) -> Tensor:
        if len(joints) > self._kernels.HANDS:
            return self.plain(joints, votes, confidence, local, whole)
        x = self._kernels.read(joints, votes, confidence, local, self.plain.each, self.plain.bias)
        x = self.all(torch.cat([x.flatten(1), whole], dim=1))
        return self.output(self.hidden(x, x), joints.flatten(1)).view_as(joints)


def fuse(module: nn.Module, kernels: ModuleType | None = None) -> None:
    """Replace the layers that can be fused. The network must not be trained any more.

    Args:
        kernels: `runtime.kernels`, if it can be used.
    """
    if isinstance(module, nn.Sequential):
        _fuse_neighbours(module, kernels)
    for name, child in module.named_children():
        fused = _fused(child, kernels)
        if fused is None:
            fuse(child, kernels)
        else:
            setattr(module, name, fused)
    if isinstance(module, HandDense):
        module.maps = Convolution(module.maps, kernels, relu=False, planes=True)  # type: ignore[assignment]
    if kernels and isinstance(module, HandDense):
        module.cells, module.decode = kernels.cells, kernels.decode
    if kernels and isinstance(module, TwoLooks):
        module.seen = partial(kernels.seen, module)  # type: ignore[method-assign]
    if kernels and isinstance(module, Refiner):
        module.cut = kernels.cut


def _fused(layer: nn.Module, kernels: ModuleType | None) -> nn.Module | None:
    if isinstance(layer, Residual):
        return FusedResidual(layer, kernels)
    if isinstance(layer, Lateral):
        return Convolution(layer, kernels, relu=False)
    if isinstance(layer, JointRefinement):
        _merge_norms(layer)
        return FusedRefinement(layer, kernels) if kernels else layer
    if kernels and isinstance(layer, PriorOverVotes):
        return FusedPrior(layer, kernels)
    if kernels and type(layer) is nn.Linear:
        return Linear(layer, kernels)
    return None


def _fuse_neighbours(layers: nn.Sequential, kernels: ModuleType | None) -> None:
    """Fuse each convolution with its pooling and ReLU, and each linear layer with its ReLU."""
    modules = list(layers)
    for i, layer in enumerate(modules):
        behind = list(takewhile(lambda each: isinstance(each, nn.MaxPool2d | nn.ReLU), modules[i + 1:i + 3]))
        pools = [each for each in behind if isinstance(each, nn.MaxPool2d)]
        if len(behind) - len(pools) != 1:
            continue
        if _is_convolution(layer):
            pool = int(pools[0].kernel_size) if pools else 1  # type: ignore[arg-type]  # squares, all of them
            layers[i] = Convolution(_plain(layer), kernels, pool)
        elif kernels and type(layer) is nn.Linear:
            layers[i] = Linear(layer, kernels, slope=0)
        else:
            continue
        for j in range(len(behind)):
            layers[i + 1 + j] = nn.Identity()


def _is_convolution(layer: nn.Module) -> bool:
    """Whether this is a convolution, or a convolution with its norm (see `dense.conv_norm`)."""
    if isinstance(layer, nn.Sequential):
        return len(layer) == 2 and isinstance(layer[0], nn.Conv2d) and isinstance(layer[1], nn.BatchNorm2d)
    return isinstance(layer, nn.Conv2d)


def _plain(layer: nn.Module) -> nn.Conv2d:
    """The convolution, with its norm merged into the weights."""
    return fuse_conv_bn_eval(layer[0], layer[1]) if isinstance(layer, nn.Sequential) else layer  # type: ignore


@torch.no_grad()
def _merge_norms(refinement: JointRefinement) -> None:
    """Make its two norms part of the weights behind them."""
    scale, shift = _affine(refinement.norm)
    refinement.bias.add_((shift @ refinement.each)[:, None])
    refinement.each.mul_(scale[:, None])
    scale, shift = _affine(refinement.norm_whole)
    weight = refinement.all.weight[:, -len(scale):]
    refinement.all.bias.add_(weight @ shift)
    weight.mul_(scale)
    refinement.norm = refinement.norm_whole = nn.Identity()  # type: ignore[assignment]


def _affine(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Scale and shift of what the norm does when it is not trained."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight / (norm.running_var + norm.eps).sqrt()
    return scale, norm.bias - norm.running_mean * scale
