"""What every dataset gives, recorded or rendered: crops of hands, and their joints."""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hand_pose_ros.geometry
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.geometry import Cube, Intrinsics, crop
from hand_pose_ros.skeleton import Skeleton

log = logging.getLogger(__name__)

Batch = dict[str, Tensor]
"""Samples side by side, as the network sees them: left hands are mirrored, so that all are right hands.

- `patch` (B, 1, 128, 128) float, in [-1, 1]
- `joints` (B, J, 3) float32, cube units
- `cube_center` (B, 3) and `cube_side` (B,) float32, metres, for `joints_in_metres`. The centre of a mirrored patch is
  mirrored too (x negated)
- `hand_present` (B,) bool, false where the patch shows no hand. Its joints then mean nothing

Training adds two, after augmentation. `mirrored` (B,) bool tells whether a patch was mirrored for the side to be
learned. `numbers` (B,) int64 are seeds for what an objective draws. `SyntheticScenes` has other contents, and `shown`.
"""


class DatasetError(HandPoseError):
    """A dataset that is missing, incomplete or damaged."""


class Dataset(ABC):
    """Samples by index. What a sample holds depends on its index and on nothing else."""

    name: str
    """Tells this dataset and its part from others, for example 'nyu-train'."""
    skeleton: Skeleton
    size: int | None
    """Number of samples; None = as many as one asks for."""
    fingerprint: str
    """Names the caches of the samples, and changes whenever the samples change."""
    chunk: int = 64
    """How many samples to ask for at a time, enough to be efficient and few enough to fit the caches of a CPU."""
    cube_side: float = 0.30
    """The usual side of the cubes, in metres. A network that was trained on them should be run with it, too."""

    @abstractmethod
    def batch(self, indices: Tensor) -> Batch:
        """The samples of these indices (B,), see `Batch`."""


@dataclass(frozen=True)
class LabelledFrame:
    """One recorded depth image with the joints of one hand."""

    depth: NDArray[np.float32]
    """(H, W) metres, 0 = no reading."""
    intrinsics: Intrinsics
    joints: NDArray[np.float64]
    """(J, 3) metres, optical frame (x right, y down, z forward)."""
    seed: NDArray[np.float64]
    """(3,) metres, where the search for the hand starts. This is the label of the palm, as in the original code."""
    cube_side: float
    """Metres. In some protocols, it depends on the size of the hand of the subject."""
    left: bool = False


class RecordedDataset(Dataset):
    """Frames from disk.

    The crop follows the protocol of the original code, which is also that of its published numbers. A cube is put at
    the *labelled* palm, and then moved to the centre of mass of what is inside.
    """

    @abstractmethod
    def frame(self, index: int) -> LabelledFrame:
        """The frame of this index, decoded.

        Raises:
            DatasetError: its file is missing or damaged.
        """

    def batch(self, indices: Tensor) -> Batch:
        samples = [self._sample(self.frame(int(index))) for index in indices]
        patches, joints, centers, sides = zip(*samples, strict=True)
        return {
            'patch': torch.from_numpy(np.stack(patches)),
            'joints': torch.from_numpy(np.stack(joints).astype(np.float32)),
            'cube_center': torch.tensor(centers, dtype=torch.float32),
            'cube_side': torch.tensor(sides, dtype=torch.float32),
            'hand_present': torch.ones(len(samples), dtype=torch.bool),
        }

    @staticmethod
    def _sample(frame: LabelledFrame) -> tuple[NDArray[np.float32], NDArray[np.float64], tuple[float, ...], float]:
        cube = center_of_mass_cube(frame.depth, Cube.at(frame.seed, frame.cube_side), frame.intrinsics)
        patch, joints, center = crop(frame.depth, cube, frame.intrinsics), cube.to_cube(frame.joints), cube.center
        if frame.left:
            patch, joints, center = mirrored(patch, joints, center)
        return patch, joints, center, cube.side


def mirrored(patch: NDArray[Any], joints: NDArray[Any], center: tuple[float, float, float],
             ) -> tuple[NDArray[Any], NDArray[Any], tuple[float, float, float]]:
    """Patch (..., 128), joints (..., 3) and the centre of their cube, as those of a hand of the other side."""
    x, y, z = center
    return patch[..., ::-1], joints * (-1, 1, 1), (-x, y, z)


