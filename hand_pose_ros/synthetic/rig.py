"""A second, independent surface: any skinned hand in a binary glTF file whose joints carry the WebXR names."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hand_pose_ros.errors import InputError
from hand_pose_ros.skeleton import FINGERS
from hand_pose_ros.synthetic.hand import SkinnedHand
from hand_pose_ros.synthetic.kinematics import BONES, POSE, bone_sizes, metacarpal_bases
from hand_pose_ros.synthetic.shapes import FINGER_END, Shape, make_shape

_TYPES = {5121: '<u1', 5123: '<u2', 5125: '<u4', 5126: '<f4'}
_WIDTHS = {'SCALAR': 1, 'VEC2': 2, 'VEC3': 3, 'VEC4': 4, 'MAT4': 16}
_CHAINS = {finger: (['thumb-metacarpal', 'thumb-phalanx-proximal', 'thumb-phalanx-distal', 'thumb-tip'] if finger == 'thumb'
                    else [f'{finger}-finger-phalanx-{part}' for part in ('proximal', 'intermediate', 'distal')]
                    + [f'{finger}-finger-tip']) for finger in FINGERS}
"""WebXR joints that begin the three bones of each digit, and its tip."""


class _Glb:
    """The parts of a binary glTF 2.0 file that a skinned mesh needs."""

    def __init__(self, path: Path) -> None:
        try:
            data = path.read_bytes()
            magic, version, _, size, kind = struct.unpack_from('<4sIII4s', data)
            if magic != b'glTF' or version != 2 or kind != b'JSON':
                raise ValueError('it is not a binary glTF 2.0 file')
            self.json: dict[str, Any] = json.loads(data[20:20 + size])
            self._blob = data[28 + size:]
            if not self.json.get('skins'):
                raise ValueError('it has no skin (bones with weights)')
        except (OSError, ValueError, struct.error) as error:
            raise InputError(f'cannot use {path} as a hand rig: {error}; give a .glb of a skinned hand') from error

    def array(self, index: int) -> NDArray[Any]:
        """The numbers of an accessor, (N, width)."""
        accessor = self.json['accessors'][index]
        view = self.json['bufferViews'][accessor['bufferView']]
        dtype, width = np.dtype(_TYPES[accessor['componentType']]), _WIDTHS[accessor['type']]
        start = view.get('byteOffset', 0) + accessor.get('byteOffset', 0)
        stride = view.get('byteStride', dtype.itemsize * width)
        return np.ndarray((accessor['count'], width), dtype, self._blob, start, (stride, dtype.itemsize)).copy()


def _read(path: Path) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[Any], dict[str, NDArray[Any]]]:
    """Vertices (V, 3), faces (F, 3), weights (V, joints), and the rest transform (4, 4) of each joint by name, in order."""
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
        raise InputError(f'cannot use {path} as a hand rig: part {error} is missing or damaged in it') from error
    # Vertices are doubled along the seams of the texture: join them, so that the skin is closed.
    _, kept, index = np.unique(np.concatenate(points).round(7), axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[np.concatenate(triangles)]
    faces = faces[(faces != np.roll(faces, 1, 1)).all(1)]
    return np.concatenate(points)[kept], faces, np.concatenate(shares)[kept], dict(zip(names, bind, strict=True))


class Rig(SkinnedHand):
    """A hand from a glTF file, driven by the same shapes and poses as `HandModel`; it has no forearm of its own.

    The bones are scaled to the measures of the shape that is asked for (`shape` holds the measures of the rig itself).
    Joints are the origins of the rig's bones, scaled likewise, but for the tips: those of WebXR lie at no fixed depth,
    so ours are put one fingertip radius inside the end of the skin, as hand21 wants them. A left hand is mirrored.

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
        wanted = ['wrist', *(name for chain in _CHAINS.values() for name in chain)]
        missing = [name for name in wanted if name not in joints]
        if missing:
            raise InputError(f'{path} lacks the WebXR hand joints {", ".join(missing)}: rename the bones of the rig')

        place = {name: matrix[:3, 3] for name, matrix in joints.items()}
        first = {finger: place[chain[0]] for finger, chain in _CHAINS.items()}
        along = first['middle'] - place['wrist']
        across = first['index'] - first['pinky']
        y = along / np.linalg.norm(along)
        x = across - (across @ y) * y
        x /= np.linalg.norm(x)
        frame = np.stack([x, y, np.cross(x, y)])
        if -joints['wrist'][:3, 1] @ frame[2] < 0:  # the palm lies on the other side: a left hand
            frame[2] *= -1
            faces = faces[:, ::-1]
        points = (vertices - place['wrist']) @ frame.T
        heads = np.array([[(place[name] - place['wrist']) @ frame.T for name in chain] for chain in _CHAINS.values()])

        # Bones of ours that carry what each joint of the rig carries, and their axes: x, y along the bone, z palmar.
        rotations, shares = np.tile(np.eye(3), (len(BONES), 1, 1)), np.zeros((len(points), len(BONES)))
        owner = {name: BONES.index(f'{finger}_bone{min(i, 2) + 1}')
                 for finger, chain in _CHAINS.items() for i, name in enumerate(chain)}
        owner |= {f'{finger}-finger-metacarpal': BONES.index(f'{finger}_metacarpal') for finger in FINGERS[1:]}
        for column, name in enumerate(joints):
            bone = owner.get(name, BONES.index('carpus'))
            shares[:, bone] += weights[:, column]
            if name in owner and not name.endswith('-tip'):
                axes = frame @ joints[name][:3, :3]
                axes /= np.linalg.norm(axes, axis=0)
                rotations[bone] = np.stack([np.cross(-axes[:, 2], -axes[:, 1]), -axes[:, 2], -axes[:, 1]], 1)

        radii, lengths, ends = np.zeros((5, 3)), np.linalg.norm(np.diff(heads, axis=1), axis=2), np.zeros(5)
        for digit, finger in enumerate(FINGERS):
            for i in range(3):
                bone = BONES.index(f'{finger}_bone{i + 1}')
                if rotations[bone][:, 1] @ (heads[digit, i + 1] - heads[digit, i]) < 0.8 * lengths[digit, i]:
                    raise InputError(f'{path}: the axes of {_CHAINS[finger][i]} are not those of WebXR, whose -z runs along '
                                     'the bone; export the rig with the orientation of WebXR')
                own = (points[shares[:, bone] > 0.5] - heads[digit, i]) @ rotations[bone]
                beside = own[(own[:, 1] > 0) & (own[:, 1] < lengths[digit, i])]
                radii[digit, i] = np.median(np.hypot(beside[:, 0], beside[:, 2]))
                ends[digit] = own[:, 1].max()
        segments = lengths.copy()
        segments[:, 2] = ends - FINGER_END * radii[:, 2]

        length = float(points[shares[:, BONES.index('middle_bone3')] > 0.5, 1].max())
        knuckles = points[np.abs(points[:, 1] - 0.9 * heads[2, 0, 1]) < 0.1 * heads[2, 0, 1]]
        knuckles = knuckles[knuckles[:, 0] < heads[1, 0, 0] + 0.02]  # without the thumb
        number = lambda array: torch.tensor(np.asarray(array), dtype=torch.float32)[None]  # noqa: E731
        self_shape = replace(make_shape(number(length), number(np.ptp(knuckles[:, 0]))),
                             roots=number(heads[:, 0]), segments=number(segments), radii=number(radii))

        origins = np.zeros((len(BONES), 3))
        origins[3:7] = metacarpal_bases(self_shape)[0].numpy()
        for digit, finger in enumerate(FINGERS):
            for i in range(3):
                origins[BONES.index(f'{finger}_bone{i + 1}')] = heads[digit, i]
            if digit:
                toward = heads[digit, 0] - origins[2 + digit]
                rotations[2 + digit] = _axes_along(toward, rotations[2 + digit])
        part = np.full(len(points), 5)
        for digit in range(5):
            part[shares[:, 7 + 6 * digit + (2 if digit == 0 else 0):13 + 6 * digit].sum(1) > 0.5] = digit

        super().__init__(number(points)[0], torch.from_numpy(faces.copy()), number(shares)[0], torch.from_numpy(part),
                         number(rotations)[0], number(origins)[0], bone_sizes(self_shape)[0], torch.zeros(len(POSE)))
        self.shape = self_shape


def _axes_along(direction: NDArray[Any], axes: NDArray[Any]) -> NDArray[Any]:
    """The frame nearest to `axes` (3, 3) whose y runs along `direction` (3,)."""
    y = direction / np.linalg.norm(direction)
    x = axes[:, 0] - (axes[:, 0] @ y) * y
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], 1)
