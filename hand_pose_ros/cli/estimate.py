"""`hand-pose estimate`: the joints of every depth image of a bag or a folder, as numbers, as a bag and as pictures."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from hand_pose_ros.bags import DepthBag
from hand_pose_ros.cli.arguments import (
    add_bag,
    add_estimator,
    bag_options,
    check_intrinsics,
    count,
    keep_input,
    make_estimator,
    refuse,
)
from hand_pose_ros.cli.hand_bag import HandBag
from hand_pose_ros.depth import depth_problem, read_png
from hand_pose_ros.drawing import overlay
from hand_pose_ros.errors import InputError, counted
from hand_pose_ros.files import check_writable, in_one_step, write_bytes
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.skeleton import Skeleton

if TYPE_CHECKING:
    from hand_pose_ros.estimator import HandPoseEstimator

DESCRIPTION = 'Find the hand joints in every depth image of a bag or a folder; write numbers, a bag or pictures.'

EXAMPLES = """examples:
  hand-pose estimate recording.mcap --out joints.npz --overlay pictures
  hand-pose estimate old.bag --depth-topic /camera/depth/image_raw --out joints.mcap
  hand-pose estimate frames/ --intrinsics 363.9 363.9 255.4 206.3 --overlay pictures
  hand-pose estimate sr305.png --intrinsics 476.0 476.0 313.7 242.8 --depth-scale 0.000125 --out joints.npz

The .npz has a row for each hand: frame (which image), joints (J,3) in metres, confidence (J), score, side, id,
cube_center, cube_side; and once: names and stamp_ns of the images, joint_names, skeleton. The .mcap has the topics
/hand/joints, /hand/markers and /hand/skeleton. PNGs need --intrinsics. They have no time and count as 30 Hz.
"""
_PNG_PERIOD_NS = 33_333_333


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('input', metavar='INPUT', type=Path, help='a bag (ROS 1, sqlite3, MCAP), a 16-bit depth PNG, '
                        'or a folder of them')
    add_bag(parser)
    add_estimator(parser)
    parser.add_argument('--max-hands', type=count, default=2, metavar='N', help='at most N hands per image (2)')
    parser.add_argument('--out', type=Path, metavar='FILE', help='write the joints to this .npz or .mcap file')
    parser.add_argument('--overlay', type=Path, metavar='FOLDER',
                        help='write a picture of every image with its joints there')


def run(args: argparse.Namespace) -> int:
    """Estimate, write the outputs and print a summary. Returns 1 if any image could not be used."""
    if args.out and args.out.suffix not in ('.npz', '.mcap'):
        args.parser.error(f'--out {args.out}: the name must end in .npz or .mcap')
    if not args.input.exists():
        raise InputError(f'{args.input}: there is no such bag, PNG or folder: check the path')
    if not args.out and not args.overlay:
        args.parser.error('say what to write: --out FILE, --overlay FOLDER, or both')
    keep_input(args.out, args.input)
    keep_input(args.overlay, args.input.parent if args.input.suffix.lower() == '.png' else args.input)
    with ExitStack() as stack:
        images, number = _open(args, stack)
        estimator = make_estimator(args)
        outputs: list[Output] = []
        if args.overlay:
            outputs.append(_overlays(args.overlay, estimator.skeleton))
        if args.out and args.out.suffix == '.npz':
            outputs.append(stack.enter_context(_arrays(args.out, estimator.skeleton)))
        elif args.out:
            bag = stack.enter_context(HandBag(args.out, estimator.skeleton, estimator.metadata))
            outputs.append(lambda image, _depth, _intrinsics, hands: bag.add(image, hands))
        failed = estimate(images, number, estimator, outputs, stack)
    print('wrote', ' and '.join(str(path) for path in (args.out, args.overlay) if path))
    return failed


@dataclass(frozen=True)
class DepthInput:
    """One depth image. `load` returns its depth (H, W) in metres and its intrinsics, or raises InputError."""

    name: str
    stamp_ns: int
    frame_id: str
    recorded_ns: int
    load: Callable[[], tuple[NDArray[np.float32], Intrinsics]]


Output = Callable[[DepthInput, NDArray[np.float32], Intrinsics, Sequence[HandEstimate]], None]
"""Takes an image with its depth (H, W) in metres, its intrinsics and its hands, and writes them in one way."""


def estimate(images: Iterator[DepthInput], number: int, estimator: HandPoseEstimator, outputs: Sequence[Output],
             files: ExitStack) -> int:
    """Run the estimator over all images and pass the results to the outputs. Returns 1 if any image could not be used.

    Such images are reported and left out.

    Args:
        files: what is open. It is closed, and so the outputs are complete, before the summary is printed, which may
            fail.

    Raises:
        InputError: none of the images could be used.
    """
    found = failed = 0
    problem, said = '', ''
    seconds: list[float] = []
    for image in tqdm(images, total=number, unit='image', disable=None):
        try:
            depth, intrinsics = image.load()
            start = time.perf_counter()
            hands = estimator(depth, intrinsics)
            seconds.append(time.perf_counter() - start)
        except InputError as error:
            failed += 1
            if str(error) != said:  # mostly, the same is wrong with all of them
                tqdm.write(f'hand-pose estimate: {error}', file=sys.stderr)
            said = str(error)
            continue
        found += bool(hands)
        problem = problem or ('' if hands else depth_problem(depth, estimator.near, estimator.far))
        for output in outputs:
            output(image, depth, intrinsics, hands)
    done = len(seconds)
    if not done:
        raise InputError(f'none of the images ({failed}) could be used, so nothing was written')
    files.close()
    print(f'{counted(done, "images")}, {found} with a hand, {failed} that could not be used; '
          f'{1000 * float(np.median(seconds)):.1f} ms for the median image')
    if not found:
        hint = f'nothing had a score of {estimator.min_score:g} or more'
        hint += ', which networks with little training do not reach' if estimator.side == 'auto' else \
            f' as a {estimator.side} hand: if it may be the other hand, leave out --side'
        hint += '; --min-score 0 shows what is most like a hand'
        print(f'hand-pose estimate: {problem or hint}', file=sys.stderr)
    return 1 if failed else 0


def _open(args: argparse.Namespace, stack: ExitStack) -> tuple[Iterator[DepthInput], int]:
    """The images of the input, and how many there are."""
    candidates = list(args.input.iterdir()) if args.input.is_dir() else [args.input]
    paths = sorted((path for path in candidates if path.suffix.lower() == '.png'), key=_natural)
    if args.input.is_dir() and not paths and not any(
            path.suffix in ('.mcap', '.db3', '.yaml') for path in candidates):
        raise InputError(f'{args.input}: the folder holds neither 16-bit depth .png files nor a bag')
    if paths:
        if args.intrinsics is None:
            args.parser.error('PNGs have no camera_info: give --intrinsics FX FY CX CY')
        refuse(args, ('depth_topic', 'camera_info_topic'), 'is for bags: PNGs have no topics')
        check_intrinsics(args)
        for path in paths:  # any of them may be a link into the folder of the pictures
            keep_input(args.overlay and args.overlay / f'{path.stem}.png', path)
        return _from_pngs(paths, args.intrinsics, args.depth_scale), len(paths)
    bag = stack.enter_context(DepthBag(args.input, **bag_options(args)))
    return from_bag(bag), len(bag)


def _from_pngs(paths: Sequence[Path], intrinsics: Sequence[float], depth_scale: float) -> Iterator[DepthInput]:
    fx, fy, cx, cy = intrinsics

    def load(path: Path) -> tuple[NDArray[np.float32], Intrinsics]:
        depth = read_png(path, depth_scale)
        return depth, Intrinsics(fx, fy, cx, cy, width=depth.shape[1], height=depth.shape[0])

    for i, path in enumerate(paths):
        time_ns = i * _PNG_PERIOD_NS
        yield DepthInput(path.stem, time_ns, 'camera', time_ns, lambda path=path: load(path))  # type: ignore[misc]


def from_bag(bag: DepthBag) -> Iterator[DepthInput]:
    """The images of a bag. If it is damaged, one more follows, and to load this one raises the error."""
    i = 0
    try:
        for i, frame in enumerate(bag, start=1):
            yield DepthInput(f'{i - 1:06d}', frame.stamp_ns, frame.frame_id, frame.recorded_ns,
                             lambda frame=frame: (frame.depth, frame.intrinsics))  # type: ignore[misc]
    except InputError as error:
        def fail(error: InputError = error) -> tuple[NDArray[np.float32], Intrinsics]:
            raise error
        yield DepthInput(f'{i:06d}', 0, '', 0, fail)


def _natural(path: Path) -> list[Any]:
    """Sorts 30.png before 110.png."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', path.name)]


