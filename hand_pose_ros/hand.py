"""What is known of a hand in an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.geometry import Cube

Side = Literal['left', 'right', 'unknown']


@dataclass(frozen=True, eq=False)  # arrays cannot tell in one word whether they are equal
class HandEstimate:
    """One hand in one image.

    Attributes:
        joints: (J, 3) float32, metres, optical frame of the camera.
        joint_names: the J names, in the order of the skeleton.
        confidence: (J,) float32 in [0, 1].
        score: of the whole hand, in [0, 1].
        side: 'left', 'right' or 'unknown'.
        cube: what the network looked at.
        id: the same from image to image as long as the hand is tracked.
    """

    joints: NDArray[np.float32]
    joint_names: tuple[str, ...]
    confidence: NDArray[np.float32]
    score: float
    side: Side
    cube: Cube
    id: str
