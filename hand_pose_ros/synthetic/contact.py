"""Keeps the parts of a hand out of each other. Poses are nudged until no capsules around the bones overlap."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from hand_pose_ros.synthetic.kinematics import INDEX, POSE, place_bones
from hand_pose_ros.synthetic.shapes import Shape, mean_shape

TOLERANCE, SQUEEZE = 0.002, 0.0045
"""Metres by which capsules may overlap, because flesh gives way where parts touch. SQUEEZE is for two fingers,
TOLERANCE for all other pairs."""

_ROUNDS = 12

# Capsules: 0-2 thumb, 3-14 index to little finger (three each), 15-18 the palm along the metacarpals.
_PAIRS = torch.tensor(
    [(a, b) for a in (1, 2) for b in range(3, 19)]  # thumb: fingers, palm
    + [(3 * i + a, 3 * j + b) for i in range(1, 5) for j in range(i + 1, min(i + 3, 5))
       for a in range(3) for b in range(3) if a + b > 0]  # finger: finger
    + [(3 * i + a, b) for i in range(1, 5) for a in (1, 2) for b in (0, 15, 16, 17, 18)])  # finger: ball of thumb, palm
_FINGER = torch.cat([torch.arange(15) // 3, torch.full((4,), 5)])  # the digit of a capsule, 5 = palm
_GIVE = torch.where((_FINGER[_PAIRS].min(1).values > 0) & (_FINGER[_PAIRS].max(1).values < 5), SQUEEZE, TOLERANCE)


@cache
def _average(device: torch.device) -> Shape:
    return mean_shape().to(device)


def _capsules(shape: Shape, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both ends (B, 19, 3) and radii (B, 19) of the capsules."""
    metacarpals, bases, _, digits = place_bones(shape, pose)
    inwards = shape.palm_depth[:, None, None] * metacarpals[..., 2]  # (B, 4, 3)
    start = torch.cat([digits[:, :, :3].reshape(-1, 15, 3), bases + 0.35 * inwards], 1)
    end = torch.cat([digits[:, :, 1:].reshape(-1, 15, 3), digits[:, 1:, 0] + 0.18 * inwards], 1)
    radii = shape.radii * shape.radii.new_tensor([[0.8, 1, 0.95], *[[0.96, 1, 0.95]] * 4])
    palm = 0.74 * shape.palm_depth[:, None].expand(-1, 4)
    return start, end, torch.cat([radii.reshape(-1, 15), palm], 1).expand(len(pose), 19)


def _segment_distance(p: Tensor, q: Tensor, r: Tensor, s: Tensor) -> Tensor:
    """Least distance (...) between the segments p-q and r-s, (..., 3) each."""
    u, v, w = q - p, s - r, p - r
    a, b, c, d, e = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1), (u * w).sum(-1), (v * w).sum(-1)
    t = ((b * e - c * d) / (a * c - b * b).clamp(1e-12)).clamp(0, 1)
    k = ((b * t + e) / c.clamp(1e-12)).clamp(0, 1)
    t = ((b * k - d) / a.clamp(1e-12)).clamp(0, 1)
    return (w + t[..., None] * u - k[..., None] * v).norm(dim=-1)


def overlaps(pose: Tensor, shape: Shape | None = None) -> Tensor:
    """How deep the parts of hands are inside each other, in metres, less what flesh gives way.

    Args:
        pose: (B, P) radians.
        shape: B hands, or one for all; the average hand if left out.

    Returns:
        (B, 6, 6), symmetric. The order is thumb to little finger, then palm. 0 means no overlap.
    """
    shape = _average(pose.device) if shape is None else shape
    start, end, radius = _capsules(shape, pose)
    a, b = _PAIRS.to(pose.device).T
    apart = _segment_distance(start[:, a], end[:, a], start[:, b], end[:, b])
    deep = (radius[:, a] + radius[:, b] - apart - _GIVE.to(pose.device)).clamp(0)
    finger = _FINGER.to(pose.device)
    slot = (6 * finger[a] + finger[b]).expand(len(pose), -1)
    table = torch.zeros(len(pose), 36, device=pose.device).scatter_reduce(1, slot, deep, 'amax').reshape(-1, 6, 6)
    return torch.maximum(table, table.mT)


