"""Where a hand may be in a depth image: depth -> cubes. (`runtime.finder` does the same with a network.)

The paper assumes that the hand is the nearest object to the camera (section 3; Oberweger et al. 2015). This is its
detector, but with sizes in metres instead of pixels, no bias at the border of the image, and a minimum size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.geometry import Cube, Intrinsics

Region = tuple[int, int, int, int]
"""A rectangle of an image in pixels: x, y, width, height (as sensor_msgs/RegionOfInterest)."""

MIN_AREA_M2 = 15e-4
"""An object that is smaller than this, seen from the camera, is a speck or a cable. A fist seen end on has about
40 cm2."""
MIN_CUBE_AREA_M2 = 25e-4
"""A cube must hold at least this much surface to hold a hand."""
MAX_THROUGH = 0.5
"""Largest share of two opposite sides that may both be cut. An arm leaves through one side only; a table or a wall goes
right through."""

_WORK_WIDTH = 160
_SLAB_M = 0.03
_ITERATIONS = 5


class _Scene:
    """A depth image reduced to about 160 columns, with the position and area of its pixels in the world."""

    def __init__(self, depth: NDArray[np.float32], intrinsics: Intrinsics, near: float, far: float) -> None:
        self.stride = max(1, intrinsics.width // _WORK_WIDTH)
        first = self.stride // 2
        z = depth[first::self.stride, first::self.stride]
        self.z = np.where((z >= near) & (z <= far), z, np.float32(0))
        rows, cols = self.z.shape
        self.x = (np.arange(cols, dtype=np.float32) * self.stride + first - intrinsics.cx) / intrinsics.fx
        self.y = (np.arange(rows, dtype=np.float32) * self.stride + first - intrinsics.cy) / intrinsics.fy
        self.pixel_area = self.stride ** 2 / (intrinsics.fx * intrinsics.fy)  # m2 at 1 m; grows with z squared

    def inside(self, center: NDArray[np.float64], side: float,
               ) -> tuple[NDArray[np.float32], NDArray[np.bool_], slice, slice]:
        """The depth in the window of a cube, a mask of what lies inside the cube, and the window (rows and columns).

        The rays of the window's pixels meet the plane of the cube's centre inside the cube.
        """
        (x, y, middle), half = center, side / 2
        cols = slice(*np.searchsorted(self.x, [(x - half) / middle, (x + half) / middle]))
        rows = slice(*np.searchsorted(self.y, [(y - half) / middle, (y + half) / middle]))
        z = self.z[rows, cols]
        return z, (z > 0) & (np.abs(z - middle) <= half), rows, cols

    def centroid(self, z: NDArray[np.float32], mask: NDArray[np.bool_], rows: slice, cols: slice,
                 ) -> NDArray[np.float64]:
        """Centre of mass of the masked pixels, from their mean position in the image and mean depth: a point in metres.
        """
        count = mask.sum()
        depth = z[mask].mean(dtype=np.float64)
        x = mask.sum(0) @ self.x[cols] / count
        y = mask.sum(1) @ self.y[rows] / count
        return np.array([x * depth, y * depth, depth])


def candidates(depth: NDArray[np.float32], intrinsics: Intrinsics, *, side: float = 0.30, near: float = 0.1,
               far: float = 1.5, regions: Sequence[Region] | None = None) -> Iterator[Cube]:
    """Cubes around hand-sized objects, the nearest first. Each is searched only when it is asked for.

    The search starts at the camera. It looks at everything nearer than a distance that grows. The first connected piece
    of at least MIN_AREA_M2 starts a cube. This cube moves to the centre of mass of its content (5 iterations, as in the
    original code). A cube is no hand if it holds too little, or if something goes right through it, like a wall or a
    table.

    Args:
        depth: (H, W) float32, metres, 0 = no reading.
        side: of the cubes, metres.
        near, far: range in which hands are looked for, metres.
        regions: ignore everything outside these rectangles; None = use the whole image.
    """
    if regions is not None:
        inside = np.zeros(depth.shape, bool)
        for x, y, width, height in regions:
            inside[max(y, 0):max(y + height, 0), max(x, 0):max(x + width, 0)] = True
        depth = np.where(inside, depth, np.float32(0))
    scene = _Scene(depth, intrinsics, near, far)
    found: list[Cube] = []
    z, unseen = scene.z, scene.z > 0
    present = z[unseen]
    if present.size == 0:
        return
    for limit in np.arange(present.min() + _SLAB_M, present.max() + 2 * _SLAB_M, _SLAB_M):
        nearer = (unseen & (z < limit)).view(np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(nearer, connectivity=4)
        for label in range(1, count):
            # Nearly all pieces are specks. Their area is at most that of as many pixels at the limit.
            if stats[label, cv2.CC_STAT_AREA] * scene.pixel_area * limit ** 2 < MIN_AREA_M2:
                continue
            piece = labels == label
            if float(np.sum(np.square(z[piece]))) * scene.pixel_area < MIN_AREA_M2:
                continue
            center = _settle(scene, unseen, scene.centroid(z, piece, slice(None), slice(None)), side)
            again = any(np.linalg.norm(center - cube.center) < side / 3 for cube in found)
            if not again and _may_hold_a_hand(scene, center, side, MAX_THROUGH):
                found.append(Cube.at(center, side))
                yield found[-1]
            # This object has been judged, so look behind and beside it.
            _, inside, rows, cols = scene.inside(center, side)
            unseen[rows, cols] &= ~inside
            unseen[piece] = False


def detect(depth: NDArray[np.float32], intrinsics: Intrinsics, *, max_hands: int = 1, **where: Any) -> list[Cube]:
    """The first `max_hands` of the `candidates`, or fewer. The other arguments are those of `candidates`."""
    return list(islice(candidates(depth, intrinsics, **where), max_hands))


def _settle(scene: _Scene, unseen: NDArray[np.bool_], center: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """Move a cube to the centre of mass of its content (original code; the paper trains on such centres).

    The content of earlier cubes does not count. An elbow that was already judged must not attract the next cube.
    """
    for _ in range(_ITERATIONS):
        z, inside, rows, cols = scene.inside(center, side)
        inside &= unseen[rows, cols]
        if not inside.any():
            break
        center = scene.centroid(z, inside, rows, cols)
    return center


def _may_hold_a_hand(scene: _Scene, center: NDArray[np.float64], side: float, max_through: float) -> bool:
    z, inside, _, _ = scene.inside(center, side)
    if float(np.sum(np.square(z[inside]))) * scene.pixel_area < MIN_CUBE_AREA_M2:
        return False
    through = max(min(inside[0].mean(), inside[-1].mean()), min(inside[:, 0].mean(), inside[:, -1].mean()))
    return bool(through <= max_through)


def holds_a_hand(depth: NDArray[np.float32], intrinsics: Intrinsics, cube: Cube, *, near: float = 0.1,
                 far: float = 1.5, max_through: float = MAX_THROUGH) -> bool:
    """Whether a tracked cube still holds an object that may be a hand. If not, the hand is lost.

    With `max_through` 1, a table or a wall may go through the cube. This is for networks that can tell a hand in front
    of a table or a wall from no hand.
    """
    return _may_hold_a_hand(_Scene(depth, intrinsics, near, far), np.array(cube.center), cube.side, max_through)
