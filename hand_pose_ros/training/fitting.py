"""One hand through a whole recording: the parametric hand, fitted to estimated joints and to depth by gradient descent.

Estimates of single images know nothing of each other. A hand does: its bones keep their lengths, its joints keep
within their limits, from one image to the next it does not jump, and its skin is where depth was measured.
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
"""Step of Adam for what has no unit, and for the place of the wrist in metres."""
KNEE_M = 0.008
"""Joints further than this from their estimate pull no harder: they may be wrong."""
OFF_M = 0.015
"""Depth further than this from the skin belongs to something else, and does not pull."""
_PALM = [HAND21.joint_names.index(name) for name in ('wrist', 'index_mcp', 'middle_mcp', 'ring_mcp', 'pinky_mcp')]
_ROOT_SPREAD = (0.04, 0.02, 0.25)  # of `shapes.sample_shapes`, as the other two below


def fit_hand(joints: Tensor, trust: Tensor, rows: Tensor, surface: Tensor) -> Tensor:
    """The joints (N, 21, 3) of one right hand that moves as the estimates say, in metres.

    Args:
        joints: (N, 21, 3) estimates in metres, hand21, of N images of the same hand.
        trust: (N, 21) weight of each.
        rows: (N,) int64 ascending numbers of the images: what follows each other directly may not jump.
        surface: (N, P, 3) measured points of the hand and of what is around it, metres.
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
    """Mean distance in metres of points (N, P, 3) from the skin of hands, each bone with its flesh as a capsule.

    What is beyond the wrist may be the arm, and what is beyond `OFF_M`, anything: neither counts.
    """
    parents, children = zip(*HAND21.bones, strict=True)
    start, bone = joints[:, parents], joints[:, children] - joints[:, parents]
    # The first bone of a finger is within the palm; the thumb has its own flesh from its root on.
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
    """Length of offsets (..., 3) in millimetres, squared near zero."""
    length = 1000 * (offset.square().sum(-1) + 1e-12).sqrt()
    return F.smooth_l1_loss(length, torch.zeros_like(length), beta=1000 * KNEE_M, reduction='none')


def _joints(shape: Shape, pose: Tensor) -> Tensor:
    """(N, 21, 3) in the frame of the hand."""
    digits = place_bones(shape, pose)[3]
    return torch.cat([digits.new_zeros(len(pose), 1, 3), digits.reshape(len(pose), 20, 3)], dim=1)


def _rotation(turn: Tensor) -> Tensor:
    """(N, 3, 3) from two columns, (N, 6), which need be neither long one nor square (Zhou et al. 2019)."""
    x, y = F.normalize(turn[:, :3], dim=-1), turn[:, 3:]
    y = F.normalize(y - (x * y).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def _turn_to(joints: Tensor) -> Tensor:
    """Rotations (N, 3, 3) that lay the palm of a mean hand onto that of the estimates (Kabsch 1976)."""
    palm = _joints(mean_shape(), torch.zeros(1, len(POSE)))[:, _PALM]
    palm, seen = palm - palm.mean(1, keepdim=True), joints[:, _PALM] - joints[:, _PALM].mean(1, keepdim=True)
    u, _, vt = torch.linalg.svd(seen.mT @ palm)
    sign = torch.ones(len(joints), 3)
    sign[:, 2] = torch.det(u @ vt).sign()
    return (u * sign[:, None]) @ vt
