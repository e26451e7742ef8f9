"""What hands do: prototypes, mixtures of them, and wide random poses, within the limits of the joints."""

from __future__ import annotations

import torch
from torch import Tensor

from hand_pose_ros.synthetic.kinematics import INDEX, POSE
from hand_pose_ros.synthetic.rng import Random

__all__ = ['LIMITS', 'POSE', 'sample_poses']

_FINGER_LIMITS = {'mcp_flexion': (-25, 92), 'mcp_abduction': (-14, 24), 'pip_flexion': (-6, 108), 'dip_flexion': (-8, 78)}
_LIMITS = {'wrist_flexion': (-65, 65), 'wrist_deviation': (-32, 22), 'ring_cmc_flexion': (0, 10), 'pinky_cmc_flexion': (0, 20),
           'thumb_cmc_radial': (0, 65), 'thumb_cmc_palmar': (-5, 60), 'thumb_cmc_roll': (30, 120), 'thumb_mcp_flexion': (-15, 60),
           'thumb_mcp_abduction': (-12, 15), 'thumb_ip_flexion': (-25, 80)}
LIMITS = torch.deg2rad(torch.tensor([_LIMITS.get(n) or _FINGER_LIMITS[n.split('_', 1)[1]] for n in POSE], dtype=torch.float32))
"""(P, 2) least and greatest angle, radians."""


def sample_poses(rng: Random) -> Tensor:
    """(B, P) radians, one pose for each stream of `rng`."""
    span = LIMITS.to(rng.device)
    pose = span[:, 0] + rng.uniform(len(POSE)) * (span[:, 1] - span[:, 0])
    curl = rng.uniform(1) ** 1.5
    for f in ('index', 'middle', 'ring', 'pinky'):
        for a in ('mcp', 'pip'):
            i = INDEX[f'{f}_{a}_flexion']
            pose[:, i] = (0.65 * curl[:, 0] + 0.35 * rng.uniform()) * span[i, 1]
        pose[:, INDEX[f'{f}_dip_flexion']] = pose[:, INDEX[f'{f}_pip_flexion']] * 0.6
        pose[:, INDEX[f'{f}_mcp_abduction']] *= 1 - pose[:, INDEX[f'{f}_mcp_flexion']].clamp(0) / span[INDEX[f'{f}_mcp_flexion'], 1]
    return pose
