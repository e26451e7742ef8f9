"""The bones of the hand: names of the angles, and where they carry each bone.

The hand frame is that of a right hand, in metres. Its origin is in the wrist, +y runs along the metacarpal of the
middle finger towards the fingers, +x points towards the thumb, and +z is x cross y. So +z comes out of the *palm*, and
flexion moves the fingers towards +z. Seen from the palm with the fingers up, the thumb is on the right.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hand_pose_ros.skeleton import FINGERS
from hand_pose_ros.synthetic.shapes import Shape

POSE = (
    'wrist_flexion', 'wrist_deviation', 'ring_cmc_flexion', 'pinky_cmc_flexion',
    'thumb_cmc_radial', 'thumb_cmc_palmar', 'thumb_cmc_roll',
    'thumb_mcp_flexion', 'thumb_mcp_abduction', 'thumb_ip_flexion',
    *(f'{finger}_{angle}' for finger in FINGERS[1:]
      for angle in ('mcp_flexion', 'mcp_abduction', 'pip_flexion', 'dip_flexion')))
"""Names of the P = 26 angles of a pose (B, P), in radians.

- Flexion is positive towards the palm.
- Deviation of the wrist is positive towards the thumb.
- Abduction of a finger is positive away from the middle finger. That of the middle finger is positive towards the
  thumb, and that of the thumb away from the index finger.
- The metacarpal of the thumb leaves the direction of the fingers by `radial` within the plane of the palm, and by
  `palmar` out of it. `roll` turns the pad of the thumb from facing as the palm does (0) to facing the little finger
  (pi/2).
"""

INDEX = {name: i for i, name in enumerate(POSE)}

BONES = ('forearm', 'wrist', 'carpus', *(f'{f}_metacarpal' for f in FINGERS[1:]),
         *(f'{f}_{b}' for f in FINGERS for b in ('joint1', 'bone1', 'joint2', 'bone2', 'joint3', 'bone3')))
"""Names of the K = 37 frames that carry the skin. A 'joint' (and the wrist) turns half-way between its neighbours."""

DIGIT = tuple(BONES.index(f'{finger}_joint1') for finger in FINGERS)
METACARPAL = (BONES.index('carpus'), *(BONES.index(f'{finger}_metacarpal') for finger in FINGERS[1:]))
"""For each digit, thumb to little finger, DIGIT is the first of its six frames and METACARPAL the frame it hangs on."""

_RADIAL = (-1.0, -1.0, 1.0, 1.0)  # sign of the rotation about +z that abducts index, middle, ring and little finger
_CMC_X, _CMC_Y = (0.50, 1.0, 0.63, 0.56), (0.165, 0.165, 0.175, 0.19)  # x and y of the CMC over those of the MCP
_SPLAY = (-1.5, 0.0, 2.5, 6.0)   # directions of the fingers at abduction 0, in degrees about +z ...
_LEAN = (-5.0, 0.0, 4.0, 9.0)   # ... and about +y, positive towards the thumb, so that the fingers of a fist converge


def _axis_rotation(axis: int, angle: Tensor) -> Tensor:
    """Rotations (..., 3, 3) by angle (...) about coordinate axis 0, 1 or 2."""
    c, s, zero, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    rows = {0: (one, zero, zero, zero, c, -s, zero, s, c),
            1: (c, zero, s, zero, one, zero, -s, zero, c),
            2: (c, -s, zero, s, c, zero, zero, zero, one)}[axis]
    return torch.stack(rows, -1).reshape(*angle.shape, 3, 3)


def _wrist_rotation(pose: Tensor) -> Tensor:
    """Rotations (B, 3, 3) of the forearm. The hand stays."""
    return _axis_rotation(0, -pose[:, INDEX['wrist_flexion']]) @ _axis_rotation(2, pose[:, INDEX['wrist_deviation']])


def _joint_rotations(pose: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Rotations of the CMC of the four fingers (B, 4, 3, 3), and of the three joints of each digit, (B, 5, 3, 3) each.

    Of the CMC, only those of ring and little finger turn.
    """
    angle = {name: pose[:, i] for name, i in INDEX.items()}
    still = torch.zeros_like(pose[:, 0])
    cmc = _axis_rotation(0, torch.stack([still, still, angle['ring_cmc_flexion'], angle['pinky_cmc_flexion']], -1))

    fingers = pose[:, 10:].reshape(-1, 4, 4)
    abduct = fingers[..., 1] * fingers.new_tensor(_RADIAL)
    finger1 = _axis_rotation(0, fingers[..., 0]) @ _axis_rotation(2, abduct)
    thumb1 = (_axis_rotation(2, -angle['thumb_cmc_radial']) @ _axis_rotation(0, angle['thumb_cmc_palmar'])
              @ _axis_rotation(1, -angle['thumb_cmc_roll']))
    thumb2 = _axis_rotation(0, angle['thumb_mcp_flexion']) @ _axis_rotation(2, -angle['thumb_mcp_abduction'])
    thumb3 = _axis_rotation(0, angle['thumb_ip_flexion'])
    digits = [torch.cat([thumb[:, None], finger], 1) for thumb, finger in (
        (thumb1, finger1), (thumb2, _axis_rotation(0, fingers[..., 2])), (thumb3, _axis_rotation(0, fingers[..., 3])))]
    return cmc, digits


