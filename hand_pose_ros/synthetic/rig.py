"""A second, independent surface: any skinned hand in a binary glTF file whose joints carry the WebXR names."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hand_pose_ros.errors import InputError
from hand_pose_ros.skeleton import FINGERS
from hand_pose_ros.synthetic.hand import SkinnedHand
from hand_pose_ros.synthetic.kinematics import BONES, DIGIT, METACARPAL, POSE, bone_sizes, metacarpal_bases
from hand_pose_ros.synthetic.shapes import FINGER_END, Shape, make_shape

Array = NDArray[Any]

_TYPES = {5121: '<u1', 5123: '<u2', 5125: '<u4', 5126: '<f4'}
_WIDTHS = {'SCALAR': 1, 'VEC2': 2, 'VEC3': 3, 'VEC4': 4, 'MAT4': 16}
_CHAINS = {'thumb': [f'thumb-{part}' for part in ('metacarpal', 'phalanx-proximal', 'phalanx-distal', 'tip')],
           **{finger: [*(f'{finger}-finger-phalanx-{part}' for part in ('proximal', 'intermediate', 'distal')),
                       f'{finger}-finger-tip'] for finger in FINGERS[1:]}}
"""WebXR joints that begin the three bones of each digit, and its tip."""


class _Glb:
    """The parts of a binary glTF 2.0 file that a skinned mesh needs."""

    def __init__(self, path: Path) -> None:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(f'{path}: the file cannot be read ({error.strerror}): check the path') from None
        try:
            magic, version, _, size, kind = struct.unpack_from('<4sIII4s', data)
            if magic != b'glTF' or version != 2 or kind != b'JSON':
                raise ValueError('it is not a binary glTF 2.0 file')
            self.json: dict[str, Any] = json.loads(data[20:20 + size])
            self._blob = data[28 + size:]
            if not self.json.get('skins'):
                raise ValueError('it has no skin (bones with weights)')
        except (ValueError, struct.error) as error:
            raise InputError(f'cannot use {path} as a hand rig: {error}; give a .glb of a skinned hand') from error

    def array(self, index: int) -> Array:
        """The numbers of an accessor, (N, width)."""
        accessor = self.json['accessors'][index]
        view = self.json['bufferViews'][accessor['bufferView']]
        dtype, width = np.dtype(_TYPES[accessor['componentType']]), _WIDTHS[accessor['type']]
        start = view.get('byteOffset', 0) + accessor.get('byteOffset', 0)
        stride = view.get('byteStride', dtype.itemsize * width)
        return np.ndarray((accessor['count'], width), dtype, self._blob, start, (stride, dtype.itemsize)).copy()


def _read(path: Path) -> tuple[Array, NDArray[np.int64], Array, dict[str, Array]]:
    """Vertices (V, 3), faces (F, 3), weights (V, joints), and the rest transform (4, 4) of each joint, in order."""
    glb = _Glb(path)
    try:
        skin = glb.json['skins'][0]
        names = [glb.json['nodes'][node]['name'] for node in skin['joints']]
        bind = np.linalg.inv(glb.array(skin['inverseBindMatrices']).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float))
        mesh = next(glb.json['meshes'][node['mesh']] for node in glb.json['nodes'] if node.get('skin') == 0)
        points, triangles, shares, first = [], [], [], 0
        for primitive in mesh['primitives']:
            attributes = primitive['attributes']
            points.append(glb.array(attributes['POSITION']).astype(float))
            triangles.append(glb.array(primitive['indices']).astype(np.int64).reshape(-1, 3) + first)
            share = np.zeros((len(points[-1]), len(names)))
            amount = glb.array(attributes['WEIGHTS_0']).astype(float)
            np.add.at(share, (np.arange(len(share))[:, None], glb.array(attributes['JOINTS_0']).astype(int)), amount)
            shares.append(share / share.sum(1, keepdims=True))
            first += len(points[-1])
    except (KeyError, IndexError, TypeError, ValueError, StopIteration) as error:
        raise InputError(f'cannot use {path} as a hand rig: a part of it is missing or damaged '
                         f'({error!r}); give a .glb of a skinned hand') from error
    # Vertices are doubled along the seams of the texture. They are joined, so that the skin is closed.
    _, kept, index = np.unique(np.concatenate(points).round(7), axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[np.concatenate(triangles)]
    faces = faces[(faces != np.roll(faces, 1, 1)).all(1)]
    return np.concatenate(points)[kept], faces, np.concatenate(shares)[kept], dict(zip(names, bind, strict=True))


def _turned(path: Path, vertices: Array, faces: Array,
            joints: dict[str, Array]) -> tuple[Array, Array, dict[str, Array]]:
    """Vertices, faces and joints as those of a right hand in the hand frame, with the axes of `kinematics`."""
    missing = [name for name in ('wrist', *chain.from_iterable(_CHAINS.values())) if name not in joints]
    if missing:
        raise InputError(f'{path} lacks the WebXR hand joints {", ".join(missing)}: rename the bones of the rig')
    wrist, index, middle, pinky = (
        joints[name][:3, 3] for name in ('wrist', *(_CHAINS[finger][0] for finger in ('index', 'middle', 'pinky'))))
    frame = _axes_along(middle - wrist, index - pinky).T
    if -joints['wrist'][:3, 1] @ frame[2] < 0:  # the palm lies on the other side, so this is a left hand
        frame[2] *= -1
        faces = faces[:, ::-1]
    turned = {}
    for name, matrix in joints.items():
        axes = frame @ matrix[:3, :3]
        axes = axes / np.linalg.norm(axes, axis=0)
        along, palmar = -axes[:, 2], -axes[:, 1]
        turned[name] = np.column_stack([np.cross(along, palmar), along, palmar, frame @ (matrix[:3, 3] - wrist)])
    return (vertices - wrist) @ frame.T, faces, turned


def _axes_along(direction: Array, across: Array) -> Array:
    """The frame (3, 3), columns x y z, whose y runs along `direction` (3,) and whose x is nearest to `across` (3,)."""
    y = direction / np.linalg.norm(direction)
    x = across - (across @ y) * y
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], 1)


def _measure(path: Path, points: Array, shares: Array, heads: Array, rotations: Array) -> Shape:
    """The measures of the rig at rest, from its joints (5, 4, 3), and from its skin where the joints do not tell."""
    radii, ends, lengths = np.zeros((5, 3)), np.zeros(5), np.linalg.norm(np.diff(heads, axis=1), axis=2)
    for digit in range(5):
        for i in range(3):
            bone = DIGIT[digit] + 2 * i + 1
            own = (points[shares[:, bone] > 0.5] - heads[digit, i]) @ rotations[bone]
            beside = own[(own[:, 1] > 0) & (own[:, 1] < lengths[digit, i])]
            straight = rotations[bone][:, 1] @ (heads[digit, i + 1] - heads[digit, i]) > 0.8 * lengths[digit, i]
            if not straight or not len(beside):
                raise InputError(f'{path}: {_CHAINS[FINGERS[digit]][i]} does not carry skin along its -z axis, as '
                                 'bones of WebXR do; export the rig with the orientation of WebXR')
            radii[digit, i], ends[digit] = np.median(np.hypot(beside[:, 0], beside[:, 2])), own[:, 1].max()
    lengths[:, 2] = ends - FINGER_END * radii[:, 2]

    knuckles = points[np.abs(points[:, 1] - 0.9 * heads[2, 0, 1]) < 0.1 * heads[2, 0, 1], 0]
    breadth = np.ptp(knuckles[knuckles < heads[1, 0, 0] + 0.02])  # without the thumb
    measured = make_shape(_tensor(points[shares[:, DIGIT[2] + 5] > 0.5, 1].max())[None], _tensor(breadth)[None])
    return replace(measured, roots=_tensor(heads[:, 0])[None], segments=_tensor(lengths)[None],
                   radii=_tensor(radii)[None])


def _tensor(array: Any) -> torch.Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32)


class Rig(SkinnedHand):
    """A hand from a glTF file, driven by the same shapes and poses as `HandModel`. It has no forearm of its own.

    The bones are scaled to the measures of the shape that is asked for (`shape` holds the measures of the rig itself).
    The joints are the origins of the bones of the rig, scaled likewise, except for the tips. The tips of WebXR lie at
    no fixed depth, so ours are put one fingertip radius inside the end of the skin, as hand21 wants them. A left hand
    is mirrored.

    Args:
        path: a .glb file with one skin whose joints have the names and the axes of WebXR (-z along the bone, -y out of
            the palm), in metres.

    Raises:
        InputError: the file cannot be read, or is no such hand.
    """

    shape: Shape

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        vertices, faces, weights, joints = _read(path)
        points, faces, joints = _turned(path, vertices, faces, joints)
        heads = np.array([[joints[name][:, 3] for name in names] for names in _CHAINS.values()])

        # Which of our bones carries the skin of each joint of the rig, and the axes of these bones.
        owner = {name: DIGIT[digit] + 2 * min(i, 2) + 1
                 for digit, names in enumerate(_CHAINS.values()) for i, name in enumerate(names)}
        owner |= {f'{finger}-finger-metacarpal': METACARPAL[digit] for digit, finger in enumerate(FINGERS) if digit}
        rotations, origins = np.tile(np.eye(3), (len(BONES), 1, 1)), np.zeros((len(BONES), 3))
        shares = np.zeros((len(points), len(BONES)))
        for column, name in enumerate(joints):
            shares[:, owner.get(name, METACARPAL[0])] += weights[:, column]
            if name in owner and not name.endswith('-tip'):
                rotations[owner[name]], origins[owner[name]] = joints[name][:, :3], joints[name][:, 3]

        shape = _measure(path, points, shares, heads, rotations)
        for digit, base in enumerate(metacarpal_bases(shape)[0].numpy(), start=1):
            bone = METACARPAL[digit]
            rotations[bone], origins[bone] = _axes_along(heads[digit, 0] - base, rotations[bone][:, 0]), base
        part = np.full(len(points), 5)
        for digit in range(5):
            part[shares[:, DIGIT[digit] + (2 if digit == 0 else 0):DIGIT[digit] + 6].sum(1) > 0.5] = digit
        super().__init__(_tensor(points), torch.from_numpy(faces.copy()), _tensor(shares), torch.from_numpy(part),
                         _tensor(rotations), _tensor(origins), bone_sizes(shape)[0], torch.zeros(len(POSE)))
        self.shape = shape
