"""Refinement of joints: a small network per joint looks at the surroundings of its estimate (paper, section 3.3).

Each joint has its own weights. Its network predicts the truth minus the estimate, moves the estimate, and looks again.
All joints of all hands are one grouped computation. So the arithmetic decides the time, and not the number of calls.

Only the idea is published. All numbers (sizes of regions, filters, widths) are ours. With them, two iterations for 21
joints take a few milliseconds on two CPU cores.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.prior_net import relu_conv

FAR = 100.0
"""Depth of the background in cube units. It is behind the back face of every cube, wherever a joint is."""


class Layer(NamedTuple):
    """A convolution without padding, max-pooling, and ReLU, as everywhere in the paper."""

    filters: int
    size: int
    pool: int
    """Side of the windows that are pooled; 1 = no pooling."""


class Region(NamedTuple):
    """What one branch looks at (a cube around the joint), and the layers of the branch."""

    width: int
    """Side of the cube, in pixels of the patch."""
    shrink: int
    """The patch is made smaller by this factor first. Of each square of pixels, the nearest reading is kept."""
    layers: tuple[Layer, ...]


class Refiner(nn.Module):
    """Refines J joints with J small networks of the same architecture.

    Args:
        joints: number of joints, J.
        regions: one for each branch.
        hidden: widths of the fully connected layers after the branches.
        dropout: share of the units of these layers that are dropped while training.

    Raises:
        HandPoseError: one of `hidden` is less than 1.
    """

    def __init__(self, joints: int, regions: tuple[Region, ...], hidden: tuple[int, ...],
                 dropout: float) -> None:
        super().__init__()
        if min(hidden, default=1) < 1:
            raise HandPoseError(f'hidden {list(hidden)}: give numbers of at least 1')
        self.joints, self.regions = joints, regions
        self.branches = nn.ModuleList(nn.Sequential(*_branch(joints, region.layers)) for region in regions)
        features = 0
        for region, branch in zip(regions, self.branches, strict=True):
            cells = region.width // region.shrink
            with torch.no_grad():
                features += branch(torch.zeros(1, joints, cells, cells)).numel() // joints
        widths = (features, *hidden, 3)
        self.weights = nn.ParameterList(torch.empty(joints, i, o) for i, o in pairwise(widths))
        self.biases = nn.ParameterList(torch.zeros(joints, 1, o) for o in widths[1:])
        *inner, last = self.weights
        for weight in inner:
            nn.init.normal_(weight, std=(2 / weight.shape[1]) ** 0.5)
        nn.init.normal_(last, std=0.001)  # an untrained refiner hardly moves a joint
        self.dropout = nn.Dropout(dropout)
        self.cut = cut  # an engine may have a faster one

    def forward(self, patch: Tensor, joints: Tensor, iterations: int = 2) -> Tensor:
        """Patch (B, 1, 128, 128) and estimates (B, J, 3) in cube units -> better estimates (B, J, 3).

        There is no gradient for where to look. So the weights get theirs from the last iteration only.
        """
        marked = torch.where(patch < 1, patch, torch.full_like(patch, FAR))
        images = [_framed(marked, region) for region in self.regions]
        for _ in range(iterations):
            joints = joints.detach()
            joints = joints + self.offsets([self.cut(image, joints, region) for image, region in
                                            zip(images, self.regions, strict=True)])
        return joints

    def offsets(self, windows: list[Tensor]) -> Tensor:
        """Windows (B, J, N, N) around the estimates, one per region -> truth minus estimate (B, J, 3) in cube units."""
        features = [branch(window).unflatten(1, (self.joints, -1)).flatten(2)
                    for branch, window in zip(self.branches, windows, strict=True)]
        x = torch.cat(features, dim=2).transpose(0, 1)  # (J, B, F): one matrix product per joint
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if i < last:
                x = self.dropout(F.relu(x))
        return x.transpose(0, 1) * max(map(_reach, self.regions))

    def for_joint(self, joint: int) -> Refiner:
        """A copy of the network of one joint. The grouped computation is compared with it."""
        alone = Refiner(1, self.regions, tuple(bias.shape[2] for bias in self.biases)[:-1], self.dropout.p)
        state = {name: tensor.view(self.joints, -1)[joint] for name, tensor in self.state_dict().items()}
        alone.load_state_dict({name: state[name].view_as(tensor) for name, tensor in alone.state_dict().items()})
        return alone.train(self.training)


class StdRef(Refiner):
    """One region per joint, 64 pixels (half the patch) wide, with the convolutions of the Deep network."""

    def __init__(self, joints: int = 21, hidden: tuple[int, ...] = (96, 96), dropout: float = 0.3) -> None:
        region = Region(64, 1, (Layer(8, 5, 2), Layer(8, 5, 2), Layer(8, 3, 1)))
        super().__init__(joints, (region,), hidden, dropout)


class ORRef(Refiner):
    """Three overlapping regions per joint. The larger a region is, the more it is pooled.

    So the network sees the joint finely, and its surroundings coarsely.
    """

    def __init__(self, joints: int = 21, hidden: tuple[int, ...] = (96, 96), dropout: float = 0.3) -> None:
        super().__init__(joints, (
            Region(64, 2, (Layer(8, 5, 2), Layer(8, 3, 2))),
            Region(32, 1, (Layer(8, 5, 2), Layer(8, 3, 2))),
            Region(16, 1, (Layer(8, 5, 1), Layer(8, 3, 1))),
        ), hidden, dropout)


def _branch(joints: int, layers: tuple[Layer, ...]) -> list[nn.Module]:
    modules: list[nn.Module] = []
    inputs = 1
    for layer in layers:
        modules.append(relu_conv(joints * inputs, joints * layer.filters, layer.size, groups=joints))
        if layer.pool > 1:
            modules.append(nn.MaxPool2d(layer.pool))
        modules.append(nn.ReLU())
        inputs = layer.filters
    return modules


def _reach(region: Region) -> float:
    """Distance from the centre of a region to its faces, in cube units."""
    return region.width / PATCH_SIZE


def _framed(marked: Tensor, region: Region) -> Tensor:
    """Patches (B, 1, 128, 128) -> images (B, W, W), made smaller for a region, with a border of background."""
    if region.shrink > 1:
        marked = -F.max_pool2d(-marked, region.shrink)
    border = region.width // region.shrink
    return F.pad(marked[:, 0], (border, border + 1) * 2, value=FAR)


def cut(image: Tensor, joints: Tensor, region: Region) -> Tensor:
    """Windows (B, J, N, N) around the joints (B, J, 3), in [-1, 1] like a patch.

    Depth is relative to the joint, and clipped to the cube of the region. The window is shifted by fractions of a pixel
    (bilinear). So the window, and the result, follow the estimate without jumps.

    Args:
        image: (B, W, W), see `_framed`.
    """
    size, cells, reach = PATCH_SIZE // region.shrink, region.width // region.shrink, _reach(region)
    stride = size + 2 * cells + 1
    joints = joints.float()  # half precision is too coarse for positions
    # Further out than the clamp, a window holds nothing but background.
    corner = (joints[..., :2].clamp(-1 - reach, 1 + reach) + 1) * (size / 2) + cells / 2
    whole = corner.floor()
    x, y = (corner - whole).to(image.dtype)[..., None, None, :].unbind(-1)  # (B, J, 1, 1) each
    column, row = whole.int().unbind(-1)
    hand = torch.arange(image.shape[0], device=image.device, dtype=torch.int32)[:, None]
    line = torch.arange(cells + 1, device=image.device, dtype=torch.int32)
    first = (hand * stride + row) * stride + column  # (B, J), positions in the flat batch
    pixels = image.flatten()[first[..., None, None] + (line[:, None] * stride + line)]  # (B, J, N + 1, N + 1)
    depth = ((pixels - joints[..., 2, None, None].to(pixels.dtype)) * (1 / reach)).clamp(-1, 1)
    depth = depth[..., :-1, :] + (depth[..., 1:, :] - depth[..., :-1, :]) * y
    return depth[..., :-1] + (depth[..., 1:] - depth[..., :-1]) * x
