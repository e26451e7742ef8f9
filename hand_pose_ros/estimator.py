"""One depth image in, the joints of its hands out: detect, crop, predict, uncrop.

Input and output are numpy arrays. `runtime` runs the networks. The estimator remembers the hands of the last image, so
it does not need to search the next one.
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
from hand_pose_ros.models.dense import HAND_PER_CUBE
from hand_pose_ros.runtime import Engine, default_threads, make_engine
from hand_pose_ros.runtime.finder import Finder
from hand_pose_ros.scoring import explain, learned
from hand_pose_ros.skeleton import Skeleton, get_skeleton
from hand_pose_ros.smoothing import OneEuroFilter

__all__ = ['HandEstimate', 'HandPoseEstimator', 'Side']

RECENTER_M = 0.03
"""If the mean of the joints is further than this from the centre of their cube, the cube is moved to that mean and read
again. Half this distance is no more accurate on synthetic images, and needs two and a half times as many second
readings."""
READINGS = 3
"""Maximum number of readings of a cube. On synthetic images, two readings find a hand more often than one, and three
more often than two."""
FALSE_ALARMS = 3
"""After this many objects that are no hand, the search stops until the next image."""
SEARCH_EVERY = 5
"""While a hand is tracked, one image in this many is searched for one more object. Searching takes several times as
long as tracking."""
HOPELESS = 0.1
"""While there is another hand, an object whose first reading scores less than this is not read again. The time would be
missing for the next image."""
FRAME_S = 1 / 30
"""Time between images that smoothing assumes if the caller gives none."""
SIDE_MEMORY = 0.95
"""The evidence for the side of a hand fades by this factor with each image: about twenty images decide."""
SETTLED = 5.0
"""While the evidence for a side (logits) is more than this, the other side is not tried. It fades meanwhile, so both
sides are tried in about every thirtieth image. The scores of networks that do not judge sides never reach this value.
"""
USUAL_SIZE = 0.166
"""Size of the hand that a usual cube is made for: metres from the wrist along the bones to the tip of the middle
finger."""
SIZE_IMAGES = 10
"""After this many images of a hand, half of its measured size is believed. The network sees a hand better in a cube
that fits."""


@dataclass
class _Track:
    """A hand that was seen in the last image."""

    id: str
    center: NDArray[np.float64]
    rightness: float = 0.0  # > 0: so far it looks more like a right hand
    sizes: float = 0.0  # sum over the images of log(its size / the usual size)
    images: int = 0
    filter: OneEuroFilter | None = None

    @property
    def scale(self) -> float:
        """Factor by which its cube differs from the usual one."""
        return float(np.exp(np.clip(self.sizes / (self.images + SIZE_IMAGES), -0.2, 0.2)))


@dataclass(frozen=True)
class _Reading:
    """What the network says about one cube: joints in metres, and how much it looks like a right hand."""

    cube: Cube
    joints: NDArray[np.float64]
    confidence: NDArray[np.float32]
    score: float
    rightness: float
    size: float  # log(size of the hand / the usual size)


@dataclass
class HandPoseEstimator:
    """Depth images to 3D hand joints.

    Args:
        engine: runs the network, `patches (N, 1, 128, 128) -> joints (N, J, 3)` in cube units of a right hand.
        skeleton: the joints that the network predicts.
        find: returns the places where hands may be, the best place first. This is `detection.candidates` (the nearest
            objects, as in the paper) or a `runtime.finder.Finder`.
        cube_side: side of the cube in metres. The network was trained for about this size. While a hand is tracked, the
            size that the weights were trained for is scaled by the size of the hand, as the network measures it; any
            other size is kept.
        side: 'auto' finds out whether a hand is left or right; 'left' or 'right' fixes it.
        max_hands: maximum number of hands per image (the node and the command line use 2; evaluation, benchmarks and
            labels are about one hand).
        min_score: hands with a lower score are not reported. If there is another hand already, a new hand must reach
            the square root of this value at first.
        near, far: range in which hands are looked for, metres.
        tracking: look first where the hands of the last image were.
        smoothing: cutoff in Hz of the filter on the joints of a tracked hand, for a hand at rest (see `smoothing`);
            0 = no filter.
        metadata: of the weights. Whoever publishes or writes joints needs it (see `models.checkpoints`).

    Raises:
        InputError: the side or the range is invalid, a number is out of its range, or max_hands is less than 1.
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
    """Seconds for each stage of the last image: detect, crop, predict, uncrop."""

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
            model: name of weights that ship, or path of a checkpoint; None = the default weights.
            device: 'auto', 'cpu', 'cuda' or 'cuda:N'.
            num_threads: maximum number of threads for the networks on the CPU; None = chosen by the number of cores.
            detector: how hands are found: 'network' uses a network of its own; 'nearest' takes the nearest object, as
                in the paper.
            options: the other arguments of the class.

        Raises:
            CheckpointError: the weights do not exist, or they are damaged.
            HandPoseError: the device cannot be used here, num_threads is less than 1, or the network gives no joints.
            InputError: the detector does not exist, or one of the options is invalid.
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
        """Run the engine on empty patches, so that the first image does not take longer than the others."""
        for patches in (1, 2):  # one side, and both sides
            self.engine.run_full(np.ones((patches, 1, PATCH_SIZE, PATCH_SIZE), np.float32))

    def reset(self) -> None:
        """Forget the hands of the last image."""
        self._tracks.clear()

    def __call__(self, depth: NDArray[np.float32], intrinsics: Intrinsics, *, time_s: float | None = None,
                 regions: Sequence[Region] | None = None) -> list[HandEstimate]:
        """The hands in a depth image: first the tracked hands, then the new ones in the order in which they are found.

        Args:
            depth: (H, W) float32, metres, 0 = no reading.
            intrinsics: of this very image.
            time_s: time of the image in seconds, for smoothing. Without it, images are assumed to be 1/30 s apart.
            regions: look for new hands only in these rectangles of the image (x, y, width, height).

        Raises:
            InputError: the image has another type or shape, the intrinsics are for another size, or no lens can have
                them.
        """
        if depth.ndim != 2 or depth.dtype != np.float32:
            raise InputError(f'a depth image must be (H, W) float32 in metres, not {depth.shape} {depth.dtype}: '
                             'decode it with hand_pose_ros.depth')
        intrinsics.check_size(depth.shape[1], depth.shape[0])
        intrinsics.check_lens()
        self.timings = dict.fromkeys(('detect', 'crop', 'predict', 'uncrop'), 0.0)

        elapsed = 0.0 if time_s is None or self._last_s is None else time_s - self._last_s
        # Two images with the same time come from a driver that does not set it.
        dt = elapsed if 0 < elapsed < math.inf else FRAME_S
        self._last_s = time_s

        hands: list[HandEstimate] = []
        # Forget the tracks first: if one of them raises an error, the next image must not meet it again.
        tracks, self._tracks = self._tracks if self.tracking else [], []
        for track in tracks:
            usual = self.cube_side == self.metadata.get('cube_side')  # else the user chose the size for a certain hand
            cube = Cube.at(track.center, self.cube_side * (track.scale if usual else 1))
            with self._timed('detect'):
                alive = len(hands) < self.max_hands and holds_a_hand(
                    depth, intrinsics, cube, near=self.near, far=self.far,
                    max_through=1 if 'hand' in self.engine.outputs else MAX_THROUGH)
            reading = self._read(depth, intrinsics, cube, track) if alive else None
            if reading is not None and reading.score >= self.min_score and not _overlaps(reading.cube, hands):
                hands.append(self._follow(track, reading, dt))
        self._find(depth, intrinsics, hands, dt, regions)
        return hands

    def _find(self, depth: NDArray[np.float32], intrinsics: Intrinsics, hands: list[HandEstimate], dt: float,
              regions: Sequence[Region] | None) -> None:
        """Search for hands, add them to `hands`, and track them.

        Without a hand, all objects in range are searched at once, up to FALSE_ALARMS that are no hand. If a hand is
        tracked, there is mostly no other one. So only one image in SEARCH_EVERY is searched, for one object that was
        not looked at before. When all were looked at, this starts again.
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
        # Objects that prove to be no hand must not hide a hand behind them. But they must not take endless time, too.
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
            # Beside a hand, a face or an elbow often reaches min_score, but hardly ever its square root.
            enough = max(self.min_score, 0) ** 0.5 if hands else self.min_score
            if reading.score < enough or _overlaps(reading.cube, hands):
                self._dismissed.append(found)
                alarms -= 1
                continue
            track.id = f'hand_{next(self._ids)}'
            hands.append(self._follow(track, reading, dt))
            if self.tracking:  # else the next objects would never be looked at
                alarms = min(alarms, 1)

    def _read(self, depth: NDArray[np.float32], intrinsics: Intrinsics, cube: Cube, track: _Track,
              hopeless: float = 0.0) -> _Reading:
        """Read a cube, move it to the joints that were found, and read again: from an arm that was found to the hand.

        A cube that scores less than `hopeless` is not read again.
        """
        reading = self._predict(depth, intrinsics, cube, track)
        for _ in range(READINGS - 1):
            center = reading.joints.mean(axis=0)
            if (np.linalg.norm(center - reading.cube.center) <= RECENTER_M or center[2] <= self.near
                    or reading.score < hopeless):
                break
            reading = self._predict(depth, intrinsics, Cube.at(center, cube.side), track)
        # Joints behind the camera are no hand, whatever the network says.
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
            rightness = float(right[0] - right[-1])  # 0 if the network saw one side only
            shown = int(len(mirrored) == 2 and SIDE_MEMORY * track.rightness + rightness < 0)
            coordinates = answer['joints'][shown].astype(np.float64)
            if mirrored[shown]:
                coordinates[:, 0] *= -1
            size = 0.0
            if 'size' in answer and self.skeleton.has_wrist:  # without a wrist, the network has not learned the size
                size = float(answer['size'][shown]) + math.log(HAND_PER_CUBE * cube.side / USUAL_SIZE)
            return _Reading(cube, cube.from_cube(coordinates), confidence[shown], float(score[shown]), rightness, size)

    def _mirrorings(self, track: _Track) -> tuple[bool, ...]:
        """Whether to mirror the patch, for each time that the network sees it.

        The network knows right hands only. A left hand is mirrored. If the side is unknown, the network sees both.
        """
        if self.side != 'auto':
            return (self.side == 'left',)
        return (track.rightness < 0,) if abs(track.rightness) > SETTLED else (False, True)

    def _judge(self, patches: NDArray[np.float32], answer: dict[str, NDArray[np.float32]], cube: Cube,
               ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """For N patches: confidence of the joints (N, J), score (N,), and how much it looks like a right hand (N,).

        See `scoring`.
        """
        if 'confidence' in answer:
            return *learned(answer['confidence'], answer['hand']), answer['side']
        judged = [explain(patch, joints, cube.side, self.skeleton)
                  for patch, joints in zip(patches, answer['joints'], strict=True)]
        score = np.array([score for _, score in judged], np.float32)
        return np.stack([confidence for confidence, _ in judged]), score, score

    def _follow(self, track: _Track, reading: _Reading, dt: float) -> HandEstimate:
        """The hand that was read. In the next image, it is tracked."""
        self._tracks.append(track)
        track.rightness = SIDE_MEMORY * track.rightness + reading.rightness
        track.sizes, track.images = track.sizes + reading.size, track.images + 1
        joints = reading.joints
        track.center = joints.mean(axis=0)
        if self.smoothing > 0:
            if track.filter is None or track.filter.cutoff_hz != self.smoothing:
                track.filter = OneEuroFilter(self.smoothing)
            joints = track.filter(joints, dt)
        else:
            track.filter = None  # when it is switched on again, it must not remember where the hand was before
        side: Side = self.side if self.side != 'auto' else 'right' if track.rightness >= 0 else 'left'
        return HandEstimate(joints.astype(np.float32), self.skeleton.joint_names, reading.confidence,
                            reading.score, side, reading.cube, track.id)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings[stage] += time.perf_counter() - start


def _overlaps(cube: Cube, hands: Iterable[HandEstimate], others: Iterable[Cube] = ()) -> bool:
    """Whether a cube is at a hand that was already found, or at one of the other cubes."""
    seen = [*(hand.cube for hand in hands), *others]
    return any(np.linalg.norm(np.subtract(cube.center, other.center)) < cube.side / 3 for other in seen)
