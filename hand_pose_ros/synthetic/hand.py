"""A right hand with a forearm: shape and pose in, skin and joints out. `kinematics` tells its frame and angles."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from hand_pose_ros.synthetic import surface
from hand_pose_ros.synthetic.kinematics import INDEX, POSE, bone_sizes, forward
from hand_pose_ros.synthetic.shapes import Shape, mean_shape


def rest_pose() -> Tensor:
    """The pose (P,) in which the surface is modelled, in radians: fingers apart and straight, thumb half-way out."""
    pose = torch.zeros(len(POSE))
    for name, degrees in (('index_mcp_abduction', 13), ('ring_mcp_abduction', 12), ('pinky_mcp_abduction', 22),
                          ('thumb_cmc_radial', 42), ('thumb_cmc_palmar', 28), ('thumb_cmc_roll', 70)):
        pose[INDEX[name]] = np.deg2rad(degrees)
    return pose


@lru_cache(maxsize=1)
def _template() -> tuple[Tensor, ...]:
    shape = mean_shape()
    rotations, origins, _ = forward(shape, rest_pose()[None], rest_pose())
    number = lambda t: t[0].double().numpy()  # noqa: E731
    rest = surface.RestHand(number(rotations), number(origins), number(shape.segments), number(shape.radii),
                            float(shape.hand_breadth), float(shape.hand_length), float(shape.palm_depth),
                            number(shape.wrist), number(shape.forearm))
    vertices, faces, weights, part = surface.build(rest)
    return (torch.from_numpy(vertices).float(), torch.from_numpy(faces), torch.from_numpy(weights).float(),
            torch.from_numpy(part), rotations[0], origins[0], bone_sizes(shape)[0], rest_pose())


class SkinnedHand(nn.Module):
    """Skin and joints of right hands: linear blend skinning over the bones of `kinematics.BONES`.

    Attributes:
        faces: (F, 3) int64 vertices of each triangle, counter-clockwise seen from outside.
        vertex_part: (V,) int64, 0-4 thumb to little finger, 5 palm, 6 forearm.

    Args:
        vertices: (V, 3) skin at rest, in metres in the hand frame.
        faces: see above.
        weights: (V, K) share of each bone in each vertex, rows adding to 1.
        part: (V,) see `vertex_part`.
        rotations, origins, sizes: (K, 3, 3), (K, 3), (K, 3) of the bones at rest (`kinematics.forward`, `bone_sizes`).
        rest: (P,) pose at rest, from which the joints between bones turn half-way.
    """

    faces: Tensor
    vertex_part: Tensor
    rest: Tensor
    _to_bone: Tensor
    _origins: Tensor
    _basis: Tensor

    def __init__(self, vertices: Tensor, faces: Tensor, weights: Tensor, part: Tensor, rotations: Tensor,
                 origins: Tensor, sizes: Tensor, rest: Tensor) -> None:
        super().__init__()
        self.register_buffer('faces', faces.clone())
        self.register_buffer('vertex_part', part.clone())
        self.register_buffer('rest', rest.clone())
        self.register_buffer('_to_bone', rotations.mT / sizes[..., None])  # rest position -> bone, in bone sizes
        self.register_buffer('_origins', origins.clone())
        ones = torch.cat([vertices, torch.ones(len(vertices), 1)], 1)
        # (4K, V): weight times homogeneous position, so that skinning is one matrix product.
        self.register_buffer('_basis', (weights[:, :, None] * ones[:, None]).reshape(len(vertices), -1).T.contiguous())

    def forward(self, shape: Shape, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Shape of B hands and pose (B, P) in radians -> skin (B, V, 3) and joints hand21 (B, 21, 3), in metres."""
        rotations, origins, joints = forward(shape, pose, self.rest)
        linear = (rotations * bone_sizes(shape)[:, :, None]) @ self._to_bone  # (B, K, 3, 3)
        shift = origins - (linear @ self._origins[..., None])[..., 0]
        transforms = torch.cat([linear, shift[..., None]], -1).transpose(1, 2).reshape(3 * len(pose), -1)  # (3B, 4K)
        # Padded to a multiple of 8 hands. A hand must not depend on the batch it is in, but a product of few rows is
        # summed in another order than one of many.
        padded = nn.functional.pad(transforms, (0, 0, 0, -len(transforms) % 24))
        skin = (padded @ self._basis)[:len(transforms)].reshape(len(pose), 3, -1)
        return skin.transpose(1, 2).contiguous(), joints


class HandModel(SkinnedHand):
    """The parametric hand: one closed skin with a forearm, which turns about the wrist while the hand stays."""

    def __init__(self) -> None:
        super().__init__(*_template())
