"""Pictures of depth images and of the joints found in them. Pictures are (H, W, 3) uint8, BGR as OpenCV writes them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.skeleton import HAND21, Skeleton

Picture = NDArray[np.uint8]

FINGER_COLORS = {
    'palm': (235, 235, 235),
    'thumb': (255, 92, 80),
    'index': (255, 190, 40),
    'middle': (80, 220, 100),
    'ring': (60, 190, 255),
    'pinky': (205, 120, 255),
}
"""RGB of each finger, here and in the markers."""

_LIGHT = np.array([-0.45, -0.55, -0.70], np.float32)  # over the viewer's left shoulder
_NEAR_TINT = np.array([225, 238, 250], np.float32)  # BGR: near is warm and bright, far is blue and dark
_FAR_TINT = np.array([120, 75, 55], np.float32)
_NOTHING = (28, 24, 24)


def shade(depth: NDArray[np.float32], intrinsics: Intrinsics, near: float | None = None,
          far: float | None = None) -> Picture:
    """A depth image (H, W) in metres as a lit surface, so that fingers can be told apart. No reading is dark.

    Args:
        depth: 0, NaN and infinite = no reading.
        near, far: the tint goes from bright to dark between them, metres; by default the range of the image.
    """
    depth = np.asarray(depth, np.float32)  # OpenCV filters no other type
    valid = (depth > 0) & np.isfinite(depth)
    if not valid.any():
        return np.full((*depth.shape, 3), _NOTHING, np.uint8)
    z = depth[valid]
    near = float(np.percentile(z, 1)) if near is None else near
    far = float(np.percentile(z, 95)) if far is None else far
    # Sensor noise would drown the shading, and what is not finite would smear.
    smooth = cv2.bilateralFilter(np.where(valid, depth, np.float32(0)), 7, 0.015, 2.0)
    distance = np.where(valid, smooth, 1)
    slope_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8) * (intrinsics.fx / distance)
    slope_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8) * (intrinsics.fy / distance)
    length = np.sqrt(slope_x ** 2 + slope_y ** 2 + 1)
    light = np.clip((slope_x * _LIGHT[0] + slope_y * _LIGHT[1] - _LIGHT[2]) / length, 0, 1)
    nearness = np.clip((far - distance) / max(far - near, 1e-6), 0, 1)[..., None]
    picture = (_FAR_TINT + (_NEAR_TINT - _FAR_TINT) * nearness) * (0.25 + 0.85 * light[..., None])
    picture[~valid] = _NOTHING
    return np.clip(picture, 0, 255).astype(np.uint8)


def draw_joints(picture: Picture, joints: ArrayLike, intrinsics: Intrinsics, skeleton: Skeleton = HAND21) -> None:
    """Draw joints (J, 3) in metres and the bones between them into the picture, coloured per finger.

    Joints that are not finite or not before the camera are left out.
    """
    joints = np.asarray(joints, np.float64)
    there = np.isfinite(joints).all(axis=1) & (joints[:, 2] > 0)
    if not there.any():
        return
    pixels = intrinsics.project(np.where(there[:, None], joints, 1))
    radius = 0.0035 * intrinsics.fx / float(np.median(joints[there, 2]))  # 3.5 mm at the hand
    radius = float(np.clip(radius, 2, 9))
    colors = [FINGER_COLORS[finger][::-1] for finger in skeleton.fingers]
    for parent, child in skeleton.bones:
        if there[parent] and there[child]:
            _line(picture, pixels[parent], pixels[child], (0, 0, 0), max(3, round(radius * 1.1)))
            _line(picture, pixels[parent], pixels[child], colors[child], max(1, round(radius * 0.6)))
    for joint in np.argsort(-joints[:, 2]):  # the nearest last, on top
        if there[joint]:
            _dot(picture, pixels[joint], radius + 1, (0, 0, 0))
            _dot(picture, pixels[joint], radius, colors[joint])


def draw_cube(picture: Picture, cube: Cube, intrinsics: Intrinsics) -> None:
    """Draw the outline of what the network sees: the cube where it crosses the plane of its centre."""
    half = cube.side / 2
    corners = np.array(cube.center) + [[x * half, y * half, 0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    pixels = intrinsics.project(corners)
    for start, end in zip(pixels, np.roll(pixels, -1, axis=0), strict=True):
        _line(picture, start, end, (200, 200, 200), 1)


def overlay(depth: NDArray[np.float32], intrinsics: Intrinsics, hands: Sequence[HandEstimate],
            skeleton: Skeleton = HAND21, height: int = 480) -> Picture:
    """The whole image with its hands, and beside it a close-up of each hand.

    Args:
        depth: (H, W) metres. 0, NaN and infinite = no reading.
        height: of the picture, pixels.
    """
    width = np.clip(depth.shape[1] * height / depth.shape[0], height / 4, 16 * height)  # one row would be endless
    picture, shown = _view(depth, intrinsics, (0, 0), (depth.shape[1], depth.shape[0]), (round(width), height))
    panels = [picture]
    for hand in hands:
        draw_cube(picture, hand.cube, shown)
        draw_joints(picture, hand.joints, shown, skeleton)
        panels.append(close_up(depth, intrinsics, hand.cube, hand.joints, skeleton, height))
        caption(panels[-1], f'{hand.side} {hand.score:.2f}')
    if not hands:
        caption(picture, 'no hand')
    return np.hstack(panels)


def close_up(depth: NDArray[np.float32], intrinsics: Intrinsics, cube: Cube, joints: ArrayLike,
             skeleton: Skeleton = HAND21, size: int = 480) -> Picture:
    """What is in a cube, enlarged to size x size pixels, with joints (J, 3) in metres."""
    half, z = cube.side / 2, cube.center[2]
    u, v = intrinsics.project(cube.center)
    width, height = cube.side * intrinsics.fx / z, cube.side * intrinsics.fy / z
    picture, shown = _view(depth, intrinsics, (u - width / 2, v - height / 2), (width, height), (size, size),
                           z - half, z + half)
    draw_joints(picture, joints, shown, skeleton)
    return picture


def contact_sheet(pictures: Sequence[Picture], columns: int = 4) -> Picture:
    """Pictures of any size (at least one) in a grid, in reading order. Each cell is as large as the largest picture."""
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * height, columns * width, 3), _NOTHING, np.uint8)
    for i, picture in enumerate(pictures):
        top, left = i // columns * height, i % columns * width
        sheet[top:top + picture.shape[0], left:left + picture.shape[1]] = picture
    return sheet


def _view(depth: NDArray[np.float32], intrinsics: Intrinsics, corner: tuple[float, float], extent: tuple[float, float],
          size: tuple[int, int], near: float | None = None, far: float | None = None) -> tuple[Picture, Intrinsics]:
    """A rectangle of a depth image as a lit surface of another size, and the intrinsics that belong to it.

    It is lit before it is enlarged, because each enlarged pixel would be a terrace.
    """
    (u, v), (width, height) = corner, size
    a, b = width / extent[0], height / extent[1]
    # Pixel centres are integers: the left edge of the image is at -0.5.
    matrix = np.array([[a, 0, (0.5 - u) * a - 0.5], [0, b, (0.5 - v) * b - 0.5]])
    picture = cv2.warpAffine(shade(depth, intrinsics, near, far), matrix, size, flags=cv2.INTER_LINEAR,
                             borderValue=_NOTHING)
    return np.asarray(picture, np.uint8), Intrinsics(
        intrinsics.fx * a, intrinsics.fy * b, intrinsics.cx * a + matrix[0, 2], intrinsics.cy * b + matrix[1, 2],
        width, height)


_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


def _fixed(point: NDArray[np.float64]) -> tuple[int, int]:
    x, y = np.clip(point, -1e5, 1e5) * (1 << _SHIFT)  # far outside of the picture, integers would overflow
    return round(float(x)), round(float(y))


def _line(picture: Picture, start: NDArray[np.float64], end: NDArray[np.float64], color: tuple[int, ...],
          thickness: int) -> None:
    cv2.line(picture, _fixed(start), _fixed(end), color, thickness, cv2.LINE_AA, _SHIFT)


def _dot(picture: Picture, center: NDArray[np.float64], radius: float, color: tuple[int, ...]) -> None:
    cv2.circle(picture, _fixed(center), round(radius * (1 << _SHIFT)), color, -1, cv2.LINE_AA, _SHIFT)


def caption(picture: Picture, text: str, at: tuple[int, int] = (10, 24), size: float = 0.7) -> None:
    """Write white letters with a black outline into a picture.

    Args:
        at: column and row of the lower left corner of the text; by default in the upper left corner of the picture.
        size: a factor, as OpenCV takes it.
    """
    around = [((x, y), (0, 0, 0)) for x in (-1, 0, 1) for y in (-1, 0, 1)]  # thicker letters are wider
    for (x, y), color in (*around, ((0, 0), (255, 255, 255))):
        cv2.putText(picture, text, (at[0] + x, at[1] + y), cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