def _overlays(folder: Path, skeleton: Skeleton) -> Output:
    """Draws a picture of each image."""
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob('*.png')):
        print(f'NOTE: {folder} holds pictures already, and those of other images stay there', file=sys.stderr)

    def draw(image: DepthInput, depth: NDArray[np.float32], intrinsics: Intrinsics,
             hands: Sequence[HandEstimate]) -> None:
        picture = cv2.imencode('.png', overlay(depth, intrinsics, hands, skeleton))[1].tobytes()
        write_bytes(folder / f'{image.name}.png', picture)  # OpenCV itself crashes at names that are not UTF-8
    return draw


@contextmanager
def _arrays(path: Path, skeleton: Skeleton) -> Iterator[Output]:
    """Keeps all hands, and writes one .npz in the end. After an error, nothing is written."""
    check_writable(path)
    images: list[DepthInput] = []
    rows: list[tuple[int, HandEstimate]] = []

    def keep(image: DepthInput, _depth: Any, _intrinsics: Any, hands: Sequence[HandEstimate]) -> None:
        rows.extend((len(images), hand) for hand in hands)
        images.append(image)

    yield keep
    hands, joints = [hand for _, hand in rows], len(skeleton)
    with in_one_step(path) as part, part.open('wb') as file:
        np.savez_compressed(
            file,
            names=np.array([image.name for image in images]),
            stamp_ns=np.array([image.stamp_ns for image in images], np.int64),
            frame=np.array([frame for frame, _ in rows], np.int64),
            joints=np.array([hand.joints for hand in hands], np.float32).reshape(-1, joints, 3),
            confidence=np.array([hand.confidence for hand in hands], np.float32).reshape(-1, joints),
            score=np.array([hand.score for hand in hands], np.float32),
            side=np.array([hand.side for hand in hands], 'U7'),
            id=np.array([hand.id for hand in hands], 'U32'),
            cube_center=np.array([hand.cube.center for hand in hands], np.float32).reshape(-1, 3),
            cube_side=np.array([hand.cube.side for hand in hands], np.float32),
            joint_names=np.array(skeleton.joint_names),
            skeleton=np.array(skeleton.name))
