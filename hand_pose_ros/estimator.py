"""One depth image in, the joints of its hands out: detect, crop, predict, uncrop.

Numpy in and out; the networks run behind `runtime`. The estimator remembers the hands of the last image, so that the
next one need not be searched.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.detection import MAX_THROUGH, Region, candidates, holds_a_hand
from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import PATCH_SIZE, Cube, Intrinsics, crop
from hand_pose_ros.hand import HandEstimate, Side
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.models.dense import TOLD_SIZE
from hand_pose_ros.runtime import Engine, default_threads, make_engine
from hand_pose_ros.runtime.finder import Finder
from hand_pose_ros.scoring import explain, learned
from hand_pose_ros.skeleton import Skeleton, get_skeleton
from hand_pose_ros.smoothing import OneEuroFilter

__all__ = ['HandEstimate', 'HandPoseEstimator', 'Side']

RECENTER_M = 0.03
"""A cube whose centre is further than this from the middle of the joints it gave is moved there and read again. Half
this distance is no more accurate on synthetic images, and costs two and a half times as many second readings."""
READINGS = 3
"""How often at most: on synthetic images two readings find a hand more often than one, three more often than two."""
FALSE_ALARMS = 3
"""After so many objects that are no hand, the search is given up until the next image."""
SEARCH_EVERY = 5
"""While a hand is tracked, every so many images are worth a look at one more object: to search costs several times as
much as to track."""
HOPELESS = 0.1
"""Beside a hand, an object that scores less at first sight is not read again: it would cost the next image."""
FRAME_S = 1 / 30
"""Time between images for smoothing, where the caller does not say."""
SIDE_MEMORY = 0.95
"""What a hand has shown of its side fades by this factor each image: about twenty images decide."""
SETTLED = 5.0
"""A side that has shown itself by more than this (logits) is not doubted until that has faded: about every
thirtieth image. The scores of networks that do not judge sides never get there."""
USUAL_SIZE = 0.166
"""Metres from the wrist along the bones to the tip of the middle finger, of the hand that a usual cube is for."""
SIZE_IMAGES = 10
"""So many images of a hand make half of what it tells of its size believed: a cube that fits is seen better."""


@dataclass
class _Track:
    """A hand that was seen in the last image."""

    id: str
    center: NDArray[np.float64]
    rightness: float = 0.0  # > 0: has looked more like a right hand
    sizes: float = 0.0  # sum of logarithms of its size over the usual one
    images: int = 0
    filter: OneEuroFilter | None = None

    @property
    def scale(self) -> float:
        """Of its cube."""
        return float(np.exp(np.clip(self.sizes / (self.images + SIZE_IMAGES), -0.2, 0.2)))


@dataclass(frozen=True)
class _Reading:
    """What the network says of one cube: joints in metres, and how far it looked like a right hand."""

    cube: Cube
    joints: NDArray[np.float64]
    confidence: NDArray[np.float32]
    score: float
    rightness: float
    size: float  # logarithm of the hand's over the usual one


@dataclass
class HandPoseEstimator:
    """Depth images to 3D hand joints.

    Args:
        engine: runs the network, `patches (N, 1, 128, 128) -> joints (N, J, 3)` in cube units of a right hand.
        skeleton: the joints that the network gives.
        find: where hands may be, the best place first: `detection.candidates` (the nearest things, as in the paper) or
            a `runtime.finder.Finder`.
        cube_side: length of the cube's side in metres; the network was trained for about this size. While a hand is
            tracked, the usual one is scaled by the size that the network tells of the hand.
        side: 'auto' finds out which hand it is; 'left' or 'right' states it.
        max_hands: at most this many hands per image (the node and the command line take 2; evaluation, benchmarks and
            labels are about one).
        min_score: hands with a lower score are not reported; one beside another must begin with its square root.
        near, far: range in which hands are looked for, metres.
        tracking: look first where the hands of the last image were.
        smoothing: cutoff in Hz of a filter on the joints of a tracked hand at rest (see `smoothing`); 0 = none.
        metadata: of the weights, for whoever publishes or writes joints (see `models.checkpoints`).

    Raises:
        InputError: there is no such side or range, a number is out of its range, or not one hand to look for.
    """

    engine: Engine
    skeleton: Skeleton
    find: Callable[..., Iterable[Cube]] = candidates
    cube_side: float = 0.30
    side: Literal['auto', 'left', 'right'] = 'auto'
    max_hands: int = 1
    min_score: float = 0.4
    near: float = 0.1
    far: float = 1.5
    tracking: bool = True
    smoothing: float = 0.0
    metadata: dict[str, Any] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict, init=False)
    """Seconds that each stage of the last image took: detect, crop, predict, uncrop."""

    def __post_init__(self) -> None:
        if self.side not in ('auto', 'left', 'right'):
            raise InputError(f"unknown side '{self.side}': choose auto, left or right")
        if self.max_hands < 1:
            raise InputError(f'max_hands is {self.max_hands}: at least one hand is to be looked for')
        if not 0 <= self.near < self.far:
            raise InputError(f'hands are looked for between near and far, which are {self.near} and {self.far} m: near '
                             'must be less, and not negative')
        if not (0 < self.cube_side < math.inf and 0 <= self.smoothing < math.inf and math.isfinite(self.min_score)):
            raise InputError(
                f'cube_side is {self.cube_side}, smoothing {self.smoothing} and min_score {self.min_score}: '
                'the first must be more than 0, the second not negative, and all finite')
        self._tracks: list[_Track] = []
        self._ids = count(1)
        self._last_s: float | None = None
        self._dismissed: list[Cube] = []
        self._since_search = 0

    @classmethod
    def from_pretrained(cls, model: str | PathLike[str] | None = None, *, device: str = 'auto',
                        num_threads: int | None = None, detector: Literal['network', 'nearest'] = 'network',
                        **options: Any) -> HandPoseEstimator:
        """An estimator with trained weights.

        Args:
            model: name of weights that ship, or path of a checkpoint; None takes the default.
            device: 'auto', 'cpu', 'cuda' or 'cuda:N'.
            num_threads: for the networks on the CPU; None chooses by the number of cores.
            detector: how hands are found: by a network of their own, or as in the paper, as what is nearest.
            options: the other arguments of the class.

        Raises:
            CheckpointError: there are no such weights, or they are damaged.
            InputError: there is no such detector.
        """
        if detector not in ('network', 'nearest'):
            raise InputError(f"unknown detector '{detector}': choose network or nearest")
        checkpoint = load_checkpoint(model)
        engine = make_engine(checkpoint.network, device=device, num_threads=num_threads, refiner=checkpoint.refiner)
        options.setdefault('cube_side', checkpoint.metadata['cube_side'])
        if detector == 'network' and 'find' not in options:
            options['find'] = Finder.from_pretrained(num_threads=num_threads or default_threads())
        return cls(engine, get_skeleton(checkpoint.metadata['skeleton']), metadata=checkpoint.metadata, **options)

    def warm_up(self) -> None:
        """Let the engine prepare itself, so that the first image is answered as fast as the others."""
        for patches in (1, 2):  # of one side, and of both
            self.engine.run_full(np.ones((patches, 1, PATCH_SIZE, PATCH_SIZE), np.float32))

    def reset(self) -> None:
        """Forget the hands of the last image."""
        self._tracks.clear()

    def __call__(self, depth: NDArray[np.float32], intrinsics: Intrinsics, *, time_s: float | None = None,
                 regions: Sequence[Region] | None = None) -> list[HandEstimate]:
        """The hands in a depth image: tracked ones first, then those newly found, the likeliest first.

        Args:
            depth: (H, W) float32 metres, 0 = no reading.
            intrinsics: of this very image.
            time_s: when it was taken, for smoothing; without it, images are 1/30 s apart.
            regions: look for new hands in these rectangles of the image (x, y, width, height) instead of everywhere.

        Raises:
            InputError: the image is of another type or size than described.
        """
        if depth.ndim != 2 or depth.dtype != np.float32:
            raise InputError(f'a depth image must be (H, W) float32 in metres, not {depth.shape} {depth.dtype}: '
                             'decode it with hand_pose_ros.depth')
        intrinsics.check_size(depth.shape[1], depth.shape[0])
        intrinsics.check_lens()
        self.timings = dict.fromkeys(('detect', 'crop', 'predict', 'uncrop'), 0.0)

        elapsed = 0.0 if time_s is None or self._last_s is None else time_s - self._last_s
        # Two images of one time are of a driver that does not tell it.
        dt = elapsed if 0 < elapsed < math.inf else FRAME_S
        self._last_s = time_s

        hands: list[HandEstimate] = []
        tracks, self._tracks = self._tracks if self.tracking else [], []  # what goes wrong with one is not met again
        for track in tracks:
            usual = self.cube_side == self.metadata.get('cube_side')  # another was chosen with a hand in mind
            cube = Cube.at(track.center, self.cube_side * (track.scale if usual else 1))
            with self._timed('detect'):
                alive = len(hands) < self.max_hands and holds_a_hand(
                    depth, intrinsics, cube, near=self.near, far=self.far,
                    max_through=1 if 'hand' in self.engine.outputs else MAX_THROUGH)
            reading = self._read(depth, intrinsics, cube, track) if alive else None
            if reading is not None and reading.score >= self.min_score and not _overlaps(reading.cube, hands):
                self._tracks.append(track)
                hands.append(self._follow(track, reading, dt))
        self._find(depth, intrinsics, hands, dt, regions)
        return hands

    def _find(self, depth: NDArray[np.float32], intrinsics: Intrinsics, hands: list[HandEstimate], dt: float,
              regions: Sequence[Region] | None) -> None:
        """Search for hands, add them to `hands`, and track them.

        Without a hand, everything near is searched at once. Beside a tracked hand there is mostly none: then only every
        so many images are searched, for one object that was not looked at before, until all were.
        """
        self._since_search += 1
        if not hands or len(hands) >= self.max_hands:
            self._dismissed.clear()
        if len(hands) >= self.max_hands or (hands and self._since_search < SEARCH_EVERY):
            return
        self._since_search, alarms = 0, 1 if hands else FALSE_ALARMS
        with self._timed('detect'):
            cubes = iter(self.find(depth, intrinsics, side=self.cube_side, near=self.near, far=self.far,
                                   regions=regions))
        # Objects that prove to be no hand must not hide one behind them, nor cost time without end.
        while alarms > 0 and len(hands) < self.max_hands:
            with self._timed('detect'):
                found = next(cubes, None)
            if found is None:
                self._dismissed.clear()
                break
            if _overlaps(found, hands, self._dismissed):
                continue
            track = _Track(id='', center=np.array(found.center))
            reading = self._read(depth, intrinsics, found, track, HOPELESS if hands else 0.0)
            # Where there is a hand, a face or an elbow beside it often scores min_score, hardly ever its square root.
            enough = max(self.min_score, 0) ** 0.5 if hands else self.min_score
            if reading.score < enough or _overlaps(reading.cube, hands):
                self._dismissed.append(found)
                alarms -= 1
                continue
            track.id = f'hand_{next(self._ids)}'
            self._tracks.append(track)
            hands.append(self._follow(track, reading, dt))
            if self.tracking:  # else what comes next would never be looked at
                alarms = min(alarms, 1)

    def _read(self, depth: NDArray[np.float32], intrinsics: Intrinsics, cube: Cube, track: _Track,
              hopeless: float = 0.0) -> _Reading:
        """Look into a cube, and again where its joints are: from an arm that was found first, to the hand.

        What scores less than `hopeless` is not read again.
        """
        reading = self._predict(depth, intrinsics, cube, track)
        for _ in range(READINGS - 1):
            center = reading.joints.mean(axis=0)
            if (np.linalg.norm(center - reading.cube.center) <= RECENTER_M or center[2] <= self.near
                    or reading.score < hopeless):
                break
            reading = self._predict(depth, intrinsics, Cube.at(center, cube.side), track)
        # Joints that are not in front of the camera are no hand, whatever the network thinks of them.
        return reading if reading.joints[:, 2].mean() > 0 else replace(reading, score=-1.0)

    def _predict(self, depth: NDArray[np.float32], intrinsics: Intrinsics, cube: Cube, track: _Track) -> _Reading:
        with self._timed('crop'):
            patch = crop(depth, cube, intrinsics)
            mirrored = self._mirrorings(track)
            patches = np.stack([patch[..., ::-1] if mirror else patch for mirror in mirrored])
        with self._timed('predict'):
            answer = self.engine.run_full(patches)
        with self._timed('uncrop'):
            confidence, score, right = self._judge(patches, answer, cube)
            rightness = float(right[0] - right[-1])
            shown = int(len(mirrored) == 2 and SIDE_MEMORY * track.rightness + rightness < 0)
            coordinates = answer['joints'][shown].astype(np.float64)
            if mirrored[shown]:
                coordinates[:, 0] *= -1
            size = 0.0
            if 'size' in answer and self.skeleton.has_wrist:  # else it has not learned what it tells
                size = float(answer['size'][shown]) + math.log(TOLD_SIZE * cube.side / USUAL_SIZE)
            return _Reading(cube, cube.from_cube(coordinates), confidence[shown], float(score[shown]), rightness, size)

    def _mirrorings(self, track: _Track) -> tuple[bool, ...]:
        """The network knows right hands: a left one is shown to it in the mirror, and of an unknown one, both."""
        if self.side != 'auto':
            return (self.side == 'left',)
        return (track.rightness < 0,) if abs(track.rightness) > SETTLED else (False, True)

    def _judge(self, patches: NDArray[np.float32], answer: dict[str, NDArray[np.float32]], cube: Cube,
               ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Confidence of the joints (N, J), score (N,), and how far each looks like a right hand (N,), of N patches.

        See `scoring`.
        """
        if 'confidence' in answer:
            return *learned(answer['confidence'], answer['hand']), answer['side']
        judged = [explain(patch, joints, cube.side, self.skeleton)
                  for patch, joints in zip(patches, answer['joints'], strict=True)]
        score = np.array([score for _, score in judged], np.float32)
        return np.stack([confidence for confidence, _ in judged]), score, score

    def _follow(self, track: _Track, reading: _Reading, dt: float) -> HandEstimate:
        track.rightness = SIDE_MEMORY * track.rightness + reading.rightness
        track.sizes, track.images = track.sizes + reading.size, track.images + 1
        joints = reading.joints
        track.center = joints.mean(axis=0)
        if self.smoothing > 0:
            if track.filter is None or track.filter.cutoff_hz != self.smoothing:
                track.filter = OneEuroFilter(self.smoothing)
            joints = track.filter(joints, dt)
        else:
            track.filter = None  # which would remember where the hand was when it is switched on again
        side: Side = self.side if self.side != 'auto' else 'right' if track.rightness >= 0 else 'left'
        return HandEstimate(joints.astype(np.float32), self.skeleton.joint_names, reading.confidence,
                            reading.score, side, reading.cube, track.id)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings[stage] += time.perf_counter() - start


def _overlaps(cube: Cube, hands: Iterable[HandEstimate], others: Iterable[Cube] = ()) -> bool:
    """Whether a cube looks at a hand that was already found, or at what one of the others looks at."""
    seen = [*(hand.cube for hand in hands), *others]
    return any(np.linalg.norm(np.subtract(cube.center, other.center)) < cube.side / 3 for other in seen)
