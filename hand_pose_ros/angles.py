"""Angles of the finger joints from the positions of the hand21 joints, for example to drive a robot hand.

The palm defines the frame: y from the wrist to the knuckle of the middle finger, x from the knuckle of the ring finger
towards that of the index finger, z out of the palm. (The knuckle of the little finger is not used: its metacarpal
moves.)

The names are those of anatomy. All angles of a finger are 0 when it is straight and parallel to the middle metacarpal:

- `<finger>_mcp_flexion`: the first bone towards the palm; hyperextension is negative.
- `<finger>_mcp_abduction`: the first bone out of the sagittal plane, away from the middle finger; for the middle finger
  itself, towards the thumb. Fingers that lie side by side differ by a few degrees, because they converge.
- `<finger>_pip_flexion`, `<finger>_dip_flexion`: the next two bones, each relative to the bone before it.
- `thumb_cmc_flexion`: the metacarpal of the thumb across the palm, in the plane of the palm; spread away from the hand
  is negative.
- `thumb_cmc_abduction`: the metacarpal of the thumb out of that plane (palmar abduction).
- `thumb_mcp_flexion`, `thumb_ip_flexion`: the whole bend of the joint, positive towards the root of the little finger,
  negative away from it. The nearer a bend is to sideways, for example of an abducted MCP, the less it counts. So the
  angle passes through 0 and does not jump.

The rotation about the axis of a bone cannot be seen in the positions, so there is no angle for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hand_pose_ros.errors import InputError
from hand_pose_ros.skeleton import FINGERS, HAND21

ANGLES = ('thumb_cmc_flexion', 'thumb_cmc_abduction', 'thumb_mcp_flexion', 'thumb_ip_flexion',
          *(f'{finger}_{angle}' for finger in FINGERS[1:]
            for angle in ('mcp_flexion', 'mcp_abduction', 'pip_flexion', 'dip_flexion')))
"""Names of the angles, in the order of `finger_angles`."""

_JOINT = {name: i for i, name in enumerate(HAND21.joint_names)}
_ABDUCTING = {'index': 1, 'middle': 1, 'ring': -1, 'pinky': -1}
"""Sign of x in the direction of abduction."""
_BELOW = 0.2
"""The thumb flexes towards a point below the knuckle of the little finger, by this share of the palm's length. In 8,192
poses of `synthetic.poses.sample_poses`, counting bends by more than 5 degrees, 52 of 6,706 bends of the MCP then have
the wrong sign, and none of 7,196 of the IP. With the knuckle itself as the target, these are 78 and 4."""
_SIDEWAYS = 0.5
"""From this cosine on, between the direction of a bend and the direction of flexion, the whole bend counts."""


def finger_angles(joints: ArrayLike, side: str) -> NDArray[np.float64]:
    """The ANGLES of hands (..., 20), in radians.

    Where a bone has no length, and so no direction, angles are 0.

    Args:
        joints: (..., 21, 3) joints of hand21, in any right-handed frame and any unit.
        side: 'left' or 'right'.

    Raises:
        InputError: the side is another one, or the joints have another shape.
    """
    points = np.asarray(joints, np.float64)
    if side not in ('left', 'right'):
        raise InputError(f"angles of the fingers of a hand whose side is '{side}': give left or right")
    if points.shape[-2:] != (len(HAND21), 3):
        raise InputError(f'angles of the fingers need the joints of hand21 as (..., 21, 3), not {points.shape}')
    if side == 'left':
        points = points * np.array([-1, 1, 1])  # any mirror makes it a right hand
    wrist, index, middle, ring = (points[..., _JOINT[name], :] for name in ('wrist', 'index_mcp', 'middle_mcp',
                                                                            'ring_mcp'))
    y = _unit(middle - wrist)
    z = _unit(np.cross(index - ring, y))
    palm = np.stack([np.cross(y, z), y, z], -2)
    # Directions of the three bones of each digit in the frame of the palm, (..., 5 digits, 3 bones, 3).
    digits = ((points - wrist[..., None, :]) @ palm.swapaxes(-1, -2))[..., 1:, :]
    digits = digits.reshape(*digits.shape[:-2], 5, 4, 3)
    bones = _unit(np.diff(digits, axis=-2))

    root = digits[..., 4, 0, :] - _BELOW * digits[..., 2, 0, :]  # of the little finger
    angles = _thumb(bones[..., 0, :, :], towards=root - digits[..., 0, 1, :])
    for i, finger in enumerate(FINGERS[1:], start=1):
        angles += _finger(bones[..., i, :, :], _ABDUCTING[finger])
    return np.stack(angles, -1)


def _thumb(bones: NDArray[np.float64], towards: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Angles of the thumb (..., 3 bones, 3). It flexes `towards` this direction in the frame of the palm."""
    metacarpal = bones[..., 0, :]
    bends = []
    for before, after in ((metacarpal, bones[..., 1, :]), (bones[..., 1, :], bones[..., 2, :])):
        across, flexion = (each - _dot(each, before)[..., None] * before for each in (after, towards))
        bend = np.arctan2(np.linalg.norm(across, axis=-1), _dot(before, after))
        bends.append(bend * np.clip(_dot(_unit(across), _unit(flexion)) / _SIDEWAYS, -1, 1))
    return [np.arctan2(-metacarpal[..., 0], metacarpal[..., 1]), np.arcsin(np.clip(metacarpal[..., 2], -1, 1)), *bends]


def _finger(bones: NDArray[np.float64], abducting: int) -> list[NDArray[np.float64]]:
    """Angles of a finger (..., 3 bones, 3): a saddle joint (flexion about x, then a turn about z), and two hinges."""
    first = bones[..., 0, :]
    flexion = np.arctan2(first[..., 2], first[..., 1])
    abduction = np.arcsin(np.clip(first[..., 0], -1, 1))
    # The hinges bend in this direction: the palmar side of the first bone, after its flexion.
    palmar = np.stack([np.zeros_like(flexion), -np.sin(flexion), np.cos(flexion)], -1)
    pip = np.arctan2(_dot(bones[..., 1, :], palmar), _dot(bones[..., 1, :], first))
    along = np.cos(pip)[..., None] * first + np.sin(pip)[..., None] * palmar
    palmar = np.cos(pip)[..., None] * palmar - np.sin(pip)[..., None] * first
    dip = np.arctan2(_dot(bones[..., 2, :], palmar), _dot(bones[..., 2, :], along))
    # A hinge cannot bend relative to a bone without direction.
    there = np.any(bones != 0, axis=-1)
    return [flexion, abducting * abduction, pip * there[..., 0], dip * there[..., :2].all(-1)]


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sum(a * b, axis=-1)


def _unit(vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