def part_contacts(pose: Tensor) -> Tensor:
    """Poses (B, P) near the given ones, in which no parts of the average hand overlap (see `overlaps`).

    The thumb moves outwards. Fingers that meet the palm or the thumb open, and fingers that meet each other come side
    by side. A hand that is still entangled after some rounds moves half-way to an open one, and if need be all the way.
    """
    pose, still = pose.clone(), torch.arange(len(pose), device=pose.device)
    for turn in range(_ROUNDS + 2):
        deep = overlaps(pose[still])
        touching = (deep > 0).flatten(1).any(1)
        still, deep = still[touching], deep[touching]
        if not len(still):
            break
        if turn < _ROUNDS:
            pose[still] = _nudge(pose[still], deep)
        else:
            pose[still, 4:] = torch.lerp(pose[still, 4:], _open_hand(pose)[4:], 0.5 if turn == _ROUNDS else 1.0)
    return pose


def bring_together(pose: Tensor, within: float) -> Tensor:
    """Poses (B, P), in which the thumb of the average hand is moved until its tip touches the nearest fingertip.

    Hands whose tips are further than `within` metres from touching stay as they are.
    """
    shape = _average(pose.device)
    steps = torch.zeros(6, len(POSE), device=pose.device)
    for row, angle in enumerate(('cmc_radial', 'cmc_palmar', 'cmc_roll', 'mcp_flexion', 'ip_flexion')):
        steps[row + 1, INDEX[f'thumb_{angle}']] = 0.01

    def gap(angles: Tensor) -> Tensor:
        tips = place_bones(shape, angles)[3][:, :, 3]
        touching = shape.radii[:, :1, 2] + shape.radii[:, 1:, 2] - TOLERANCE
        return ((tips[:, 1:] - tips[:, :1]).norm(dim=-1) - touching).abs().amin(1)

    pose, near = pose.clone(), (gap(pose) < within).nonzero()[:, 0]
    for _ in range(3):  # Newton steps along the gradient of the gap
        value = gap((pose[near, None] + steps).reshape(-1, len(POSE))).reshape(-1, 6)
        slope = (value[:, 1:] - value[:, :1]) / 0.01
        step = (value[:, :1] / (slope.square().sum(1, keepdim=True) + 1e-4)).clamp(max=20) * slope
        pose[near] -= (step @ (steps[1:] / 0.01)).clamp(-0.2, 0.2)
    return pose


_THUMB = slice(INDEX['thumb_cmc_radial'], INDEX['thumb_ip_flexion'] + 1)
_FINGERS = slice(INDEX['index_mcp_flexion'], len(POSE))


def _open_hand(like: Tensor) -> Tensor:
    """A pose (P,) in which no parts meet. The fingers are straight, and the thumb is off the palm."""
    pose = torch.zeros_like(like[0])
    pose[_THUMB] = torch.deg2rad(like.new_tensor([46, 34, 80, 0, 4, 0]))
    return pose


def _nudge(pose: Tensor, deep: Tensor) -> Tensor:
    """One step of poses (B, P) away from their overlaps (B, 6, 6)."""
    amount = (deep / 0.015).clamp(0.03, 0.6) * (deep > 0)
    thumb = torch.lerp(pose[:, _THUMB], _open_hand(pose)[_THUMB], amount[:, 0, 1:].amax(1, keepdim=True))
    fingers = pose[:, _FINGERS].reshape(-1, 4, 4)  # MCP flexion and abduction, PIP and DIP flexion
    between = amount[:, 1:5, 1:5]
    strength = between.amax(2)[..., None]
    beside = (between @ fingers) / between.sum(2, keepdim=True).clamp(1e-6)  # how the fingers that it meets are bent
    bend = torch.lerp(fingers, beside, 0.5 * strength)
    opening = 1 - torch.maximum(0.35 * amount[:, 1:5, 5], 0.1 * amount[:, 1:5, 0])[..., None]
    fingers = torch.stack([bend[..., 0:1] * opening, fingers[..., 1:2] * (1 - strength), bend[..., 2:3] * opening,
                           fingers[..., 3:4] * opening], -2)
    return torch.cat([pose[:, :_THUMB.start], thumb, fingers.reshape(-1, 16)], 1)
