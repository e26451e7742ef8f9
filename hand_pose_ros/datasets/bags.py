"""Your own recordings: bags with depth images, and with hand joints as labels."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hand_pose_ros.bags.reader import DepthBag, Frame, RecordedHands, check_frame, read_hands
from hand_pose_ros.datasets.base import (
    DatasetError,
    LabelledFrame,
    RecordedDataset,
    are_labelled,
    fingerprint,
    require,
    tell_left_out,
)
from hand_pose_ros.skeleton import Skeleton, get_skeleton

log = logging.getLogger(__name__)

SUFFIXES = ('.bag', '.mcap', '.db3')

_Sample = tuple[Path, RecordedHands, int]
"""A bag, the hands of one image, and which of them."""


class Bags(RecordedDataset):
    """The bags in `root`/{train,val,test}/, so that no recording is in two splits.

    Every hand of every HandJointsArray is a sample. Its depth image is the one with the same stamp. Hands that lack a
    joint are left out, and hands whose side is unknown are taken for right hands. The log says how many.
    """

    skeleton: Skeleton

    def __init__(self, root: Path, split: str) -> None:
        self.name = f'bags-{split}'
        bags = sorted(path for path in (root / split).glob('*')
                      if path.suffix in SUFFIXES or (path / 'metadata.yaml').exists())
        if not bags:
            raise DatasetError(f'bags: {root / split} holds no bags (.mcap, .bag, .db3, or folders with metadata.yaml)')
        self._samples = [sample for bag in bags for sample in _read(bag)]
        names = {hands.skeleton for _, hands, _ in self._samples}
        if len(names) != 1:
            raise DatasetError(f'bags: {root / split} must hold hands of one skeleton, '
                               f'not of {", ".join(sorted(names)) or "none"}')
        self.skeleton = get_skeleton(names.pop())
        self.size = len(self._samples)
        self._reading: tuple[Path, Iterator[Frame], Frame] | None = None
        self.fingerprint = fingerprint(self.name, *map(_contents, bags), *(
            f'{bag.stem}{hands.stamp_ns}{hands.sides[i]}{hands.joints[i].tolist()}'.encode()
            for bag, hands, i in self._samples))

    def frame(self, index: int) -> LabelledFrame:
        bag, hands, i = self._samples[index]
        frame = self._image(bag, hands.stamp_ns)
        check_frame(f'bags: {bag}', hands.frame_id, frame.frame_id)
        joints = hands.joints[i]
        return LabelledFrame(frame.depth, frame.intrinsics, joints, joints.mean(0), self.cube_side,
                             hands.sides[i] == 'left')

    def _image(self, bag: Path, stamp_ns: int) -> Frame:
        """The depth image with this stamp.

        A bag is read in the order of recording. So samples in the order of their index cost one pass over it, and
        another one wherever stamps are not in the order of recording.
        """
        attempts = [_images(bag)]  # a generator, which opens the bag only when it is needed
        if self._reading and self._reading[0] == bag:
            _, images, last = self._reading
            if last.stamp_ns == stamp_ns:
                return last
            if last.stamp_ns < stamp_ns:
                attempts.insert(0, images)
        for images in attempts:
            for frame in images:
                if frame.stamp_ns == stamp_ns:
                    self._reading = bag, images, frame
                    return frame
        raise DatasetError(f'bags: {bag} has hands with the stamp {stamp_ns} ns, but no depth image with it')


def _read(bag: Path) -> list[_Sample]:
    """The hands of a bag in the order of their stamps."""
    samples: list[_Sample] = []
    count = 0
    for hands in sorted(read_hands(bag), key=lambda hands: hands.stamp_ns):
        samples += [(bag, hands, i) for i in np.flatnonzero(are_labelled(hands.joints)).tolist()]
        count += len(hands.joints)
    tell_left_out(f'bags: {bag}', count - len(samples), count)
    sideless = sum(hands.sides[i] == 'unknown' for _, hands, i in samples)
    if sideless and multiprocessing.parent_process() is None:
        log.warning('bags: %s: the side of %s of %s hands is unknown, so they are taken for right hands; write the '
                    'side of those that are left hands', bag, sideless, len(samples))
    return samples


def _images(bag: Path) -> Iterator[Frame]:
    with DepthBag(bag) as opened:
        yield from opened


def _contents(bag: Path) -> bytes:
    """Bytes that change with the depth and the cameras in a bag."""
    return require('bags', sorted(path for path in bag.rglob('*') if path.is_file()) if bag.is_dir() else [bag])
