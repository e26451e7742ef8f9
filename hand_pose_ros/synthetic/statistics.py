"""Compares patches of synthetic and of real hands by a few numbers, by which a network could tell them apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.depth import read_png
from hand_pose_ros.detection import detect
from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import Cube, Intrinsics, crop

STEPS_MM = (1.0, 3.0, 10.0, 30.0)
"""Bounds of the histogram of depth steps between neighbouring pixels."""


def describe(patch: NDArray[np.float32], side: float) -> dict[str, float]:
    """The numbers of one patch (128, 128) in [-1, 1] of a cube of this `side` in metres.

    Returns:
        covered: share of the patch that shows something.
        missing: of what is covered once small gaps are closed, the share without a reading.
        edge noise: how much longer the outline is than that of the smoothed shape, as a share (0 = as smooth).
        noise mm: mean difference of a pixel inside the surface from the median of its 3x3 pixels.
        extent mm: of what is shown, along its main axis, from the 2nd to the 98th percentile.
        steps ...: shares of the steps between horizontal neighbours, by size in mm.
    """
    shown = patch < 1
    mask = shown.astype(np.uint8)
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    smooth = (cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.0) > 0.5).astype(np.uint8)
    millimetres = patch * (side / 2 * 1e3)
    inner = cv2.erode(mask, np.ones((5, 5), np.uint8)) > 0
    local = np.abs(millimetres - cv2.medianBlur(millimetres, 3))[inner]
    steps = np.abs(np.diff(millimetres, axis=1))[shown[:, 1:] & shown[:, :-1]]
    histogram = np.histogram(steps, (0, *STEPS_MM, np.inf))[0] / max(len(steps), 1)
    rows, columns = np.nonzero(shown)
    points = np.stack([columns, rows], 1) * (side * 1e3 / len(patch))
    return {'covered': float(shown.mean()), 'missing': float(1 - mask.sum() / max(closed.sum(), 1)),
            'edge noise': _outline(mask) / max(_outline(smooth), 1.0) - 1,
            'noise mm': float(local.mean()) if len(local) else 0.0,
            'extent mm': _extent(points),
            **{f'steps {name} mm': float(share) for name, share in zip(_step_names(), histogram, strict=True)}}


def _step_names() -> list[str]:
    bounds = [f'{bound:g}' for bound in STEPS_MM]
    return [f'< {bounds[0]}', *(f'{a}-{b}' for a, b in pairwise(bounds)), f'> {bounds[-1]}']


def _outline(mask: NDArray[np.uint8]) -> float:
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return max((cv2.arcLength(contour, True) for contour in contours), default=0.0)


def _extent(points: NDArray[np.floating]) -> float:
    if len(points) < 2:
        return 0.0
    centered = points - points.mean(0)
    along = centered @ np.linalg.svd(centered, full_matrices=False)[2][0]
    low, high = np.percentile(along, (2, 98))
    return float(high - low)


def summarise(patches: Iterable[tuple[NDArray[np.float32], float]]) -> dict[str, tuple[float, float, float]]:
    """Quartiles of each number of `describe`, over patches with the sides of their cubes.

    Raises:
        InputError: there are no patches.
    """
    rows = [describe(patch, side) for patch, side in patches]
    if not rows:
        raise InputError('there are no hands to describe: no patch was given, or no hand was detected in the images')
    low, middle, high = (np.percentile([list(row.values()) for row in rows], q, axis=0) for q in (25, 50, 75))
    return {name: (float(low[i]), float(middle[i]), float(high[i])) for i, name in enumerate(rows[0])}


def real_patches(folder: Path, intrinsics: Sequence[float], depth_scale: float,
                 side: float = 0.30) -> list[tuple[NDArray[np.float32], float]]:
    """The crops that the product makes of the 16-bit depth PNGs in a folder, and the sides of their cubes in metres.

    Images without a hand are left out.

    Args:
        intrinsics: fx, fy, cx, cy in pixels.
        depth_scale: metres per unit.
        side: side of the cubes, metres.

    Raises:
        InputError: the folder has no PNG, or one cannot be read.
    """
    paths = sorted(folder.rglob('*.png'))
    if not paths:
        raise InputError(f'{folder} holds no PNG: give a folder of 16-bit depth images')
    patches = []
    for path in paths:
        depth = read_png(path, depth_scale)
        fx, fy, cx, cy = intrinsics
        camera = Intrinsics(fx, fy, cx, cy, width=depth.shape[1], height=depth.shape[0])
        for cube in detect(depth, camera, side=side):
            depth = np.where(depth < cube.center[2] + side, depth, 0)
            patches.append((crop(depth, Cube(cube.center, side), camera)[0], side))
    return patches
