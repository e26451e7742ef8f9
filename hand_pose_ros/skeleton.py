"""Named sets of joints and the bones between them."""

from __future__ import annotations

from dataclasses import dataclass

from hand_pose_ros.errors import HandPoseError

FINGERS = ('thumb', 'index', 'middle', 'ring', 'pinky')


@dataclass(frozen=True)
class Skeleton:
    """Joints in their order, and for each joint the index of its parent (-1 = root)."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.joint_names)

    @property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """(parent, child) indices, in the order of the children."""
        return tuple((parent, child) for child, parent in enumerate(self.parents) if parent >= 0)

    @property
    def fingers(self) -> tuple[str, ...]:
        """For each joint, the finger that it belongs to, or 'palm'."""
        return tuple(next((f for f in FINGERS if name.startswith(f)), 'palm') for name in self.joint_names)

    @property
    def knuckles(self) -> tuple[int, ...]:
        """Indices of the first joints of the fingers without the thumb. Their parent is the root."""
        return tuple(joint for joint, finger in enumerate(self.fingers)
                     if self.parents[joint] == self.root and finger not in ('palm', 'thumb'))

    @property
    def root(self) -> int:
        """Index of the joint without a parent."""
        return self.parents.index(-1)

    @property
    def has_wrist(self) -> bool:
        """Whether the root is the wrist. If it is the palm, the bones do not give the length of the hand."""
        return self.joint_names[self.root] == 'wrist'

    @property
    def middle_finger(self) -> tuple[int, ...]:
        """Indices from its tip to the root. The bones between them add up to the length of the hand, if `has_wrist`."""
        chain = [self.joint_names.index('middle_tip')]
        while self.parents[chain[-1]] >= 0:
            chain.append(self.parents[chain[-1]])
        return tuple(chain)


def _hand(name: str, joints: str, parents: tuple[int, ...]) -> Skeleton:
    return Skeleton(name, tuple(joints.split()), parents)


SKELETONS = {skeleton.name: skeleton for skeleton in (
    # Ours: the wrist, then four joints per digit, from root to tip.
    _hand('hand21', 'wrist thumb_cmc thumb_mcp thumb_ip thumb_tip '
          + ' '.join(f'{f}_{j}' for f in FINGERS[1:] for j in ('mcp', 'pip', 'dip', 'tip')),
          (-1, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)),
    # NYU (Tompson et al. 2014): the 14 of the 36 joints that are evaluated, little finger first, tip before middle.
    _hand('nyu14', 'pinky_tip pinky_mid ring_tip ring_mid middle_tip middle_mid index_tip index_mid '
          'thumb_tip thumb_ip thumb_mcp wrist_left wrist_right palm',
          (1, 13, 3, 13, 5, 13, 7, 13, 9, 10, 13, 13, 13, -1)),
    # ICVL (Tang et al. 2014): the palm, then root, middle and tip of each digit.
    _hand('icvl16', 'palm ' + ' '.join(f'{f}_{j}' for f in FINGERS for j in ('root', 'mid', 'tip')),
          (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)),
    # MSRA15 (Sun et al. 2015): wrist, then index to little finger, the thumb last.
    _hand('msra21', 'wrist '
          + ' '.join(f'{f}_{j}' for f in (*FINGERS[1:], FINGERS[0]) for j in ('mcp', 'pip', 'dip', 'tip')),
          (-1, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)),
)}

HAND21 = SKELETONS['hand21']


def get_skeleton(name: str) -> Skeleton:
    """The skeleton with this name.

    Raises:
        HandPoseError: there is no such skeleton.
    """
    if name not in SKELETONS:
        raise HandPoseError(f"unknown skeleton '{name}': choose one of {', '.join(SKELETONS)}")
    return SKELETONS[name]
