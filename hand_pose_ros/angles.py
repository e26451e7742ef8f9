"""Angles of the finger joints from the positions of the hand21 joints, e.g. to drive a robot hand.

The palm gives the frame: y from the wrist to the knuckle of the middle finger, x from the knuckle of the ring finger
towards that of the index finger, z out of the palm. (The little finger's knuckle is left out: its metacarpal moves.)

Names as in anatomy; all 0 when a finger is straight and parallel to the middle metacarpal:

- `<finger>_mcp_flexion`: of the first bone towards the palm; negative is hyperextension.
- `<finger>_mcp_abduction`: of the first bone out of the sagittal plane, away from the middle finger; of the middle
  finger itself, towards the thumb. Fingers that lie side by side differ by a few degrees, as they converge.
- `<finger>_pip_flexion`, `<finger>_dip_flexion`: of the next two bones, each against the one before.
- `thumb_cmc_flexion`: of the thumb's metacarpal across the palm, in its plane; spread away from the hand is negative.
- `thumb_cmc_abduction`: of the thumb's metacarpal out of that plane (palmar abduction).
- `thumb_mcp_flexion`, `thumb_ip_flexion`: the whole bend of the joint, positive towards the root of the little finger,
  negative away from it. A bend that is nearly sideways, as of an MCP that is abducted, counts less the nearer it is to
  that, so that the angle passes through 0 and does not jump.

Rotation about the axis of a bone leaves no trace in the positions: it is not given.
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
"""Sign of x in the direction that abducts."""
_BELOW = 0.2
"""Of the palm's length: the thumb flexes towards what is so far below the little finger's knuckle. Of 8,192 poses of
`synthetic.poses.sample_poses` 52 of 6,706 bends of its MCP by more than 5 degrees have the wrong sign then, and none of
7,196 of its IP; towards the knuckle itself 78 and 4."""
_SIDEWAYS = 0.5
"""Cosine between the direction of a bend and that of flexion, from which the whole bend counts."""


def finger_angles(joints: ArrayLike, side: str) -> NDArray[np.float64]:
    """The ANGLES of hands (..., 20), in radians.

    Where bones have no length, and so no direction, angles are 0.

    Args:
        joints: (..., 21, 3) hand21, in any right-handed frame and any unit.
        side: 'left' or 'right'.

    Raises:
        InputError: another side, or another number of joints.
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
    """Angles of the thumb (..., 3 bones, 3); flexion is `towards`, a direction in the frame of the palm."""
    metacarpal = bones[..., 0, :]
    bends = []
    for before, after in ((metacarpal, bones[..., 1, :]), (bones[..., 1, :], bones[..., 2, :])):
        across, flexion = (each - _dot(each, before)[..., None] * before for each in (after, towards))
        bend = np.arctan2(np.linalg.norm(across, axis=-1), _dot(before, after))
        bends.append(bend * np.clip(_dot(_unit(across), _unit(flexion)) / _SIDEWAYS, -1, 1))
    return [np.arctan2(-metacarpal[..., 0], metacarpal[..., 1]), np.arcsin(np.clip(metacarpal[..., 2], -1, 1)), *bends]


def _finger(bones: NDArray[np.float64], abducting: int) -> list[NDArray[np.float64]]:
    """Angles of a finger (..., 3 bones, 3): a saddle joint that flexes about x and then turns about z, two hinges."""
    first = bones[..., 0, :]
    flexion = np.arctan2(first[..., 2], first[..., 1])
    abduction = np.arcsin(np.clip(first[..., 0], -1, 1))
    # What the hinges bend towards: the direction that flexion gives the palmar side of the first bone.
    palmar = np.stack([np.zeros_like(flexion), -np.sin(flexion), np.cos(flexion)], -1)
    pip = np.arctan2(_dot(bones[..., 1, :], palmar), _dot(bones[..., 1, :], first))
    along = np.cos(pip)[..., None] * first + np.sin(pip)[..., None] * palmar
    palmar = np.cos(pip)[..., None] * palmar - np.sin(pip)[..., None] * first
    dip = np.arctan2(_dot(bones[..., 2, :], palmar), _dot(bones[..., 2, :], along))
    # A hinge behind a bone that has no direction does not bend against it.
    there = np.any(bones != 0, axis=-1)
    return [flexion, abducting * abduction, pip * there[..., 0], dip * there[..., :2].all(-1)]


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sum(a * b, axis=-1)


def _unit(vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
