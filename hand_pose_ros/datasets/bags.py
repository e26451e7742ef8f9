"""Bags with depth and, as labels, hand joints: your own recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hand_pose_ros.bags.reader import DepthBag, Frame, RecordedHands, check_frame, read_hands
from hand_pose_ros.datasets.base import DatasetError, LabelledFrame, RecordedDataset, fingerprint
from hand_pose_ros.skeleton import Skeleton, get_skeleton

SUFFIXES = ('.bag', '.mcap', '.db3')


class Bags(RecordedDataset):
    """`root`/{train,val,test}/ with bags in each, so that no recording is in two splits.

    Every hand of every HandJointsArray is a sample; its depth image is the one with the same stamp.
    """

    skeleton: Skeleton

    def __init__(self, root: Path, split: str) -> None:
        self.name = f'bags-{split}'
        bags = sorted(path for path in (root / split).glob('*')
                      if path.suffix in SUFFIXES or (path / 'metadata.yaml').exists())
        if not bags:
            raise DatasetError(f'bags: {root / split} holds no bags (.mcap, .bag, .db3, or folders with metadata.yaml)')
        self._samples: list[tuple[Path, RecordedHands, int]] = []
        for bag in bags:
            for hands in sorted(read_hands(bag), key=lambda hands: hands.stamp_ns):
                self._samples += [(bag, hands, i) for i in range(len(hands.joints))]
        names = {hands.skeleton for _, hands, _ in self._samples}
        if len(names) != 1:
            raise DatasetError(f'bags: {root / split} must hold hands of one skeleton, '
                               f'not of {", ".join(sorted(names)) or "none"}')
        self.skeleton = get_skeleton(names.pop())
        self.size = len(self._samples)
        self._reading: tuple[DepthBag, Iterator[Frame], Frame] | None = None
        self.fingerprint = fingerprint(self.name, *(
            f'{bag.stem}{hands.stamp_ns}{hands.joints[i].tolist()}'.encode() for bag, hands, i in self._samples))

    def frame(self, index: int) -> LabelledFrame:
        bag, hands, i = self._samples[index]
        frame = self._image(bag, hands.stamp_ns)
        check_frame(f'bags: {bag}', hands.frame_id, frame.frame_id)
        joints = hands.joints[i]
        return LabelledFrame(frame.depth, frame.intrinsics, joints, joints.mean(0), self.cube_side,
                             hands.sides[i] == 'left')

    def _image(self, bag: Path, stamp_ns: int) -> Frame:
        """A bag is read in the order of recording, so samples in the order of their index cost one pass over it."""
        if self._reading and (self._reading[0].path != bag or self._reading[2].stamp_ns > stamp_ns):
            self._reading[0].close()
            self._reading = None
        if self._reading is None:
            opened = DepthBag(bag)
            frames = iter(opened)
            self._reading = opened, frames, next(frames)
        opened, frames, frame = self._reading
        while frame.stamp_ns < stamp_ns:
            frame = next(frames, frame)
            if frame is self._reading[2]:
                break
            self._reading = opened, frames, frame
        if frame.stamp_ns != stamp_ns:
            raise DatasetError(f'bags: {bag} has hands with the stamp {stamp_ns} ns, but no depth image with it')
        return frame
