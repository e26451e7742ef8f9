"""What is known about one hand in one image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.geometry import Cube

Side = Literal['left', 'right', 'unknown']
SIDES: tuple[Side, ...] = ('unknown', 'left', 'right')
"""In the order of their numbers in messages: `HandJoints.side`."""


def side_of(number: int) -> Side:
    """The side that a message gives as a number."""
    return SIDES[number] if number < len(SIDES) else 'unknown'


@dataclass(frozen=True, eq=False)  # comparing arrays does not give one True or False
class HandEstimate:
    """One hand in one image.

    Attributes:
        joints: (J, 3) float32, metres, optical frame of the camera.
        joint_names: the J names, in the order of the skeleton.
        confidence: (J,) float32, one per joint, in [0, 1].
        score: of the whole hand, in [0, 1].
        side: 'left', 'right' or 'unknown'.
        cube: where the network looked.
        id: stays the same from image to image while the hand is tracked.
    """

    joints: NDArray[np.float32]
    joint_names: tuple[str, ...]
    confidence: NDArray[np.float32]
    score: float
    side: Side
    cube: Cube
    id: str