def metacarpal_bases(shape: Shape) -> Tensor:
    """The carpometacarpal joints (B, 4, 3) of index to little finger."""
    roots = shape.roots[:, 1:]
    x, y = roots.new_tensor(_CMC_X), roots.new_tensor(_CMC_Y)
    return torch.stack([roots[..., 0] * x, roots[..., 1] * y, roots[..., 2] * 0.3], -1)


def place_bones(shape: Shape, pose: Tensor) -> tuple[Tensor, Tensor, list[Tensor], Tensor]:
    """Where pose (B, P) carries the bones of B hands (or of one, for all).

    Returns:
        Four things:

        - rotations of the metacarpals of index to little finger (B, 4, 3, 3)
        - origins of these metacarpals (B, 4, 3)
        - four rotations (B, 5, 3, 3), of what the digits hang on and of their three bones
        - joints of the digits (B, 5, 4, 3), tips last
    """
    batch = len(pose)
    cmc, turns = _joint_rotations(pose)
    degrees = torch.pi / 180
    base = _axis_rotation(2, pose.new_tensor(_SPLAY) * degrees) @ _axis_rotation(1, pose.new_tensor(_LEAN) * degrees)
    roots, bases = shape.roots.expand(batch, 5, 3), metacarpal_bases(shape).expand(batch, 4, 3)
    along = roots[:, 1:] - bases
    # Metacarpal frames: y from CMC to MCP, so that they can be stretched along the bone.
    yaw, pitch = torch.atan2(-along[..., 0], along[..., 1]), torch.atan2(along[..., 2], along[..., :2].norm(dim=-1))
    metacarpal = cmc @ _axis_rotation(2, yaw) @ _axis_rotation(0, pitch)

    point = torch.cat([roots[:, :1], bases + (cmc @ along[..., None])[..., 0]], 1)
    rotations = [torch.cat([torch.eye(3, device=pose.device).expand(batch, 1, 3, 3), cmc @ base], 1)]
    points = [point]
    for i, turn in enumerate(turns):
        rotations.append(rotations[-1] @ turn)
        point = point + rotations[-1][..., 1] * shape.segments[..., i:i + 1]
        points.append(point)
    return metacarpal, bases, rotations, torch.stack(points, 2)


def forward(shape: Shape, pose: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The frames that carry the skin, and the joints.

    Args:
        shape: B hands (or one for all).
        pose: (B, P) radians.
        rest: (P,) the pose from which the 'joint' frames turn half-way.

    Returns:
        Three things:

        - rotations (B, K, 3, 3) from the frame of each of the `BONES` (y along the bone, z palmar) to the hand frame
        - origins of these frames (B, K, 3) in metres
        - joints (B, 21, 3) in the order of hand21, in metres
    """
    batch = len(pose)
    metacarpal, bases, bones, digits = place_bones(shape, pose)
    half = (pose + rest) / 2
    wrist, half_wrist = _wrist_rotation(pose), _wrist_rotation(half)
    zero = torch.zeros(batch, 1, 3, device=pose.device)
    middle = [parent @ turn for parent, turn in zip(bones, _joint_rotations(half)[1], strict=False)]
    both = [rotation for pair in zip(middle, bones[1:], strict=True) for rotation in pair]
    carpus = torch.eye(3, device=pose.device).expand(batch, 1, 3, 3)
    rotations = [wrist[:, None], half_wrist[:, None], carpus, metacarpal,
                 torch.stack(both, 2).reshape(batch, 30, 3, 3)]
    origins = [zero, zero, zero, bases, digits[:, :, :3].repeat_interleave(2, 2).reshape(batch, 30, 3)]
    return torch.cat(rotations, 1), torch.cat(origins, 1), torch.cat([zero, digits.reshape(batch, 20, 3)], 1)


def bone_sizes(shape: Shape) -> Tensor:
    """Width, length and depth (B, K, 3) of each bone with its flesh, in metres. The skin scales with them."""
    batch = len(shape)
    carpus = torch.stack([shape.hand_breadth / 2, shape.roots[:, 2, 1], shape.palm_depth], -1)
    forearm = torch.stack([shape.forearm[:, 1], shape.forearm[:, 0], shape.forearm[:, 1]], -1)
    wrist = torch.stack([shape.wrist[:, 0], (carpus[:, 1] * forearm[:, 1]).sqrt(), shape.wrist[:, 1]], -1)
    length = (shape.roots[:, 1:] - metacarpal_bases(shape)).norm(dim=-1)
    metacarpals = torch.stack([(shape.hand_breadth / 2)[:, None].expand(-1, 4), length,
                               shape.palm_depth[:, None].expand(-1, 4)], -1)
    bones = torch.stack([shape.radii, shape.segments, shape.radii], -1)  # (B, 5, 3 bones, 3 axes)
    first = torch.cat([carpus[:, None], metacarpals], 1)[:, :, None]
    joints = (torch.cat([first, bones[:, :, :2]], 2) * bones).sqrt()
    digits = torch.stack([joints, bones], 3).reshape(batch, 30, 3)
    return torch.cat([forearm[:, None], wrist[:, None], carpus[:, None], metacarpals, digits], 1)
