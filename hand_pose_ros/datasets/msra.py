"""MSRA15 hand gestures (Sun et al. 2015): 9 subjects, 17 gestures, about 76,400 frames; one subject is left out."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hand_pose_ros.datasets.base import (
    DatasetError,
    LabelledFrame,
    RecordedDataset,
    are_labelled,
    check_depth,
    fingerprint,
    require,
    tell_left_out,
)
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import get_skeleton

INTRINSICS = Intrinsics(241.42, 241.42, 160.0, 120.0, 320, 240)
SEED = 5  # root of the middle finger
CUBE_SIDES = (0.2, 0.2, 0.2, 0.18, 0.18, 0.18, 0.17, 0.16, 0.15)
"""Sides of the cubes by subject, in metres, as in the original code. They contain knowledge of the size of the hand, so
every number that uses them must say so."""

FAULTY = {
    ('P2', 'TIP'): {*range(172, 175)}, ('P2', 'MP'): {*range(173, 176), *range(345, 355), 356, 359, 360},
    ('P3', 'T'): {120, 489}, ('P8', '4'): {168},
}
"""Frames with wrong labels, by number in the file name."""


class MSRA(RecordedDataset):
    """`root`/P0 ... P8/GESTURE/ with joint.txt and %06d_depth.bin, as distributed.

    Args:
        left_out: the subject that tests. The next one validates (after P8 comes P0), and the other seven train. If
            a model were chosen on the subject that tests, its error there would tell more about the choice than about
            the model.
    """

    skeleton = get_skeleton('msra21')
    cube_side = 0.180

    def __init__(self, root: Path, split: str, left_out: str = 'P0') -> None:
        subjects = [f'P{i}' for i in range(9)]
        if left_out not in subjects:
            raise DatasetError(f"MSRA: there is no subject '{left_out}': choose one of {', '.join(subjects)}")
        test = subjects.index(left_out)
        val = (test + 1) % 9
        parts = {'test': [test], 'val': [val], 'train': [i for i in range(9) if i not in (test, val)]}
        if split not in parts:
            raise DatasetError(f"MSRA: unknown split '{split}': choose one of {', '.join(parts)}")
        self.name = f'msra-{left_out}-{split}'
        self._frames: list[tuple[int, Path, np.ndarray]] = []
        for subject in parts[split]:
            folder = root / f'P{subject}'
            gestures = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
            if not gestures:
                raise DatasetError(f'MSRA: {folder} with its gestures is missing; give the folder that holds P0 to P8 '
                                   'as root')
            for gesture in gestures:
                self._frames += [(subject, *frame) for frame in _read_gesture(gesture)]
        whole = are_labelled(np.array([joints for _, _, joints in self._frames]))
        tell_left_out(self.name, int((~whole).sum()), len(whole))
        self._frames = [frame for frame, usable in zip(self._frames, whole, strict=True) if usable]
        self.size = len(self._frames)
        labels = (f'{path}{joints.tolist()}'.encode() for _, path, joints in self._frames)
        images = require('MSRA', (path for _, path, _ in self._frames))
        self.fingerprint = fingerprint(self.name, images, *labels)

    def frame(self, index: int) -> LabelledFrame:
        subject, path, joints = self._frames[index]
        depth = read_bin(path)
        check_depth('MSRA', path, depth, INTRINSICS)
        return LabelledFrame(depth, INTRINSICS, joints, joints[SEED], CUBE_SIDES[subject])


def read_bin(path: Path) -> np.ndarray:
    """Depth (H, W) float32 in metres, 0 = no reading.

    The file holds six int32 (width, height, left, top, right, bottom), and then the rows of that rectangle as float32
    in mm. Around the rectangle there is nothing.

    Raises:
        DatasetError: the file is missing, cut short or not of this format.
    """
    require('MSRA', [path])
    data = path.read_bytes()
    if len(data) >= 24:
        width, height, left, top, right, bottom = (int(value) for value in np.frombuffer(data, '<i4', 6))
        if (0 <= left <= right <= width <= 4096 and 0 <= top <= bottom <= height <= 4096
                and len(data) == 24 + 4 * (bottom - top) * (right - left)):
            depth = np.zeros((height, width), np.float32)
            part = np.frombuffer(data, '<f4', offset=24).reshape(bottom - top, right - left)
            depth[top:bottom, left:right] = part / 1000
            return depth
    raise DatasetError(f'MSRA: {path} is damaged ({len(data)} bytes); copy or download it again')


def _read_gesture(folder: Path) -> list[tuple[Path, np.ndarray]]:
    """Depth file and joints (21, 3) in metres of every frame. The number in the file name tells the label, because
    some numbers are missing."""
    labels = folder / 'joint.txt'
    require('MSRA', [labels])
    try:
        lines = labels.read_text().split('\n')
        joints = np.array([line.split() for line in lines[1:] if line.strip()], np.float64).reshape(-1, 21, 3)
        if len(joints) != int(lines[0]):
            raise ValueError(f'{len(joints)} of {lines[0].strip()} lines')
    except ValueError as error:  # a UnicodeDecodeError is one
        raise DatasetError(f'MSRA: {labels} is damaged ({error}); copy or download it again') from error
    joints *= (0.001, -0.001, -0.001)  # mm, y up, z towards the viewer -> m, optical frame
    faulty = FAULTY.get((folder.parent.name, folder.name), set())
    frames = []
    for path in sorted(folder.glob('*_depth.bin')):
        match = re.fullmatch(r'(\d{6})_depth\.bin', path.name)
        if match and (number := int(match[1])) not in faulty:
            if number >= len(joints):
                raise DatasetError(f'MSRA: {path} has no label, because {labels} has only {len(joints)} labels; '
                                   'copy or download them again')
            frames.append((path, joints[number]))
    if not frames:
        raise DatasetError(f'MSRA: {folder} holds labels but no depth images (000000_depth.bin and so on)')
    return frames
