"""NYU hand pose (Tompson et al. 2014): one camera, 72,757 training and 8,252 test frames of two other subjects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from hand_pose_ros.datasets.base import (
    DatasetError,
    LabelledFrame,
    RecordedDataset,
    are_labelled,
    fingerprint,
    read_depth,
    require,
    tell_left_out,
)
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import get_skeleton

INTRINSICS = Intrinsics(588.03, 587.07, 320.0, 240.0, 640, 480)

JOINTS = (0, 3, 6, 9, 12, 15, 18, 21, 24, 25, 27, 30, 31, 32)
"""The 14 of the 36 labelled joints that are evaluated, in the order of the skeleton nyu14."""
PALM = 13

FIRST_SUBJECT = 2440
"""Number of test frames of the first subject. The rest shows a smaller hand."""
HELD_OUT = 0.05
"""Share of the training frames that validate. They are the last ones, because no subject can be held out: there is only
one."""


def read_nyu_depth(path: Path) -> NDArray[np.float32]:
    """Depth (H, W) in metres of a frame, 0 = no reading.

    It is packed into the colours of a PNG. Green is the high byte of the millimetres, and blue the low byte. 2001 mm
    and above is no reading.

    Raises:
        DatasetError: the file is missing, damaged, or of another kind or size.
    """
    image = read_depth(path, 'NYU', INTRINSICS, channels=3).astype(np.uint16)
    millimetres = image[..., 1] << 8 | image[..., 0]
    return np.where(millimetres < 2001, millimetres, 0).astype(np.float32) / np.float32(1000)


class NYU(RecordedDataset):
    """`root`/{train,test}/joint_data.mat with depth_1_%07d.png beside it, as distributed.

    The splits train and val hold the training frames. The split test has two subjects, which are also the splits test_1
    and test_2.
    """

    skeleton = get_skeleton('nyu14')

    def __init__(self, root: Path, split: str) -> None:
        self.name = f'nyu-{split}'
        self._folder = root / ('train' if split in ('train', 'val') else 'test')
        labels = self._folder / 'joint_data.mat'
        require('NYU', [labels])
        try:
            joints = np.asarray(loadmat(labels, variable_names=['joint_xyz'])['joint_xyz'][0])  # of camera 1
            if joints.ndim != 3 or joints.shape[1] <= max(JOINTS) or joints.shape[2] != 3:
                raise ValueError(f'joint_xyz has the shape {joints.shape}')
            self._joints = joints[:, JOINTS] * (0.001, -0.001, 0.001)  # mm with y up -> m with y down
        except Exception as error:  # scipy raises what it likes on a damaged file
            raise DatasetError(f'NYU: {labels} is damaged or has no joint_xyz ({error}); download it again') from error
        count = len(joints)
        held_out = max(1, round(count * HELD_OUT))
        parts = {'train': range(count - held_out), 'val': range(count - held_out, count), 'test': range(count),
                 'test_1': range(min(FIRST_SUBJECT, count)), 'test_2': range(FIRST_SUBJECT, count)}
        if split not in parts:
            raise DatasetError(f"NYU: unknown split '{split}': choose one of {', '.join(parts)}")
        whole = are_labelled(self._joints)
        self._frames = [frame for frame in parts[split] if whole[frame]]
        if not self._frames:
            raise DatasetError(f'NYU: {labels} has no labelled frame of {split} among its {count}; is it complete?')
        tell_left_out(self.name, len(parts[split]) - len(self._frames), len(parts[split]))
        self.size = len(self._frames)
        images = require('NYU', (self._path(frame) for frame in self._frames))
        self.fingerprint = fingerprint(self.name, self._joints.tobytes(), images)

    def _path(self, frame: int) -> Path:
        return self._folder / f'depth_1_{frame + 1:07d}.png'

    def frame(self, index: int) -> LabelledFrame:
        frame = self._frames[index]
        depth = read_nyu_depth(self._path(frame))
        joints = self._joints[frame]
        smaller = self._folder.name == 'test' and frame >= FIRST_SUBJECT
        # The factor is the original authors' knowledge of the subject's hand. Every number that uses it must say so.
        return LabelledFrame(depth, INTRINSICS, joints, joints[PALM], 0.300 * (0.83 if smaller else 1))
