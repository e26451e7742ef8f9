"""Runs the network that finds hands on whole depth images: depth -> cubes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hand_pose_ros.detection import Region
from hand_pose_ros.errors import CheckpointError
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.models.checkpoints import WEIGHTS, load_checkpoint
from hand_pose_ros.models.finder import FOCAL, MULTIPLE
from hand_pose_ros.runtime.onnx_engine import open_session, to_onnx

SHIPPED = WEIGHTS / 'detection' / 'hand_finder.safetensors'

MIN_SCORE = 0.1
"""Places with a lower score are ignored."""
MOST = 6
"""Maximum number of places for one image. The likeliest are returned."""


class Finder:
    """Depth images to cubes around everything that looks like a hand: as `detection.candidates`, but with a network.

    It always runs on the CPU, where it takes two or three milliseconds. It is only needed while there is no hand, or to
    find another one.

    Args:
        network: `models.finder.HandFinder`.
        num_threads: number of CPU threads.
    """

    def __init__(self, network: nn.Module, num_threads: int = 1) -> None:
        size = {2: 'height', 3: 'width'}
        model = to_onnx(network, torch.zeros(1, 1, 2 * MULTIPLE, 3 * MULTIPLE), 'depth',
                        {'depth': size, 'logits': {1: 'rows', 2: 'columns'}, 'middles': {2: 'rows', 3: 'columns'}})
        self._session = open_session(model, num_threads)

    @classmethod
    def from_pretrained(cls, path: str | Path = SHIPPED, num_threads: int = 1) -> Finder:
        """A finder with the weights that ship, or with others.

        Raises:
            CheckpointError: the weights do not exist, are damaged, or belong to another network.
        """
        checkpoint = load_checkpoint(path)
        if checkpoint.metadata['architecture'] != 'hand_finder':
            raise CheckpointError(f"{path} holds a {checkpoint.metadata['architecture']}, not a hand_finder")
        return cls(checkpoint.network, num_threads)

    def __call__(self, depth: NDArray[np.float32], intrinsics: Intrinsics, *, side: float = 0.30, near: float = 0.1,
                 far: float = 1.5, regions: Sequence[Region] | None = None) -> list[Cube]:
        """Cubes around hands, the likeliest first. The arguments are those of `detection.candidates`.

        The network always sees the whole image, even if there are regions: an arm that is cut off looks like a hand at
        its end.

        Raises:
            InputError: no camera can have these intrinsics.
        """
        intrinsics.check_lens()
        rows, columns, height, width = _grid(intrinsics)
        small = depth[rows[:, None], columns]
        image = np.zeros((1, 1, height, width), np.float32)
        image[0, 0, :len(rows), :len(columns)] = np.where((small >= near) & (small <= far), small, 0)
        logits, middles = self._session.run(None, {'depth': image})
        logits = logits[0]
        # Cells whose neighbours are not higher.
        peaks = (logits >= cv2.dilate(logits, np.ones((3, 3)))) & (logits > math.log(MIN_SCORE / (1 - MIN_SCORE)))
        ys, xs = np.nonzero(peaks)
        x, y, z = middles[0][:, ys, xs]
        z = z + 1
        # The principal point of the network's camera is the middle of its image.
        x = x + ((width - 1) / 2 - _scaled(intrinsics.cx, intrinsics.fx)) / FOCAL
        y = y + ((height - 1) / 2 - _scaled(intrinsics.cy, intrinsics.fy)) / FOCAL
        u, v = x * intrinsics.fx + intrinsics.cx, y * intrinsics.fy + intrinsics.cy
        wanted = (z >= near) & (z <= far)
        if regions is not None:
            wanted &= np.any([(u >= left) & (u < left + across) & (v >= top) & (v < top + down)
                              for left, top, across, down in regions] or [np.zeros(len(z), bool)], axis=0)
        order = [k for k in logits[ys, xs].argsort()[::-1] if wanted[k]][:MOST]
        return [Cube.at((x[k] * z[k], y[k] * z[k], z[k]), side) for k in order]


def _scaled(principal: float, focal: float) -> float:
    """Position of a principal point in an image with focal length FOCAL. 0 is the middle of the first pixel."""
    return (principal + 0.5) * FOCAL / focal - 0.5


@lru_cache(maxsize=8)
def _grid(intrinsics: Intrinsics) -> tuple[NDArray[np.int64], NDArray[np.int64], int, int]:
    """The rows and columns of a camera's image that a camera with a focal length of FOCAL pixels would see.

    Also the height and width of the image of that camera.
    """
    def line(length: int, focal: float) -> tuple[NDArray[np.int64], int]:
        number = max(1, int(length * FOCAL / focal))
        taken = ((np.arange(number) + 0.5) * focal / FOCAL).astype(np.int64).clip(max=length - 1)
        return taken, -(-number // MULTIPLE) * MULTIPLE
    (rows, height), (columns, width) = line(intrinsics.height, intrinsics.fy), line(intrinsics.width, intrinsics.fx)
    return rows, columns, height, width
