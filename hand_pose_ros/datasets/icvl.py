"""ICVL hand posture (Tang et al. 2014): about 22,000 genuine training frames, 1,596 test frames in two sequences."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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

INTRINSICS = Intrinsics(241.42, 241.42, 160.0, 120.0, 320, 240)
PALM = 0

ROTATED_COPY = 6
"""Folders whose names have at most this many characters hold rotated copies of frames. Those of genuine frames are
named by date."""


class ICVL(RecordedDataset):
    """`root`/{train.txt or labels.txt, test_seq_1.txt, test_seq_2.txt} and `root`/Depth/, or these under Training/ and
    Testing/, as distributed.

    The splits train and val hold the genuine training frames. Val is the sequence whose name is last. The split test
    has two sequences, which are also the splits test_1 and test_2.
    """

    skeleton = get_skeleton('icvl16')
    cube_side = 0.250

    def __init__(self, root: Path, split: str) -> None:
        self.name = f'icvl-{split}'
        training = split in ('train', 'val')
        files = {'train': ['labels.txt', 'train.txt'], 'val': ['labels.txt', 'train.txt'], 'test_1': ['test_seq_1.txt'],
                 'test_2': ['test_seq_2.txt']}
        if split == 'test':
            lists = [_find(root, 'Testing', files[part]) for part in ('test_1', 'test_2')]
        elif split in files:
            lists = [_find(root, 'Training' if training else 'Testing', files[split])]
        else:
            raise DatasetError(f"ICVL: unknown split '{split}': choose one of train, val, test, test_1, test_2")
        frames = [frame for path in lists for frame in _read(path)]
        if training:
            frames = [frame for frame in frames if len(_sequence(frame[0])) > ROTATED_COPY]
            if not frames:
                raise DatasetError(f'ICVL: {lists[0]} lists no genuine frames (in folders named by date)')
            last = max(_sequence(path) for path, _ in frames)
            frames = [frame for frame in frames if (_sequence(frame[0]) == last) == (split == 'val')]
            if not frames:
                raise DatasetError(f'ICVL: all genuine frames of {lists[0]} are of the sequence {last}, which '
                                   'validates; add another sequence for training')
        whole = are_labelled(np.array([uvd for _, uvd in frames]).reshape(-1, 16, 3))
        tell_left_out(self.name, int((~whole).sum()), len(whole))
        self._depth = lists[0].parent / 'Depth'
        self._frames = [frame for frame, usable in zip(frames, whole, strict=True) if usable]
        self.size = len(self._frames)
        images = require('ICVL', (self._depth / path for path, _ in self._frames))
        labels = (f'{path}{uvd.tolist()}'.encode() for path, uvd in self._frames)
        self.fingerprint = fingerprint(self.name, images, *labels)

    def frame(self, index: int) -> LabelledFrame:
        path, uvd = self._frames[index]
        depth = (read_depth(self._depth / path, 'ICVL', INTRINSICS) / 1000).astype(np.float32)
        joints = INTRINSICS.back_project(uvd[:, :2], uvd[:, 2] / 1000)
        return LabelledFrame(depth, INTRINSICS, joints, joints[PALM], self.cube_side)


def _find(root: Path, part: str, names: list[str]) -> Path:
    for folder in (root, root / part):
        for name in names:
            if (folder / name).is_file():
                return folder / name
    raise DatasetError(f'ICVL: neither {root} nor {root / part} holds {" or ".join(names)}; '
                       'give the folder of the dataset as its root')


def _sequence(path: str) -> str:
    return path.split('/')[0]


def _read(path: Path) -> list[tuple[str, np.ndarray]]:
    """For each line, the image path and (16, 3) u, v in pixels and depth in mm. Blank lines are skipped."""
    frames = []
    try:
        text = path.read_text()
    except UnicodeDecodeError:
        raise DatasetError(f'ICVL: {path} is not text; unpack it if it is packed, or download it again') from None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words:
            continue
        try:
            frames.append((words[0], np.array(words[1:], np.float64).reshape(16, 3)))
        except ValueError as error:
            raise DatasetError(f'ICVL: line {number} of {path} is not an image path and 16 x (u v d); '
                               'is the file complete?') from error
    return frames
