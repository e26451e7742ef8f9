"""3D joints from 2D joints and the depth image. So the 2D network of Tompson et al. (2014) is compared in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.datasets.nyu import PALM, read_nyu_depth
from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation.published import Dataset, read_text
from hand_pose_ros.evaluation.results import DAMAGE, Result
from hand_pose_ros.geometry import Intrinsics

Protocol = Literal['paper', 'code']

SIDES_M = {'subject 1': 0.300, 'subject 2': 0.249}
"""Sides of the cubes of DeepPrior. The second hand is 0.83 times as large."""
CODE_REACH_M = 0.150
"""See `lift`."""


def read_nyu_depths(folder: str | Path, rows: Sequence[int]) -> dict[int, NDArray[np.float32]]:
    """Depth (H, W) in metres of those rows of the test set that are in a folder. Row 0 is depth_1_0000001.png."""
    paths = {row: Path(folder) / f'depth_1_{row + 1:07d}.png' for row in rows}
    return {row: read_nyu_depth(path) for row, path in paths.items() if path.is_file()}


def lift(pixels: NDArray[np.float64], depth: NDArray[np.float32], intrinsics: Intrinsics, palm_z: float,
         side: float, truth_z: NDArray[np.float64], protocol: Protocol = 'paper') -> NDArray[np.float64]:
    """Joints (J, 3) in metres, from their pixels (J, 2) and the depth that is measured there.

    The measured depth is that of the surface, not of the joint. Beside a thin finger, it is that of the background. So
    what is done with it decides the comparison. The paper and its code disagree:

    - 'paper': a depth outside the cube around the palm, or no reading, becomes the depth of the back face of the cube
      (Oberweger et al. 2015, section 4).
    - 'code': a depth more than 150 mm from the labelled palm becomes the labelled depth of the joint (public code of
      November 2016). This uses the answer, so it favours the method.

    Args:
        depth: (H, W) in metres, 0 = no reading.
        palm_z: labelled depth of the palm in metres. The cube is centred there.
        side: of the cube in metres.
        truth_z: (J,) labelled depths in metres, for 'code'.
    """
    columns, rows = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).T
    inside = (columns >= 0) & (columns < depth.shape[1]) & (rows >= 0) & (rows < depth.shape[0])
    z = np.zeros(len(pixels))
    z[inside] = depth[rows[inside], columns[inside]]
    if protocol == 'paper':
        z[np.abs(z - palm_z) > side / 2] = palm_z + side / 2
    else:
        lost = np.abs(z - palm_z) > CODE_REACH_M
        z[lost] = truth_z[lost]
    return intrinsics.back_project(pixels, z)


def load_tompson(predictions: str | Path, truth: str | Path, folder: str | Path, dataset: Dataset,
                 protocol: Protocol = 'paper') -> Result:
    """The 2D joints of an .npz file on NYU, lifted with the depth images of a folder.

    Frames without a depth image are not scored. A note says how many there are.

    Args:
        predictions: .npz file with `uv` (N, 14, 2) in pixels.
        truth: text file, see `published`.
        folder: with the depth images, see `read_nyu_depths`.

    Raises:
        InputError: a file is of another form, the numbers of frames differ, or the folder has no depth image.
    """
    try:
        with np.load(predictions) as file:
            pixels = file['uv'].astype(np.float64)
    except OSError as error:
        raise InputError(f'{predictions}: the file cannot be read ({error.strerror or error})') from None
    except DAMAGE:
        raise InputError(f'{predictions}: not an .npz file with 2D joints `uv` of shape (frames, 14, 2)') from None
    label = read_text(truth, dataset.skeleton)
    if dataset.name != 'nyu' or pixels.shape != (dataset.frames, len(dataset.skeleton), 2) \
            or len(label.uvd) != dataset.frames:
        raise InputError(f'{predictions} has 2D joints of shape {pixels.shape} and {truth} {len(label.uvd)} frames: '
                         'the protocol needs all 8252 test frames of --dataset nyu, 14 joints each')
    camera, points = dataset.intrinsics, label.points(dataset.intrinsics)
    lifted = np.full(points.shape, np.nan)
    there = []
    for row in range(dataset.frames):
        for depth in read_nyu_depths(folder, [row]).values():  # one at a time, because all of them are 10 GB
            side = next(SIDES_M[part] for part, (start, stop) in dataset.parts.items() if start <= row < stop)
            lifted[row] = lift(pixels[row], depth, camera, points[row, PALM, 2], side, points[row, :, 2], protocol)
            there.append(row)
    if not there:
        raise InputError(f'{folder}: none of depth_1_0000001.png to depth_1_{dataset.frames:07d}.png is there')
    notes = [f"2D joints lifted with the depth image, protocol '{protocol}'; the cube is centred on the labelled palm."]
    if len(there) < dataset.frames:
        points[np.setdiff1d(np.arange(dataset.frames), there)] = np.nan
        notes.append(f'{len(there)} of {dataset.frames} frames have a depth image in {folder}: only they are scored.')
    return Result(Path(predictions).stem, dataset.skeleton, camera, lifted, points, parts=dict(dataset.parts),
                  notes=tuple(notes),
                  info={'predictions': str(predictions), 'ground_truth': str(truth), 'dataset': dataset.name})
