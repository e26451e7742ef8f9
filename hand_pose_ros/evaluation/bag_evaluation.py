"""Runs the estimator on all depth images of a bag, or of many bags on all cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from datetime import timedelta
from itertools import islice, starmap
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from hand_pose_ros.bags import DepthBag, Frame
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.evaluation.ground_truth import read_truth, with_truth
from hand_pose_ros.evaluation.progress import Progress, silent
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.models.checkpoints import DEFAULT
from hand_pose_ros.processes import blocked, leave_with_parent
from hand_pose_ros.runtime import check_device, cores
from hand_pose_ros.skeleton import Skeleton

_T = TypeVar('_T')
_R = TypeVar('_R')
Outcome = Result | HandPoseError
AHEAD = 2
"""Number of images that are decoded before their turn."""
GRACE_S = 10.0
"""Seconds for a process to remove unfinished files, after the process that started it was killed."""


class Sink(Protocol):
    """Receives the hands of each image."""

    def add(self, image: Frame, hands: Sequence[HandEstimate]) -> None: ...


OpenSink = Callable[[Skeleton, Mapping[str, Any]], AbstractContextManager[Sink]]


@dataclass(frozen=True)
class Settings:
    """How bags are evaluated.

    Attributes:
        model, device: as in HandPoseEstimator.from_pretrained.
        num_threads: maximum number of threads of the network on the CPU; None = `runtime.default_threads()`.
        estimator: other arguments of HandPoseEstimator.
        bag: arguments of DepthBag, except the path.
        ground_truth: a file or a topic, see `ground_truth.read_truth`.
    """

    model: str | None = None
    device: str = 'auto'
    num_threads: int | None = None
    estimator: Mapping[str, Any] = field(default_factory=dict)
    bag: Mapping[str, Any] = field(default_factory=dict)
    ground_truth: str | None = None


def evaluate_bag(path: str | Path, settings: Settings, progress: Progress = silent,
                 open_sink: OpenSink | None = None) -> Result:
    """Estimate all depth images of a bag. On the CPU, the result is always the same to the last bit.

    - While an image is estimated, the next ones are read and decoded. So there are more images per second than the
      stage `total` suggests.
    - If there are several hands in an image, the first one counts. It is the one that has been tracked longest.
    - An image that cannot be decoded counts as an image without a hand.
    - If the bag is damaged, the images before the damage are evaluated.

    The notes of the result report the last two.

    Args:
        progress: wraps the images.
        open_sink: opens the sink that receives the hands, from the skeleton and the metadata of the estimator.

    Raises:
        InputError: the bag, the truth or the camera cannot be used, or no image can be decoded.
        CheckpointError: the weights do not exist or cannot be used.
    """
    estimator = HandPoseEstimator.from_pretrained(
        settings.model, device=settings.device, num_threads=settings.num_threads, **settings.estimator)
    truth = settings.ground_truth and read_truth(settings.ground_truth, path, estimator.skeleton)
    record = _Record(estimator)
    notes: list[str] = []
    start = time.perf_counter()
    with ExitStack() as stack:
        bag = stack.enter_context(DepthBag(path, **settings.bag))
        sink = stack.enter_context(open_sink(estimator.skeleton, estimator.metadata)) if open_sink else None
        images = starmap(_Image, until_damaged(bag, notes))
        done = stack.enter_context(closing(_in_background(record.add, images)))
        for image, hands in progress(done, len(bag)):
            if sink:
                sink.add(image.frame, hands)
        if record.intrinsics is None:
            raise InputError(f'{path}: there is no depth image to evaluate'
                             + (f' ({record.failures[0]})' if record.failures else ''))
    rate = len(record.stamps) / (time.perf_counter() - start)
    damaged = bool(notes)
    if record.failures:
        notes.append(f'{len(record.failures)} of {len(record.stamps)} images could not be used and count as images '
                     f'without a hand; the first: {record.failures[0]}')
    result = Result(
        name=Path(path).stem, skeleton=estimator.skeleton, intrinsics=record.intrinsics,
        predictions=np.stack(record.joints), stamps_ns=np.array(record.stamps), hand_ids=np.array(record.ids),
        notes=tuple(notes),
        seconds={stage: np.array(values) for stage, values in record.seconds.items()},
        info={'bag': str(path), 'depth_topic': bag.depth_topic, 'model': str(settings.model or DEFAULT),
              'engine': estimator.engine.name, 'frames_per_s': round(rate, 1), 'damaged': damaged})
    return with_truth(result, truth, record.frame_id) if truth else result


def evaluate_bags(paths: Sequence[str | Path], settings: Settings, jobs: int | None = None,
                  progress: Progress = silent,
                  open_sinks: Mapping[str | Path, OpenSink] | None = None) -> Iterator[tuple[str | Path, Outcome]]:
    """Evaluate many bags at once. A bag that fails does not stop the others.

    If torchrun started several processes, on one or more machines, each evaluates its share of the bags, on a GPU of
    its own as far as there are enough. In the end, the first process yields all results, and the others yield none.

    Args:
        jobs: number of bags at the same time on this machine; None = one per core.
        progress: wraps the finished bags.
        open_sinks: `open_sink` of `evaluate_bag` for each bag. They are sent to other processes.

    Yields:
        Each path with its result or its error, as soon as it is done.
    """
    world, rank = int(os.environ.get('WORLD_SIZE', 1)), int(os.environ.get('RANK', 0))
    here = int(os.environ.get('LOCAL_WORLD_SIZE', 1))
    mine = paths[rank::world]
    share = max(1, cores() // here)
    workers = max(1, min(jobs or share, len(mine)))
    settings = replace(settings, num_threads=settings.num_threads or max(1, share // workers))
    finished = progress(_attempts(mine, settings, open_sinks or {}, workers), len(mine))
    yield from finished if world == 1 else _gather(dict(finished), rank, world).items()


def read_depths(path: str | Path, rows: Sequence[int], settings: Settings) -> dict[int, NDArray[np.float32]]:
    """The depth images (H, W) in metres of some rows of a result. Images that cannot be decoded are left out."""
    depths = {}
    with DepthBag(path, **settings.bag) as bag:
        for row, frame in enumerate(islice(bag, max(rows, default=-1) + 1)):
            if row in rows:
                with suppress(InputError):
                    depths[row] = frame.depth
    return depths


class _Image:
    """A frame with its decoded depth and intrinsics, or the error if it cannot be decoded."""

    def __init__(self, frame: Frame, read: float) -> None:
        """`read` is the time that reading the frame took, in seconds."""
        self.frame = frame
        self.error: InputError | None = None
        start = time.perf_counter()
        try:
            self.depth, self.intrinsics = frame.depth, frame.intrinsics
        except InputError as error:
            self.error = error
        self.seconds = {'read': read, 'decode': time.perf_counter() - start}


class _Record:
    """The joints and times of all images, in order."""

    def __init__(self, estimator: HandPoseEstimator) -> None:
        self._estimator = estimator
        self.stamps: list[int] = []
        self.joints: list[NDArray[np.float64]] = []
        self.ids: list[str] = []
        self.seconds: dict[str, list[float]] = {}
        self.failures: list[str] = []
        self.intrinsics: Intrinsics | None = None
        self.frame_id = ''

    def add(self, image: _Image) -> list[HandEstimate]:
        """Estimate the hands of an image. Their joints and the times of the stages are kept."""
        hands: list[HandEstimate] = []
        times: dict[str, float] = {}
        try:
            if image.error:
                raise image.error
            start = time.perf_counter()
            hands = self._estimator(image.depth, image.intrinsics)
            estimated = time.perf_counter() - start
            times = {**image.seconds, **self._estimator.timings, 'total': sum(image.seconds.values()) + estimated}
            self.intrinsics = self.intrinsics or image.intrinsics
        except InputError as error:
            self.failures.append(f'image {len(self.stamps) + 1}: {error}')
        for stage in {**self.seconds, **times}:  # in the order in which they run
            self.seconds.setdefault(stage, [np.nan] * len(self.stamps)).append(times.get(stage, np.nan))
        self.stamps.append(image.frame.stamp_ns)
        self.frame_id = image.frame.frame_id
        self.ids.append(hands[0].id if hands else '')
        self.joints.append(hands[0].joints.astype(np.float64) if hands
                           else np.full((len(self._estimator.skeleton), 3), np.nan))
        return hands


def _in_background(work: Callable[[_T], _R], items: Iterable[_T]) -> Generator[tuple[_T, _R]]:
    """Each item with the result of the work on it, in order. A thread does the work while the next items are made."""
    with ThreadPoolExecutor(1) as worker:
        pending: deque[tuple[_T, Future[_R]]] = deque()
        for item in items:
            pending.append((item, worker.submit(work, item)))
            if len(pending) > AHEAD:
                item, result = pending.popleft()
                yield item, result.result()
        for item, result in pending:
            yield item, result.result()


def until_damaged(frames: Iterable[Frame], notes: list[str]) -> Iterator[tuple[Frame, float]]:
    """The frames, each with the time in seconds that reading it took.

    They end where the bag is damaged, and a note is added.

    Raises:
        InputError: the bag is damaged before its first frame.
    """
    frame = None
    start = time.perf_counter()
    try:
        for frame in frames:
            yield frame, time.perf_counter() - start
            start = time.perf_counter()
    except InputError as error:
        if frame is None:
            raise
        notes.append(f'{error}; only the images before the damage are evaluated.')


def _attempts(paths: Sequence[str | Path], settings: Settings, sinks: Mapping[str | Path, OpenSink],
              workers: int) -> Iterator[tuple[str | Path, Outcome]]:
    """Each bag with its result or its error, as soon as it is done."""
    if workers == 1:  # in this process, because another one would have to load everything again
        for path in paths:
            yield path, _attempt(path, settings, sinks.get(path))
        return
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context('spawn'), _start_worker)
    try:
        with blocked(signal.SIGINT):  # Ctrl-C reaches all processes
            futures = {pool.submit(_work, path, settings, sinks.get(path)): path for path in paths}
        for future in as_completed(futures):
            path = futures[future]
            try:
                yield path, future.result()
            except Exception as error:  # the process itself died, for example without memory
                yield path, _unexpected(path, error)
    except BaseException:  # for example Ctrl-C
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)  # after Ctrl-C, no other bag is begun


def _start_worker() -> None:
    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second signal must not interrupt the clean-up
        sys.exit(1)  # unlike a KeyboardInterrupt, it leaves no traceback

    signal.signal(signal.SIGTERM, stop)  # by default, it would leave half-written bags
    leave_with_parent(GRACE_S)


def _work(path: str | Path, settings: Settings, open_sink: OpenSink | None) -> Outcome:
    """`_attempt` in a process of the pool. If it must stop, it ends here, because the pool would begin the next bag."""
    try:
        return _attempt(path, settings, open_sink)
    except SystemExit:
        os._exit(1)


def _attempt(path: str | Path, settings: Settings, open_sink: OpenSink | None) -> Outcome:
    try:
        return evaluate_bag(path, replace(settings, device=_own_gpu(settings.device)), open_sink=open_sink)
    except HandPoseError as error:
        return error
    except Exception as error:  # a bug must not lose the results of the other bags
        return _unexpected(path, error)


def _own_gpu(device: str) -> str:
    """The device; for 'cuda' and 'auto' under torchrun, the GPU that belongs to this process."""
    if device not in ('auto', 'cuda') or 'LOCAL_RANK' not in os.environ or not torch.cuda.is_available():
        return device
    own = f'cuda:{int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count()}'
    if device == 'auto':
        try:
            check_device(own)
        except HandPoseError:  # it may still be another one, or the CPU
            return device
    return own


def _unexpected(path: str | Path, error: Exception) -> HandPoseError:
    return HandPoseError(f'{path}: stopped unexpectedly ({error!r})')


def _gather(done: dict[str | Path, Outcome], rank: int, world: int) -> dict[str | Path, Outcome]:
    """The results of all processes, in the first process. In the others, an empty dictionary."""
    import torch.distributed as dist

    dist.init_process_group('gloo', timeout=timedelta(days=7))  # other processes may have longer bags
    try:
        everything: list[dict[str | Path, Any]] | None = [{}] * world if rank == 0 else None
        dist.gather_object(done, everything)
    finally:
        dist.destroy_process_group()
    return {path: result for share in everything or [] for path, result in share.items()}