def center_of_mass_cube(depth: NDArray[np.float32], seed: Cube, intrinsics: Intrinsics) -> Cube:
    """A cube of the same side at the centre of mass of what is inside `seed`, or `seed` if nothing is.

    As in the original code, the mean is taken of column, row and depth, and projected back afterwards.
    """
    half, z = seed.side / 2, seed.center[2]
    (u, v), reach_u, reach_v = intrinsics.project(seed.center), intrinsics.fx * half / z, intrinsics.fy * half / z
    top, left = max(0, round(v - reach_v)), max(0, round(u - reach_u))
    window = depth[top:max(0, round(v + reach_v)), left:max(0, round(u + reach_u))]
    rows, columns = np.nonzero((window > max(z - half, 0)) & (window < z + half))
    if not len(rows):
        return seed
    center = intrinsics.back_project((columns.mean() + left, rows.mean() + top), window[rows, columns].mean())
    return Cube.at(center, seed.side)


def joints_in_metres(joints: Tensor, cube_center: Tensor, cube_side: Tensor) -> Tensor:
    """Joints (B, J, 3) in cube units -> metres, for cubes (B, 3) and (B,): `Cube.from_cube`, batched."""
    center = cube_center[:, None]
    points = joints * (cube_side / 2)[:, None, None] + center
    return torch.cat([points[..., :2] * (points[..., 2:] / center[..., 2:]), points[..., 2:]], dim=-1)


def require(dataset: str, paths: Iterable[Path]) -> bytes:
    """Make sure that files are there.

    Returns:
        Bytes that change with the names, sizes and times of the files. Reading the files themselves would take minutes.

    Raises:
        DatasetError: some are missing. The message names the first.
    """
    missing, states = [], []
    for path in paths:
        try:
            state = path.stat()
        except OSError:
            missing.append(path)
        else:
            states.append(f'{path.name}{state.st_size}-{state.st_mtime_ns}')
    if missing:
        others = f' (and {len(missing) - 1} more files)' if len(missing) > 1 else ''
        raise DatasetError(f'{dataset}: {missing[0]} is missing{others}; is the download complete, and is the root '
                           'the folder described in docs/training.md?')
    return ''.join(states).encode()


def are_labelled(joints: NDArray[Any]) -> NDArray[np.bool_]:
    """Which hands (N,) have all of their joints (N, J, 3).

    A joint that is not finite or not in front of the camera is no label.
    """
    return np.isfinite(joints).all((1, 2)) & (joints[..., 2] > 0).all(1)


def tell_left_out(source: object, left_out: int, count: int) -> None:
    """Log how many hands of a dataset or bag are not used. The processes that make samples do not log it again."""
    if left_out and multiprocessing.parent_process() is None:
        log.warning('%s: %s of %s hands have a joint that is not finite or not in front of the camera, and are left '
                    'out', source, left_out, count)


def check_depth(dataset: str, path: Path, depth: NDArray[Any], intrinsics: Intrinsics) -> None:
    """Raise DatasetError unless a depth image (H, W) has the size of the images of the camera."""
    (height, width), expected = depth.shape[:2], (intrinsics.width, intrinsics.height)
    if (width, height) != expected:
        raise DatasetError(f'{dataset}: {path} has {width}x{height} pixels, but the images of this dataset have '
                           f'{expected[0]}x{expected[1]}; copy or download it as it is distributed')


def read_depth(path: Path, dataset: str, intrinsics: Intrinsics, channels: int = 1) -> NDArray[Any]:
    """A depth PNG as it is stored, (H, W) uint16 or, with 3 channels, (H, W, 3) uint8 blue, green, red.

    Raises:
        DatasetError: the file is missing, damaged, of another kind, or of another size than the camera's images.
    """
    data = np.fromfile(path, np.uint8) if path.is_file() else None
    if data is None:
        raise DatasetError(f'{dataset}: {path} is missing; is the download complete?')
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:  # it claims to be larger than any image
        image = None
    if image is None:
        raise DatasetError(f'{dataset}: {path} is damaged; copy or download it again')
    if (image.ndim, image.dtype) != ((2, np.uint16) if channels == 1 else (3, np.uint8)):
        raise DatasetError(f'{dataset}: {path} is not a depth image of this dataset: it has shape {image.shape} '
                           f'and type {image.dtype}')
    check_depth(dataset, path, image, intrinsics)
    return image


def fingerprint(name: str, *parts: bytes) -> str:
    """A name for caches, which changes with the parts and with the code of this folder that makes samples."""
    digest = hashlib.sha256()
    for path in (*sorted(Path(__file__).parent.glob('*.py')), Path(hand_pose_ros.geometry.__file__)):
        digest.update(path.read_bytes())
    for part in parts:
        digest.update(part)
    return f'{name}-{digest.hexdigest()[:12]}'
