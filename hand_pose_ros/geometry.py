"""Pinhole camera, the metric cube around a hand, and the crop that a network sees.

Everything is in metres and in the camera's optical frame (x right, y down, z forward; REP-103). In pixel (u, v), u
points to the right, and integers are pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hand_pose_ros.errors import InputError

PATCH_SIZE = 128
"""Width and height of a patch in pixels (paper, section 3)."""
MAX_SLOPE, MIN_SLOPE = 3.0, 1e-4
"""Largest and smallest slope of the rays at the border of an image against the axis of the camera (71.6 degrees, and a
fraction of a minute of arc). No lens has intrinsics beyond these limits."""
MAX_RATIO = 3.0
"""Largest ratio of the two focal lengths. Pixels may be binned in one direction only."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels of a `width` x `height` image."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if not (np.isfinite(values).all() and self.fx > 0 and self.fy > 0):
            raise InputError(
                f'camera intrinsics fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy} are not usable: '
                'focal lengths must be positive, and all four finite: calibrate the camera')
        if self.width <= 0 or self.height <= 0:
            raise InputError(f'camera intrinsics are for an image of {self.width}x{self.height} pixels, which is '
                             'empty: give its size')

    @classmethod
    def from_camera_info(cls, info: Any, *, rectified: bool = True) -> Intrinsics:
        """The intrinsics of the image that a sensor_msgs/CameraInfo belongs to (any object with its fields).

        With `rectified`, they come from the projection matrix P if it is filled in. Otherwise they come from the raw
        matrix K. Binning and the region of interest are applied: both describe how the published image was cut out of
        the full sensor (sensor_msgs/CameraInfo).

        Raises:
            InputError: the matrix is zero (an uncalibrated camera) or not usable, or the size is empty.
        """
        k, p = [*map(float, info.k)], [*map(float, info.p)]
        fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if rectified and p[0] != 0 else (k[0], k[4], k[2], k[5])
        if fx == 0:
            raise InputError('camera_info has a zero camera matrix: the camera is not calibrated; calibrate it')
        roi = info.roi
        width, height = roi.width or info.width, roi.height or info.height
        bin_x, bin_y = info.binning_x or 1, info.binning_y or 1
        return cls(fx=fx / bin_x, fy=fy / bin_y, cx=(cx - roi.x_offset) / bin_x, cy=(cy - roi.y_offset) / bin_y,
                   width=width // bin_x, height=height // bin_y)

    def check_size(self, width: int, height: int) -> None:
        """Raise InputError if the intrinsics belong to an image of another size."""
        if (width, height) != (self.width, self.height):
            raise InputError(
                f'the depth image has {width}x{height} pixels but its intrinsics are for {self.width}x{self.height}: '
                'use those of this very image (the camera_info that is published beside it)')

    def check_lens(self) -> None:
        """Raise InputError if no lens can have these intrinsics. Results computed with them would be meaningless."""
        for focal, center, size in ((self.fx, self.cx, self.width), (self.fy, self.cy, self.height)):
            if max(abs(center), abs(size - center)) > MAX_SLOPE * focal or size < MIN_SLOPE * focal:
                raise InputError(f'a focal length of {focal:g} and a principal point at {center:g} pixels are those of '
                                 f'no camera of {self.width}x{self.height} pixels: calibrate it, or correct '
                                 'the intrinsics that were given')
        if not 1 / MAX_RATIO <= self.fx / self.fy <= MAX_RATIO:
            raise InputError(f'focal lengths of {self.fx:g} and {self.fy:g} pixels are not those of one camera: '
                             'calibrate it, or correct the intrinsics that were given')

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) in metres -> pixels (..., 2)."""
        points = np.asarray(points, np.float64)
        z = points[..., 2]
        return np.stack([points[..., 0] / z * self.fx + self.cx, points[..., 1] / z * self.fy + self.cy], axis=-1)

    def back_project(self, pixels: ArrayLike, z: ArrayLike) -> NDArray[np.float64]:
        """Pixels (..., 2) and their depths (...) in metres -> points (..., 3) in metres."""
        pixels, z = np.asarray(pixels, np.float64), np.asarray(z, np.float64)
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        return np.stack([x * z, y * z, z], axis=-1)


@dataclass(frozen=True)
class Cube:
    """The metric cube in which a hand is looked for: its `center` (x, y, z) and the length of its `side`, in metres.

    The *cube units* of a point are its position in the patch and its depth: column and row of the patch in [-1, 1], and
    depth from the front face (-1) to the back face (+1). They follow the rays of the camera, as the patch does. So the
    network sees exactly what it is asked for, wherever the hand is in the image. (The original code uses metric offsets
    from the centre instead. The two differ by the perspective inside the cube.)
    """

    center: tuple[float, float, float]
    side: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.center).all() and self.center[2] > 0 and self.side > 0):
            raise InputError(f'a cube with centre {self.center} and side {self.side} is not in front of the camera')

    @classmethod
    def at(cls, center: ArrayLike, side: float) -> Cube:
        """The cube around a point (3,), in metres."""
        x, y, z = np.asarray(center, np.float64).tolist()
        return cls((x, y, z), side)

    def to_cube(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) in metres -> cube units (..., 3)."""
        points = np.asarray(points, np.float64)
        x, y, z = self.center
        on_plane = points * (z / points[..., 2:3])  # along the ray onto the plane of the centre
        on_plane[..., 2] = points[..., 2]
        return (on_plane - np.array([x, y, z])) / (self.side / 2)

    def from_cube(self, coordinates: ArrayLike) -> NDArray[np.float64]:
        """Cube units (..., 3) -> points (..., 3) in metres. The exact inverse of `to_cube`."""
        x, y, z = self.center
        points = np.asarray(coordinates, np.float64) * (self.side / 2) + np.array([x, y, z])
        points[..., :2] *= points[..., 2:3] / z
        return points


def crop(depth: NDArray[np.float32], cube: Cube, intrinsics: Intrinsics, size: int = PATCH_SIZE) -> NDArray[np.float32]:
    """The content of the cube, as a patch (1, size, size) in [-1, 1] (paper, section 3; nearest neighbour).

    -1 is the front face of the cube, +1 is the back face. Pixels without a reading (0 in `depth`, or outside the image)
    and everything behind the back face are +1. Everything in front of the front face is -1, so a finger that leaves the
    cube towards the camera stays visible.

    Args:
        depth: (H, W) float32 in metres, 0 = no reading.
    """
    (u, v), half = intrinsics.project(cube.center), cube.side / 2
    z = cube.center[2]
    # Pixel (i, j) of the patch is at (i + 0.5) / (size / 2) - 1 in cube units.
    step = 2 / size * half / z
    affine = np.array([[intrinsics.fx * step, 0, u + intrinsics.fx * step * (0.5 - size / 2)],
                       [0, intrinsics.fy * step, v + intrinsics.fy * step * (0.5 - size / 2)]])
    patch = np.empty((size, size), np.float32)
    depth = np.asarray(depth, np.float32)  # with another type, OpenCV would not write to `patch`
    cv2.warpAffine(depth, affine, (size, size), dst=patch, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
                   borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    nothing = ~(patch > 0)  # NaN, too
    # Clip before the division, because a reading may be any float. But not to the faces yet: they would be rounded to
    # not quite 1.
    np.clip(patch, z - 2 * half, z + 2 * half, out=patch)
    patch -= z
    patch /= half
    patch[nothing] = 1
    return np.clip(patch, -1, 1, out=patch)[None]
