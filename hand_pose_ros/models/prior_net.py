"""The networks of "Hands Deep in Deep Learning for Hand Pose Estimation" (Oberweger et al. 2015, section 3).

Every network maps patches (B, 1, 128, 128) in [-1, 1] to joints (B, J, 3) in cube units. With a `bottleneck`, it does
so through the pose prior. Convolutions have no padding. Windows of the pooling do not overlap, and pixels that do not
fill a window are dropped. A number that the paper does not give is marked as taken from the original code or as ours.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor, nn

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.prior import PoseHead


class PoseNetwork(nn.Module):
    """Features, and a head with or without the pose prior: see `PoseHead`."""

    def __init__(self, features: nn.Module, joints: int, bottleneck: int | None,
                 hidden: tuple[int, ...] = (1024, 1024), dropout: float = 0.3) -> None:
        super().__init__()
        self.features = features
        with torch.no_grad():
            flat = features(torch.zeros(1, 1, PATCH_SIZE, PATCH_SIZE)).shape[1]
        self.head = PoseHead(flat, joints, bottleneck, hidden, dropout)

    def set_prior(self, mean: ArrayLike, components: ArrayLike) -> None:
        """Start the prior from a mean (3J,) and components (bottleneck, 3J): see `fit_prior`."""
        self.head.set_prior(mean, components)

    def forward(self, patch: Tensor) -> Tensor:
        """(B, 1, 128, 128) in [-1, 1] -> (B, J, 3) in cube units."""
        return self.head(self.features(patch))


class Shallow(PoseNetwork):
    """One convolution, one pooling, one hidden layer. The sizes are ours: the paper gives no figures."""

    def __init__(self, joints: int = 21, bottleneck: int | None = None, dropout: float = 0.3) -> None:
        maps = _convolution(1, 8, 5, pool=4)
        features = nn.Sequential(maps, nn.Flatten())  # (8, 31, 31) = 7688
        super().__init__(features, joints, bottleneck, hidden=(1024,), dropout=dropout)
        # At first, the maps do not respond to the background, which is 1. Otherwise nearly all inputs of the hidden
        # layer would respond alike, and the first steps of Adam would silence the hidden units for good.
        with torch.no_grad():
            maps[0].bias.copy_(-maps[0].weight.sum((1, 2, 3)))  # type: ignore[operator]


class Deep(PoseNetwork):
    """Three convolutions and two hidden layers (sizes: original code). With a bottleneck of 30 it is Deep-Prior."""

    def __init__(self, joints: int = 21, bottleneck: int | None = None, dropout: float = 0.3) -> None:
        super().__init__(nn.Sequential(*_deep_branch((4, 2, 1))), joints, bottleneck, dropout=dropout)


class MultiScale(PoseNetwork):
    """Three branches, which see the patch at full, half and quarter resolution (sizes: original code)."""

    def __init__(self, joints: int = 21, bottleneck: int | None = None, dropout: float = 0.3) -> None:
        super().__init__(_Branches(_pyramid), joints, bottleneck, dropout=dropout)


class CenterRefiner(PoseNetwork):
    """Predicts where the palm is in the cube (DeepPrior++). It has the branches of `MultiScale`, over central crops."""

    def __init__(self, dropout: float = 0.3) -> None:
        super().__init__(_Branches(_central_crops), joints=1, bottleneck=None, dropout=dropout)

    def forward(self, patch: Tensor) -> Tensor:
        """(B, 1, 128, 128) in [-1, 1] -> the palm (B, 3) in cube units."""
        return super().forward(patch)[:, 0]


class _Branches(nn.Module):
    """A branch for each of three views of the patch. The views are 128, 64 and 32 pixels wide."""

    def __init__(self, views: Callable[[Tensor], tuple[Tensor, ...]]) -> None:
        super().__init__()
        self.views = views
        self.branches = nn.ModuleList(
            nn.Sequential(*_deep_branch(pools)) for pools in ((4, 2, 1), (2, 2, 1), (2, 1, 1)))

    def forward(self, patch: Tensor) -> Tensor:  # (B, 1, 128, 128) -> (B, 968 + 968 + 512)
        views = self.views(patch)
        return torch.cat([branch(view) for branch, view in zip(self.branches, views, strict=True)], dim=1)


def _pyramid(patch: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    half = F.avg_pool2d(patch, 2)  # the same as bilinear interpolation to half the size
    return patch, half, F.avg_pool2d(half, 2)


def _central_crops(patch: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return patch, patch[..., 32:96, 32:96], patch[..., 48:80, 48:80]


def _deep_branch(pools: tuple[int, int, int]) -> list[nn.Module]:
    """The convolutions of Deep (8@5x5, 8@5x5, 8@3x3), each with its pooling and ReLU. The result is flattened."""
    sizes = zip((1, 8, 8), (5, 5, 3), pools, strict=True)
    return [*(_convolution(inputs, 8, size, pool) for inputs, size, pool in sizes), nn.Flatten()]


def _convolution(inputs: int, outputs: int, size: int, pool: int) -> nn.Sequential:
    """Convolution, pooling, ReLU. A bias before the max-pooling gives the same as one after it."""
    pooling = [nn.MaxPool2d(pool)] if pool > 1 else []
    return nn.Sequential(relu_conv(inputs, outputs, size), *pooling, nn.ReLU())


def relu_conv(inputs: int, outputs: int, size: int, stride: int = 1, padding: int = 0,
              groups: int = 1) -> nn.Conv2d:
    """A convolution before a ReLU. Weights from N(0, sqrt(2 / fan_in)), zero bias (He et al. 2015)."""
    layer = nn.Conv2d(inputs, outputs, size, stride, padding, groups=groups)
    nn.init.kaiming_normal_(layer.weight, nonlinearity='relu')
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer
