"""Two looks at a hand. The second one sees it upright, in the middle, and always equally large. The design is ours.

A hand may be turned any way in the image. A network that sees it once needs most of its capacity for that. Here a first
network finds roughly where the joints are. Then the patch is turned, moved and scaled, so that all hands stand upright
in the middle and are equally large. A second network is trained for such hands. Its pose prior needs no components for
turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor, nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.dense import HandDense

ZOOM = 0.95
"""Half the width of the view of a hand of the usual size, in cube units. With it, 2 % of hands have a joint that is
further out than 0.86 in the view."""
MAX_SIZE = 0.4
"""The size that the first look gives (a logarithm) is clamped to plus or minus this."""
STEPS = 64
"""The middle, direction and size of a view are rounded to multiples of 1 / STEPS. Engines differ in the last bits of
the first look. After rounding, they nearly always see the same pixels."""


class View(NamedTuple):
    """Where to look from. A point p in cube units is seen at turn @ (p - middle) / scale. Depth is not turned."""

    middle: Tensor
    """(B, 3)"""
    turn: Tensor
    """(B, 2, 2), a rotation in the plane of the patch."""
    scale: Tensor
    """(B,)"""

    def into(self, points: Tensor) -> Tensor:
        """Points (B, N, 3) in cube units -> the same points in units of the view."""
        offset = (points - self.middle[:, None]) / self.scale[:, None, None]
        return torch.cat([_turned(offset[..., :2], self.turn), offset[..., 2:]], dim=2)

    def back(self, points: Tensor) -> Tensor:
        """The inverse of `into`."""
        turned = torch.cat([_turned(points[..., :2], self.turn.transpose(1, 2)), points[..., 2:]], dim=2)
        return turned * self.scale[:, None, None] + self.middle[:, None]

    def patch(self, patch: Tensor) -> Tensor:
        """Patches (B, 1, 128, 128) -> patches as they are seen. Nearest neighbour, as when an image is cropped."""
        size = PATCH_SIZE
        line = torch.arange(size, device=patch.device, dtype=torch.float32) + (0.5 - size / 2)
        middle = self.middle.float()
        # In pixels of the patch. The steps are rounded so that these sums are exact, in whatever order they are added.
        steps = ((self.turn * self.scale[:, None, None]).float() * 1024).round() / 1024
        start = (middle[:, :2] + 1) * (size / 2)
        across, down, start = (part[..., None, None] for part in (steps[:, 0], steps[:, 1], start))
        # Places outside are read from a border of background.
        at = (line * across + line[:, None] * down + start).floor().clamp(-1, size).int() + 1
        column, row = at.unbind(1)  # (B, 128, 128) each
        image = F.pad(patch, (1, 1, 1, 1), value=1.0).flatten()
        hand = torch.arange(patch.shape[0], device=patch.device, dtype=torch.int32)[:, None, None]
        seen = image[(hand * (size + 2) + row) * (size + 2) + column].float()
        depth = (seen - middle[:, 2, None, None]) / self.scale[:, None, None].float()
        return torch.where(seen < 1, depth.clamp(-1, 1), torch.ones_like(depth))[:, None].to(patch.dtype)


class TwoLooks(nn.Module):
    """A trained `HandDense` that is not trained any more, and a second one that looks where the first sees a hand.

    Args:
        joints: number of joints, J.
        root, knuckles: numbers of joints. A hand is upright when the mean of its knuckles is above its root.
        width, bottleneck, blocks, refined: options of the second look, see `HandDense`.
        first: the same options of the first look. Those that are left out have their defaults; None = all are those of
            the second look. The first look may be much smaller, because it only finds where to look.

    Raises:
        HandPoseError: root or knuckles are not among the joints, a knuckle is given twice, or a `HandDense` does not
            take these options.
    """

    outputs = HandDense.outputs

    def __init__(self, joints: int = 21, root: int = 0, knuckles: Sequence[int] = (5, 9, 13, 17), width: int = 32,
                 bottleneck: int | None = None, blocks: Sequence[int] = (1, 1, 1, 1), refined: bool = False,
                 first: dict[str, Any] | None = None) -> None:
        super().__init__()
        if not all(0 <= joint < joints for joint in (root, *knuckles)) or not knuckles:
            raise HandPoseError(f'root {root} and knuckles {list(knuckles)} are not all among {joints} joints')
        if len(set(knuckles)) < len(knuckles):
            raise HandPoseError(f'knuckles {list(knuckles)}: give each joint once')
        self.root, self.knuckles = root, list(knuckles)
        second: dict[str, Any] = {'width': width, 'bottleneck': bottleneck, 'blocks': blocks, 'refined': refined}
        self.first = HandDense(joints, **(first or second))
        self.first.requires_grad_(False).eval()
        self.second = HandDense(joints, **second)

    def set_prior(self, mean: ArrayLike, components: ArrayLike) -> None:
        """Start the prior of the second look from poses as this look sees them: see `HandDense.set_prior`."""
        self.second.set_prior(mean, components)

    @property
    def head(self) -> nn.Module | None:
        """The prior of the second look."""
        return self.second.head

    def train(self, mode: bool = True) -> TwoLooks:
        """Set the mode of the second look. The first one stays in eval mode."""
        super().train(mode)
        self.first.eval()
        return self

    def look(self, patch: Tensor) -> tuple[View, Tensor]:
        """The view of the second look at patches (B, 1, 128, 128), and the patches in it. No gradient passes through.
        """
        with torch.no_grad():
            first = self.first.forward_full(patch)
            return self.seen(patch, first['joints'], first['size'])

    def seen(self, patch: Tensor, joints: Tensor, size: Tensor) -> tuple[View, Tensor]:
        """The same, where joints and size of the hands are known (see `upright`)."""
        view = self.upright(joints, size)
        return view, view.patch(patch)

    def upright(self, joints: Tensor, size: Tensor) -> View:
        """The view in which hands are upright, in the middle and equally large.

        Args:
            joints: (B, J, 3) in cube units.
            size: (B,), the output `size` of `HandDense.forward_full`.
        """
        joints, size = joints.float(), size.float()
        # Neither here nor above is a tensor made from a list: a CUDA graph cannot hold a copy from the host.
        up = torch.stack([joints[:, k, :2] for k in self.knuckles]).mean(dim=0) - joints[:, self.root, :2]
        # A hand that points at the camera has no direction. It gets one, so that nothing is divided by zero.
        up = up - 1e-6 * torch.arange(2, device=up.device)
        up = _unit(_rounded(_unit(up)))
        sin, cos = (-up).unbind(1)
        turn = torch.stack([torch.stack([cos, -sin], dim=1), torch.stack([sin, cos], dim=1)], dim=1)
        return View(_rounded(joints.mean(dim=1)), turn, ZOOM * torch.exp(_rounded(size.clamp(-MAX_SIZE, MAX_SIZE))))

    def forward(self, patch: Tensor) -> Tensor:
        """(B, 1, 128, 128) in [-1, 1] -> (B, J, 3) in cube units."""
        return self.forward_full(patch)['joints']

    def forward_full(self, patch: Tensor) -> dict[str, Tensor]:
        """(B, 1, 128, 128) in [-1, 1] -> joints, confidence, hand, side and size, as in `HandDense.forward_full`."""
        view, seen = self.look(patch)
        second = self.second.forward_full(seen)
        return {**{name: second[name] for name in self.outputs},
                'joints': view.back(second['joints'].float()), 'size': second['size'].float() + view.scale.log()}


def _turned(points: Tensor, turn: Tensor) -> Tensor:
    """Points (B, N, 2) after a turn (B, 2, 2). Not a matrix product, which training in half precision would round."""
    return (points[:, :, None] * turn[:, None]).sum(dim=3)


def _rounded(x: Tensor) -> Tensor:
    return (x * STEPS).round() / STEPS


def _unit(x: Tensor) -> Tensor:
    return x / x.square().sum(dim=1, keepdim=True).sqrt()
