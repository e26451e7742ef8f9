"""Fits the parametric hand to a whole recording, to estimated joints and to depth, by gradient descent.

Estimates of single images know nothing of each other. But the bones of a hand keep their lengths, its joints stay
within their limits, it does not jump from one image to the next, and its skin is where depth was measured.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.kinematics import POSE, place_bones
from hand_pose_ros.synthetic.poses import LIMITS
from hand_pose_ros.synthetic.shapes import Shape, make_shape, mean_shape

STEPS = 250
RATE, RATE_M = 0.03, 0.002
"""Learning rate of Adam for values without a unit, and for the place of the wrist in metres."""
KNEE_M = 0.008
"""An estimate that is further than this from its joint pulls no harder, because it may be wrong."""
OFF_M = 0.015
"""Depth that is further than this from the skin belongs to something else, and does not pull."""
_PALM = [HAND21.joint_names.index(name) for name in ('wrist', 'index_mcp', 'middle_mcp', 'ring_mcp', 'pinky_mcp')]
_ROOT_SPREAD = (0.04, 0.02, 0.25)  # standard deviations of `shapes.sample_shapes`, like 0.07 and 0.055 below


def fit_hand(joints: Tensor, trust: Tensor, rows: Tensor, surface: Tensor) -> Tensor:
    """The joints (N, 21, 3) in metres of one right hand that moves as the estimates say.

    Args:
        joints: (N, 21, 3) estimates in metres (hand21), of N images of the same hand.
        trust: (N, 21) weights of the estimates.
        rows: (N,) int64, ascending numbers of the images. The hand does not jump between images that follow each other.
        surface: (N, P, 3) measured points of the hand and its surroundings in metres.
    """
    low, high = LIMITS.T
    start = _turn_to(joints)
    size, bones, roots = torch.zeros(2), torch.zeros(1, 5, 3), torch.zeros(1, 5, 3)  # in standard deviations
    angles = torch.full((len(joints), len(POSE)), -0.5)  # a little less than half-way between the limits
    turn, place = start[:, :, :2].mT.reshape(-1, 6), joints[:, 0].clone()
    unknowns = [tensor.requires_grad_(True) for tensor in (size, bones, roots, angles, turn, place)]
    optimizer = torch.optim.Adam([{'params': unknowns[:3], 'lr': 2 * RATE}, {'params': unknowns[3:5], 'lr': RATE},
                                  {'params': [place], 'lr': RATE_M}])
    calm = (rows[2:] - rows[:-2] == 2)[:, None, None]

    def pose_hand() -> tuple[Shape, Tensor]:
        mean, factor = mean_shape(), (0.07 * size).exp()
        shape = make_shape(mean.hand_length * factor[0], mean.hand_breadth * factor[1], 1 + 0.055 * bones,
                           1 + roots * roots.new_tensor(_ROOT_SPREAD))
        flat = _joints(shape, low + (high - low) * angles.sigmoid())
        return shape, flat @ _rotation(turn).mT + place[:, None]

    for step in range(STEPS):
        if step == int(0.7 * STEPS):
            for group in optimizer.param_groups:
                group['lr'] *= 0.3
        shape, fitted = pose_hand()
        loss = (trust * _robust(fitted - joints)).mean() + 0.5 * 1000 * _off_skin(surface, fitted, shape)
        jump = _robust((fitted[2:] - 2 * fitted[1:-1] + fitted[:-2]) * calm).sum() / max(1, 21 * int(calm.sum()))
        loss = loss + 0.3 * jump
        loss = loss + 0.1 * (angles + 0.5).square().mean()
        loss = loss + 0.02 * (size.square().sum() + bones.square().sum() + roots.square().sum())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return pose_hand()[1].detach()


def _off_skin(points: Tensor, joints: Tensor, shape: Shape) -> Tensor:
    """Mean distance in metres of points (N, P, 3) from the skin of hands. The skin is a capsule around each bone.

    Points beyond the wrist do not count, because they may be the arm. Nor do points further away than `OFF_M`.
    """
    parents, children = zip(*HAND21.bones, strict=True)
    start, bone = joints[:, parents], joints[:, children] - joints[:, parents]
    # The first bone of a finger is within the palm. The thumb has its own flesh from its root on.
    palm = 0.9 * shape.palm_depth[:, None].expand(-1, 5)
    radius = torch.cat([palm[..., None], shape.radii], dim=2).flatten()
    offset = points[:, :, None] - start[:, None]
    along = (offset * bone[:, None]).sum(-1) / bone.square().sum(-1)[:, None].clamp(min=1e-8)
    distance = ((offset - along.clamp(0, 1)[..., None] * bone[:, None]).square().sum(-1) + 1e-12).sqrt() - radius
    nearest = distance.min(dim=2).values.abs()
    up = joints[:, 9] - joints[:, 0]
    counts = (((points - joints[:, :1]) * up[:, None]).sum(-1) > 0) & (nearest < OFF_M)
    return (nearest * counts).sum() / counts.sum().clamp(min=1)


def _robust(offset: Tensor) -> Tensor:
    """Loss (...) of offsets (..., 3): their length in millimetres, but squared near zero."""
    length = 1000 * (offset.square().sum(-1) + 1e-12).sqrt()
    return F.smooth_l1_loss(length, torch.zeros_like(length), beta=1000 * KNEE_M, reduction='none')


def _joints(shape: Shape, pose: Tensor) -> Tensor:
    """(N, 21, 3) in the frame of the hand."""
    digits = place_bones(shape, pose)[3]
    return torch.cat([digits.new_zeros(len(pose), 1, 3), digits.reshape(len(pose), 20, 3)], dim=1)


def _rotation(turn: Tensor) -> Tensor:
    """Rotations (N, 3, 3) from any two columns (N, 6). They are made orthonormal (Zhou et al. 2019)."""
    x, y = F.normalize(turn[:, :3], dim=-1), turn[:, 3:]
    y = F.normalize(y - (x * y).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def _turn_to(joints: Tensor) -> Tensor:
    """Rotations (N, 3, 3) that turn the palm of a mean hand to the palms of the estimates (Kabsch 1976)."""
    palm = _joints(mean_shape(), torch.zeros(1, len(POSE)))[:, _PALM]
    palm, seen = palm - palm.mean(1, keepdim=True), joints[:, _PALM] - joints[:, _PALM].mean(1, keepdim=True)
    u, _, vt = torch.linalg.svd(seen.mT @ palm)
    sign = torch.ones(len(joints), 3)
    sign[:, 2] = torch.det(u @ vt).sign()
    return (u * sign[:, None]) @ vt
