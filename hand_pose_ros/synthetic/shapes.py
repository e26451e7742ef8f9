"""How hands differ: lengths, breadths and thicknesses drawn from published anthropometry.

Sources:

- the ACOPLA95 survey for the length and breadth of hands
- Buchholz et al. 1992, An et al. 1979 and Sancho-Bru et al. 2011 for joint centres as fractions of length and breadth
- Buryanov and Kotiuk 2010 for the bones of 66 adults, with which thumb, index and little finger are a little shorter
  than with the former
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from hand_pose_ros.synthetic.rng import Random

MEN, WOMEN = (0.183, 0.084), (0.166, 0.075)
"""Mean hand length and breadth in metres."""

FINGER_END = 0.92
"""How far a finger goes on past its tip joint, over the half thickness of its last bone. The joint is the centre of the
pulp, about one fingertip radius inside the end."""

# Bones along each digit over hand length, to the end of the finger. Thumb: metacarpal, proximal, distal.
_SEGMENTS = ((0.245, 0.181, 0.153), (0.251, 0.138, 0.112), (0.272, 0.163, 0.119), (0.253, 0.156, 0.117),
             (0.198, 0.117, 0.104))
# Where the digits begin: x over hand breadth, y over hand length, z over hand breadth (the arch of the palm).
_ROOTS = ((0.210, 0.092, 0.13), (0.252, 0.447, 0.02), (0.0, 0.446, 0.0), (-0.220, 0.422, 0.015), (-0.415, 0.382, 0.06))
# Half thickness of the flesh over half the breadth.
_RADII = ((0.400, 0.238, 0.229), (0.231, 0.196, 0.176), (0.228, 0.199, 0.180), (0.212, 0.186, 0.169),
          (0.191, 0.166, 0.152))


@dataclass(frozen=True)
class Shape:
    """The measures of B right hands, in metres, in the hand frame (see `hand_pose_ros.synthetic.kinematics`).

    Attributes:
        hand_length: (B,) wrist to the end of the middle finger.
        hand_breadth: (B,) across the knuckles, with the flesh.
        roots: (B, 5, 3) first joint of each digit in the flat hand: thumb CMC, then four MCP.
        segments: (B, 5, 3) bones along each digit, from root to tip joint. Those of the thumb are metacarpal, proximal
            and distal, and those of the others are proximal, middle and distal.
        radii: (B, 5, 3) half thickness of the flesh around the segments.
        palm_depth: (B,) half thickness of the palm at the knuckles.
        wrist: (B, 2) half breadth and half depth of the wrist.
        forearm: (B, 2) length of the forearm and half breadth at its thickest.
    """

    hand_length: Tensor
    hand_breadth: Tensor
    roots: Tensor
    segments: Tensor
    radii: Tensor
    palm_depth: Tensor
    wrist: Tensor
    forearm: Tensor

    def __len__(self) -> int:
        return len(self.hand_length)

    def to(self, device: torch.device | str) -> Shape:
        """The same shapes on another device."""
        return Shape(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    @property
    def finger_ends(self) -> Tensor:
        """(B, 5) distance from the tip joint to the end of the finger."""
        return _finger_end(self.radii)


def _finger_end(radii: Tensor) -> Tensor:
    return FINGER_END * radii[:, :, 2]


def make_shape(length: Tensor, breadth: Tensor, bone_scale: Tensor | None = None, root_scale: Tensor | None = None,
               flesh: Tensor | None = None, girth: Tensor | None = None) -> Shape:
    """Hands of given length and breadth (B,) in metres, with average proportions unless scaled.

    Args:
        bone_scale: (B, 5, 3) factor for each segment. The whole hand is then scaled back to `length`.
        root_scale: (B, 5, 3) factor for each coordinate of the roots.
        flesh: (B, 5, 3) factor for each radius.
        girth: (B, 4) factors for palm depth, wrist, forearm length and forearm girth.
    """
    ones = torch.ones(len(length), 5, 3, device=length.device)
    size = torch.stack([breadth, length, breadth], -1)[:, None]
    roots = ones.new_tensor(_ROOTS) * size * (ones if root_scale is None else root_scale)
    to_end = ones.new_tensor(_SEGMENTS) * length[:, None, None] * (ones if bone_scale is None else bone_scale)
    radii = ones.new_tensor(_RADII) * breadth[:, None, None] / 2 * (ones if flesh is None else flesh)
    girth = ones[:, 0, :1].expand(-1, 4) if girth is None else girth

    factor = length / (roots[:, 2, 1] + to_end[:, 2].sum(-1))  # makes the hand as long as `length`
    roots = torch.cat([roots[..., :1], roots[..., 1:2] * factor[:, None, None], roots[..., 2:]], -1)
    segments = to_end * factor[:, None, None]
    segments = torch.cat([segments[..., :2], (segments[..., 2] - _finger_end(radii))[..., None]], -1)
    return Shape(length, breadth, roots, segments, radii,
                 palm_depth=0.165 * breadth * girth[:, 0],
                 wrist=torch.stack([0.335 * breadth, 0.235 * breadth], -1) * girth[:, 1:2],
                 forearm=torch.stack([1.50 * length * girth[:, 2], 0.52 * breadth * girth[:, 3]], -1))


def mean_shape(sex: str = 'both') -> Shape:
    """One hand of average proportions: the mean 'man', the mean 'woman', or half-way between them ('both')."""
    both = tuple((man + woman) / 2 for man, woman in zip(MEN, WOMEN, strict=True))
    length, breadth = {'man': MEN, 'woman': WOMEN, 'both': both}[sex]
    return make_shape(torch.tensor([length]), torch.tensor([breadth]))


def sample_shapes(rng: Random) -> Shape:
    """One hand for each stream of `rng`: 45 % men, 40 % women, 15 % children of about five to fourteen years.

    Length and breadth of the hand are correlated, with 0.6 within a sex and 0.9 among children. Every segment departs
    from its proportion by about 5.5 %. Of this, equal parts are shared along a digit, shared across the digits, and its
    own. The flesh varies by 5 % for the whole hand, by 1.5 % for each digit and by 2 % for each segment.
    """
    kind = rng.choice(torch.tensor([0.45, 0.40, 0.15]))
    mean = torch.tensor([MEN, WOMEN, (0.147, 0.067)], device=rng.device)[kind]
    spread = torch.tensor([(0.0105, 0.0042), (0.0085, 0.0042), (0.0125, 0.0058)], device=rng.device)[kind]
    correlation = torch.tensor([0.6, 0.6, 0.9], device=rng.device)[kind]
    draw = rng.normal(2).clamp(-2.7, 2.7)
    length = mean[:, 0] + spread[:, 0] * draw[:, 0]
    breadth = mean[:, 1] + spread[:, 1] * (
        correlation * draw[:, 0] + torch.sqrt(1 - correlation * correlation) * draw[:, 1])

    bones = rng.normal(5, 1, std=0.032) + rng.normal(1, 3, std=0.032) + rng.normal(5, 3, std=0.032)
    roots = torch.stack([rng.normal(5, std=0.04), rng.normal(5, std=0.02), rng.normal(5, std=0.25)], -1)
    chubby = torch.tensor([0.0, 0.0, 0.03], device=rng.device)[kind]
    flesh = rng.normal(1, 1, std=0.05) + rng.normal(5, 1, std=0.015) + rng.normal(5, 3, std=0.02)
    girth = 1 + rng.normal(4).clamp(-2, 2) * flesh.new_tensor([0.06, 0.06, 0.05, 0.09])
    return make_shape(length, breadth, 1 + bones.clamp(-0.14, 0.14), 1 + roots.clamp(-0.5, 0.5),
                      1 + flesh.clamp(-0.15, 0.15) + chubby[:, None, None], girth)
