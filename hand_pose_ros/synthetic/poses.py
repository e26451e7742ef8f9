"""The poses of hands: gestures, mixtures of two, and wide random poses, all within the limits of the joints.

Limits and couplings are those of the biomechanics literature (Sancho-Bru, clinical ranges). How differently the
four fingers bend was set to agree with statistics of the pose bank of Intel's hand_tracking_samples (Apache-2.0). Only
means, correlations and percentiles were used, and no pose. There, wrists are bent back by 15 degrees on average.
Neighbouring fingers bend with a correlation of 0.85 to 0.95, and index and little finger with one of 0.65.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hand_pose_ros.synthetic.contact import bring_together, part_contacts
from hand_pose_ros.synthetic.kinematics import INDEX, POSE
from hand_pose_ros.synthetic.rng import Random

__all__ = ['LIMITS', 'POSE', 'PROTOTYPES', 'sample_poses']

_FINGER_LIMITS = {'mcp_flexion': (-25, 92), 'pip_flexion': (-6, 108), 'dip_flexion': (-10, 75)}
_LIMITS = {
    'wrist_flexion': (-65, 65), 'wrist_deviation': (-32, 22), 'ring_cmc_flexion': (0, 12), 'pinky_cmc_flexion': (0, 22),
    'thumb_cmc_radial': (-5, 76), 'thumb_cmc_palmar': (-5, 62), 'thumb_cmc_roll': (35, 120),
    'thumb_mcp_flexion': (-15, 60), 'thumb_mcp_abduction': (-12, 18), 'thumb_ip_flexion': (-25, 80),
    'index_mcp_abduction': (-14, 28), 'middle_mcp_abduction': (-14, 14),
    'ring_mcp_abduction': (-14, 25), 'pinky_mcp_abduction': (-16, 44)}
LIMITS = torch.deg2rad(torch.tensor([_LIMITS.get(n) or _FINGER_LIMITS[n.split('_', 1)[1]] for n in POSE],
                                    dtype=torch.float32))
"""(P, 2) least and greatest angle, radians."""

# Degrees of MCP and PIP flexion of a finger.
_CURL = {'S': (2, 4), 'O': (-14, 0), 'R': (22, 30), 'H': (42, 55), 'C': (28, 42), 'G': (55, 72), 'F': (80, 98),
         'K': (4, 88), 'B': (76, 8), 'P': (57, 47), 'T': (66, 74)}
# Degrees of abduction of index, middle, ring and little finger.
_SPREAD = {'together': (-3, 0, -3, -6), 'apart': (5, 0, 4, 8), 'wide': (20, 0, 18, 36), 'vee': (14, -9, -2, -3),
           'vulcan': (-4, 9, 13, 8), 'horns': (8, 0, 0, 22)}
# Degrees: CMC radial, palmar, roll; MCP flexion, abduction; IP flexion.
_THUMB = {
    'out': (63, 12, 62, -9, 8, -18), 'up': (48, 22, 66, -10, 2, -14), 'side': (12, 14, 62, 4, -4, 4),
    'rest': (32, 26, 74, 10, 0, 14), 'cup': (34, 44, 88, 10, 0, 16), 'wrap': (22, 52, 100, 26, 0, 26),
    'across': (20, 47, 98, 34, 0, 48), 'tucked': (6, 34, 92, 46, 0, 34), 'key': (14, 30, 78, 16, -2, 34),
    'index': (21, 43, 96, 13, 0, 16), 'middle': (14, 51, 101, 18, 2, 15), 'ring': (7, 56, 106, 24, 5, 15),
    'pinky': (1, 60, 110, 32, 8, 21)}

# Weight, curl of index to little finger, spread, thumb.
_TABLE = (
    # open hands
    (4.0, 'SSSS', 'together', 'side'), (4.0, 'SSSS', 'apart', 'rest'), (8.0, 'SSSS', 'wide', 'out'),
    (3.0, 'SSSS', 'apart', 'out'),
    (2.0, 'OOOO', 'wide', 'out'), (1.0, 'SSSS', 'vulcan', 'out'), (2.0, 'SSSS', 'together', 'out'),
    # relaxed, half closed
    (5.0, 'RRRR', 'apart', 'rest'), (4.0, 'CCHH', 'together', 'rest'), (3.0, 'HHHH', 'together', 'rest'),
    (2.0, 'RHHG', 'together', 'side'),
    # fists
    (5.0, 'FFFF', 'together', 'across'), (2.0, 'FFFF', 'together', 'side'), (3.0, 'FFFF', 'together', 'up'),
    (1.5, 'TTTT', 'together', 'tucked'),
    (2.0, 'GGGG', 'together', 'wrap'), (1.5, 'KKKK', 'together', 'side'), (1.0, 'KKKK', 'apart', 'rest'),
    (1.5, 'BBBB', 'together', 'side'),
    (1.0, 'BBBB', 'together', 'wrap'),
    # points
    (4.0, 'SFFF', 'together', 'across'), (2.5, 'SFFF', 'together', 'out'), (2.0, 'SFFF', 'together', 'side'),
    (1.5, 'SGGG', 'together', 'rest'),
    (1.0, 'KFFF', 'together', 'across'),
    # counts
    (3.0, 'SSFF', 'vee', 'across'), (1.5, 'SSFF', 'together', 'across'), (1.5, 'SSFF', 'vee', 'out'),
    (2.0, 'SSSF', 'apart', 'across'),
    (2.0, 'SSSS', 'apart', 'tucked'), (2.0, 'SSSS', 'wide', 'tucked'), (1.0, 'SSSF', 'apart', 'pinky'),
    # pinches
    (3.0, 'PRRR', 'apart', 'index'), (2.0, 'PSSS', 'apart', 'index'), (2.0, 'PHGG', 'together', 'index'),
    (1.0, 'PFFF', 'together', 'index'),
    (1.5, 'RPRR', 'apart', 'middle'), (1.0, 'SPSS', 'apart', 'middle'), (1.5, 'SSPS', 'apart', 'ring'),
    (1.5, 'SSSP', 'apart', 'pinky'),
    (2.0, 'PPRR', 'together', 'middle'), (1.5, 'PPPP', 'together', 'middle'), (1.5, 'GGGG', 'together', 'key'),
    # grasps around balls, cylinders, plates, pens
    (3.0, 'CCCC', 'apart', 'cup'), (2.0, 'RRRR', 'wide', 'cup'), (2.0, 'HHHH', 'apart', 'cup'),
    (3.0, 'GGGG', 'together', 'cup'),
    (1.5, 'BBBB', 'apart', 'cup'), (1.5, 'CCGG', 'together', 'index'), (1.0, 'RRRR', 'together', 'side'),
    # signs
    (1.5, 'SFFS', 'horns', 'across'), (1.0, 'SFFS', 'horns', 'out'), (1.5, 'FFFS', 'horns', 'out'),
    (1.0, 'FFFS', 'horns', 'across'),
    (1.0, 'FSSS', 'apart', 'across'), (1.0, 'FSFF', 'together', 'across'), (1.0, 'BSSS', 'apart', 'side'),
    (1.0, 'SBFF', 'together', 'index'))

_FINGER_NAMES = ('index', 'middle', 'ring', 'pinky')
_MCP, _ABDUCTION, _PIP, _DIP = (torch.tensor([INDEX[f'{f}_{a}'] for f in _FINGER_NAMES])
                                for a in ('mcp_flexion', 'mcp_abduction', 'pip_flexion', 'dip_flexion'))
_THUMB_ANGLES = torch.arange(INDEX['thumb_cmc_radial'], INDEX['thumb_ip_flexion'] + 1)


def _prototype(curls: str, spread: str, thumb: str) -> Tensor:
    pose = torch.zeros(len(POSE))
    bend = torch.tensor([_CURL[c] for c in curls], dtype=torch.float32)
    pose[_MCP], pose[_PIP] = bend[:, 0], bend[:, 1]
    pose[_ABDUCTION] = torch.tensor(_SPREAD[spread], dtype=torch.float32) * (1 - bend[:, 0].clamp(0) / 90)
    pose[_THUMB_ANGLES] = torch.tensor(_THUMB[thumb], dtype=torch.float32)
    return torch.deg2rad(pose)


PROTOTYPES = torch.stack([_prototype(*row[1:]) for row in _TABLE])
"""The gestures (N, P) that poses are mixed from, in radians, before couplings."""


def _gestures(rng: Random) -> Tensor:
    """One prototype, or a pose between two of them. At times, each digit is at another point between the two."""
    table, weights = PROTOTYPES.to(rng.device), torch.tensor([row[0] for row in _TABLE])
    first, second = table[rng.choice(weights)], table[rng.choice(weights)]
    way = torch.where(rng.chance(0.45, 1), torch.zeros(()), rng.uniform(1))
    apart = torch.where(rng.chance(0.3, 1), 0.5 * rng.normal(5), torch.zeros(()))
    way = (way + apart * (way > 0)).clamp(0, 1)  # (B, 5): thumb to little finger
    digit = torch.zeros(len(POSE), dtype=torch.int64)
    for i, name in enumerate(_FINGER_NAMES):
        digit[INDEX[f'{name}_mcp_flexion']:INDEX[f'{name}_dip_flexion'] + 1] = i + 1
    return torch.lerp(first, second, way[:, digit.to(rng.device)])


def _anything(rng: Random) -> Tensor:
    """Wide random poses. A hand closes by some amount, each finger departs from it, and the thumb may be anywhere."""
    low, high = LIMITS.to(rng.device).T
    pose = low + rng.uniform(len(POSE)) * (high - low)
    own = rng.uniform(1) ** 0.7  # how independent the fingers are
    close = torch.lerp(rng.uniform(1, low=-0.1), rng.uniform(4, low=-0.15), own)
    split = 0.35 * (rng.uniform(1, low=-1) + rng.uniform(4, low=-0.5, high=0.5))  # more in the knuckles, or more beyond
    pose[:, _MCP] = (close + split).clamp(-0.25, 1) * high[_MCP]
    pose[:, _PIP] = (close - split).clamp(-0.05, 1) * high[_PIP]
    spread = rng.uniform(1, low=-0.8, high=1.1) * pose.new_tensor([20, 0, 18, 36]) + rng.normal(4, std=5)
    pose[:, _ABDUCTION] = torch.deg2rad(spread) * (1 - pose[:, _MCP].clamp(0) / high[_MCP])
    return pose


def sample_poses(rng: Random) -> Tensor:
    """Poses (B, P) in radians, one for each stream of `rng`.

    They keep within `LIMITS`, and no part of the hand is inside another. Three of four are gestures, and one of four is
    a wide random pose, all with jitter.
    """
    low, high = LIMITS.to(rng.device).T
    pose = torch.where(rng.chance(0.25, 1), _anything(rng), _gestures(rng))
    noise = torch.deg2rad(rng.normal(1, std=3.5) + rng.normal(len(POSE), std=6.0)) * rng.uniform(1, low=0.4, high=1.3)
    noise[:, _ABDUCTION] *= 0.55
    noise[:, _ABDUCTION] += torch.deg2rad(rng.normal(1, std=2.5)) * pose.new_tensor([1.0, 0, 0.8, 1.6])
    pose = pose + noise

    # A finger is drawn along by its neighbours. Its last joint follows the middle one.
    for joint, pull in ((_MCP, 0.07), (_PIP, 0.04)):
        bend = pose[:, joint]
        pulled = bend.clone()
        pulled[:, 1:] += pull * (bend[:, :-1] - bend[:, 1:])
        pulled[:, :-1] += pull * (bend[:, 1:] - bend[:, :-1])
        pose[:, joint] = pulled
    follow = 0.55 + rng.normal(1, std=0.10) + rng.normal(4, std=0.06)
    pose[:, _DIP] = pose[:, _PIP] * follow + torch.deg2rad(rng.normal(4, std=4.0))
    # The arch of the palm deepens as ring and little finger close, more so against the thumb.
    closed = pose[:, _MCP[2:]].clamp(0) / high[_MCP[2:]]
    arch = (0.55 * closed + 0.25 * (pose[:, INDEX['thumb_cmc_palmar'], None] / high[INDEX['thumb_cmc_palmar']]).clamp(0)
            + rng.normal(2, std=0.1)).clamp(0, 1)
    pose[:, INDEX['ring_cmc_flexion']:INDEX['pinky_cmc_flexion'] + 1] = arch * high[2:4]
    # The wrist is bent back a little, more with a closed hand (tenodesis) and less with an open one.
    bend = -10 + 22 * rng.normal() - 10 * (closed.mean(1) - 0.4)
    pose[:, 0], pose[:, 1] = torch.deg2rad(bend), torch.deg2rad(-5 + 10 * rng.normal())
    pose = torch.minimum(torch.maximum(pose, low), high)
    # Thumb and fingertip rarely stop just short of each other.
    pose = torch.where(rng.chance(0.6, 1), bring_together(pose, within=0.015), pose)
    return part_contacts(torch.minimum(torch.maximum(pose, low), high))
