"""A small residual network in which every visible piece of the hand votes for every joint. The design is ours.

The maps have 32 x 32 cells. For each joint, a cell gives the direction to the joint and how close it is. The joint is
the mean of the votes, weighted by closeness (the encoding of AWR, Huang et al. 2020, in cube units). With a bottleneck,
the pose prior of the paper turns the joints into one hand. With `refined`, each joint is then moved, depending on what
is seen at its place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor, nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.prior import PriorOverVotes, plain_linear

CELLS = 32
"""Cells along each side of the maps. One cell covers 4 x 4 pixels of the patch."""
REACH = 0.8
"""Cells that are further from a joint than this, in cube units, do not vote for it."""
HAND_PER_CUBE = 0.19 / 0.30
"""Length of a hand over the side of its cube, where the output `size` is 0. The length is measured from the wrist along
the bones to the tip of the middle finger."""
SHARPNESS = 30.0
"""Weight of a vote: exp(SHARPNESS * closeness)."""
LEAK = 0.1
"""Slope of the leaky ReLU of the refinement."""
ADDED = re.compile(r'\bstages\.\d+\.[1-9]\d*\.|\brefinement\.')
"""Matches the names of weights that can be added to a trained network, because they start as the identity: all blocks
of a stage but the first, and the refinement."""


def cells(patch: Tensor) -> tuple[Tensor, Tensor]:
    """Patch (B, 1, 128, 128) -> cells (B, 3, 32, 32) in cube units, and which of them see something (B, 1, 32, 32).

    The depth of a cell is the mean of its readings, or 1 if it has none.
    """
    seen = (patch < 1).to(patch.dtype)
    size = PATCH_SIZE // CELLS
    share = F.avg_pool2d(seen, size)
    empty = (share == 0).to(patch.dtype)
    depth = (F.avg_pool2d(patch * seen, size) + empty) / (share + empty)
    line = (torch.arange(CELLS, device=patch.device, dtype=patch.dtype) + 0.5) * (2 / CELLS) - 1
    x = line.view(1, 1, 1, CELLS).expand_as(depth)
    y = line.view(1, 1, CELLS, 1).expand_as(depth)
    return torch.cat([x, y, depth], dim=1), 1 - empty


def encode(positions: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """The target of the maps: cells (B, 3, 32, 32) and joints (B, J, 3) -> directions and closeness.

    Returns:
        Unit vectors from cell to joint (B, J, 3, 32, 32), and closeness (B, J, 32, 32): 1 at the joint, 0 at REACH.
        Both are zero beyond REACH.
    """
    offset = joints[..., None, None] - positions[:, None]
    distance = offset.square().sum(dim=2).sqrt()  # norm() along an inner dimension is several times as slow
    closeness = (1 - distance / REACH).clamp(min=0)
    return offset / distance.clamp(min=1e-6)[:, :, None] * (closeness > 0)[:, :, None], closeness


def decode(positions: Tensor, seen: Tensor, directions: Tensor, closeness: Tensor) -> tuple[Tensor, Tensor]:
    """The differentiable inverse of `encode`: joints (B, J, 3), and the mean closeness of their votes (B, J).

    Only cells that see something vote. If no cell does, all vote.
    """
    weights = (SHARPNESS * closeness.flatten(2) - 1e4 * (1 - seen.flatten(2))).softmax(dim=2)  # (B, J, 1024)
    # The sum of weight * (cell + direction * distance) is split in two products, so no map of votes is stored.
    base = weights @ positions.flatten(2).transpose(1, 2)  # (B, J, 3)
    distance = REACH * (1 - closeness.flatten(2))
    moved = (directions.flatten(3) @ (weights * distance)[..., None])[..., 0]  # (B, J, 3)
    return base + moved, (weights * closeness.flatten(2)).sum(dim=2)


class HandDense(nn.Module):
    """Predicts joints, and what a tracker needs: is this a hand, its side, its size, and how sure each joint is.

    Args:
        joints: number of joints, J.
        width: channels of the first stage. The cost grows with the square of this.
        bottleneck: number of coefficients of the pose prior after the votes; None = no prior.
        blocks: number of residual blocks in each stage.
        refined: whether the joints are refined.

    Raises:
        HandPoseError: `blocks` are not four numbers of at least 1.
    """

    outputs = ('joints', 'confidence', 'hand', 'side', 'size')

    def __init__(self, joints: int = 21, width: int = 32, bottleneck: int | None = None,
                 blocks: Sequence[int] = (1, 1, 1, 1), refined: bool = False) -> None:
        super().__init__()
        if len(blocks) != 4 or min(blocks) < 1:
            raise HandPoseError(f'blocks {list(blocks)}: give four numbers, each at least 1')
        self.joints, self.width, self.bottleneck, self.blocks, self.refined = (
            joints, width, bottleneck, list(blocks), refined)
        w = width
        self.stem = nn.Sequential(conv_norm(1, w, 5, stride=2), nn.ReLU(), nn.MaxPool2d(2))
        self.stages = nn.ModuleList()
        for inputs, outputs, count in zip((w, w, 2 * w, 4 * w), (w, 2 * w, 4 * w, 8 * w), blocks, strict=True):
            further = [Residual(outputs, outputs, 1) for _ in range(count - 1)]
            self.stages.append(nn.Sequential(Residual(inputs, outputs, 1 if inputs == outputs else 2), *further))
        self.laterals = nn.ModuleList(Lateral(k * w, 2 * w, 1) for k in (1, 2, 4, 8))
        self.fuse = nn.Sequential(conv_norm(2 * w, 2 * w, 3), nn.ReLU())
        self.maps = nn.Conv2d(2 * w, 4 * joints, 1)
        self.summary = plain_linear(8 * w + joints, joints + 3)
        self.head = PriorOverVotes(joints, bottleneck) if bottleneck else None
        self.refinement = JointRefinement(joints, 3 * w, 8 * w) if refined else None
        nn.init.normal_(self.maps.weight, std=0.01)
        nn.init.zeros_(self.maps.bias)  # type: ignore[arg-type]
        self.cells, self.decode = cells, decode  # an engine may have faster ones

    def set_prior(self, mean: ArrayLike, components: ArrayLike) -> None:
        """Start the prior from a mean (3J,) and components (bottleneck, 3J): see `fit_prior`."""
        if self.head is None:
            raise HandPoseError('a network without a bottleneck takes no prior')
        self.head.set_prior(mean, components)

    def forward(self, patch: Tensor) -> Tensor:
        """(B, 1, 128, 128) in [-1, 1] -> (B, J, 3) in cube units."""
        return self.forward_full(patch)['joints']

    def forward_full(self, patch: Tensor) -> dict[str, Tensor]:
        """(B, 1, 128, 128) in [-1, 1] -> all outputs, by name.

        - joints (B, J, 3) in cube units
        - logits: confidence (B, J) that a joint is right, hand (B,) that this is a hand, side (B,) that it is a right
          hand
        - size (B,): log(length of the hand / (HAND_PER_CUBE * side of the cube))
        - for the loss: votes (B, J, 3), the joints before the prior; unrefined (B, J, 3), the joints before the
          refinement; positions (B, 3, 32, 32), seen (B, 1, 32, 32), directions (B, J, 3, 32, 32), closeness
          (B, J, 32, 32)
        """
        features, fused = pyramid(self.stem(patch), self.stages, self.laterals)
        fused = self.fuse(fused)  # (B, 2w, 32, 32)
        # Sums over a thousand cells need more than half precision. In memory, they run along the cells, whatever layout
        # the convolutions prefer.
        maps = self.maps(fused).float().contiguous()
        directions = maps[:, :3 * self.joints].unflatten(1, (self.joints, 3))
        closeness = maps[:, 3 * self.joints:]
        positions, seen = self.cells(patch.float())
        with torch.autocast(patch.device.type, enabled=False):  # also not when training in half precision
            votes, agreement = self.decode(positions, seen, directions, closeness)
        whole = features[-1].mean(dim=(2, 3), dtype=torch.float32)  # (B, 8w)
        summary = self.summary(torch.cat([whole, agreement], dim=1).to(self.summary.weight.dtype))
        confidence = summary[:, :self.joints]
        with torch.autocast(patch.device.type, enabled=False):
            # The confidence must say how sure a joint is. The prior must not train it to say something else.
            unrefined = votes if self.head is None else self.head(votes, confidence.detach())
            joints = unrefined
            if self.refinement is not None:
                local = fused, features[0]
                joints = self.refinement(unrefined, votes, confidence.detach(), local, whole)
        return {
            'joints': joints, 'confidence': confidence,
            **dict(zip(('hand', 'side', 'size'), summary[:, self.joints:].unbind(1), strict=True)),
            'votes': votes, 'unrefined': unrefined,
            'positions': positions, 'seen': seen, 'directions': directions, 'closeness': closeness,
        }


def pyramid(x: Tensor, stages: nn.ModuleList, laterals: nn.ModuleList) -> tuple[list[Tensor], Tensor]:
    """The features of each stage, and their sum (feature pyramid, Lin et al. 2017).

    Each stage but the first halves the size. For the sum, the features of each stage go through their lateral and are
    enlarged to the size of the first.
    """
    features = []
    for stage in stages:
        x = stage(x)
        features.append(x)
    fused = laterals[-1](x)
    for lateral, feature in zip(laterals[-2::-1], features[-2::-1], strict=True):
        fused = lateral(feature, fused)
    return features, fused


class Lateral(nn.Conv2d):
    """A projection of the features of one stage. The sum of those of the coarser stages is added."""

    def forward(self, x: Tensor, coarser: Tensor | None = None) -> Tensor:
        own = super().forward(x)
        return own if coarser is None else F.interpolate(coarser, scale_factor=2, mode='nearest') + own


class JointRefinement(nn.Module):
    """Moves joints, depending on what is seen at their places: the refinement of the paper (3.3), with two differences.

    It uses features that are already computed. And it looks at all joints at once, so what is seen at one joint can
    move another.

    Args:
        joints: number of joints, J.
        local: number of channels of the maps that are read at the joints.
        whole: number of features of the whole patch.
    """

    WIDTH = 64
    HIDDEN = 256

    def __init__(self, joints: int, local: int, whole: int) -> None:
        super().__init__()
        inputs = local + 7
        self.norm, self.norm_whole = nn.BatchNorm1d(inputs), nn.BatchNorm1d(whole)
        self.each = nn.Parameter(torch.randn(joints, inputs, self.WIDTH) * (2 / inputs) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(joints, 1, self.WIDTH))
        self.all = nn.Linear(joints * self.WIDTH + whole, self.HIDDEN)
        self.hidden = nn.Linear(self.HIDDEN, self.HIDDEN)
        self.output = nn.Linear(self.HIDDEN, 3 * joints)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, joints: Tensor, votes: Tensor, confidence: Tensor, local: Sequence[Tensor],
                whole: Tensor) -> Tensor:
        """Better joints (B, J, 3), in cube units.

        Args:
            joints, votes: (B, J, 3) in cube units; the votes are those for the joints.
            confidence: (B, J) logits of how sure the joints are.
            local: maps (B, C, H, W), C channels in all.
            whole: features of the whole patch (B, F).
        """
        dtype = self.all.weight.dtype
        joints, votes, confidence, whole = (x.to(dtype) for x in (joints, votes, confidence, whole))
        # No gradient for the places: the maps learn from what was read, not from where else it could have been read.
        places = joints[:, :, None, :2].detach().clamp(-1, 1)
        read = [F.grid_sample(maps.to(dtype), places, align_corners=False)[..., 0] for maps in local]  # (B, C, J)
        told = torch.cat([joints, votes, confidence[..., None]], dim=2)
        x = self.norm(torch.cat([*read, told.transpose(1, 2)], dim=1))
        x = _active(torch.baddbmm(self.bias, x.permute(2, 0, 1), self.each)).transpose(0, 1)  # (B, J, WIDTH)
        x = _active(self.all(torch.cat([x.flatten(1), self.norm_whole(whole)], dim=1)))
        x = x + _active(self.hidden(x))
        return joints + self.output(x).view_as(joints)


def _active(x: Tensor) -> Tensor:
    # With plain ReLU, hundreds of units die while the output is still zero, and the refinement never starts to learn.
    return F.leaky_relu(x, LEAK)


class Residual(nn.Module):
    """Two 3x3 convolutions beside the identity, or beside a 1x1 projection where the shape changes (He et al. 2016).

    A block that keeps the shape starts as the identity (Goyal et al. 2017). So it can be added to a trained network.
    """

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        last = conv_norm(outputs, outputs, 3)
        self.body = nn.Sequential(conv_norm(inputs, outputs, 3, stride), nn.ReLU(), last)
        self.shortcut: nn.Module = nn.Identity()
        if inputs != outputs or stride != 1:
            self.shortcut = conv_norm(inputs, outputs, 1, stride)
        else:
            nn.init.zeros_(last[1].weight)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.body(x) + self.shortcut(x))


def conv_norm(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    """A convolution of an odd size, and its norm. Height and width are divided by the stride."""
    convolution = nn.Conv2d(inputs, outputs, size, stride, padding=size // 2, bias=False)
    nn.init.kaiming_normal_(convolution.weight, nonlinearity='relu')
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs))
