"""Arguments that several verbs have, and the types of their values. A bad value is refused in one sentence."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_pose_ros.errors import BagOptionError, HandPoseError, InputError, naming
from hand_pose_ros.files import check_writable
from hand_pose_ros.geometry import Intrinsics

if TYPE_CHECKING:
    from hand_pose_ros.estimator import HandPoseEstimator


def number(text: str, fits: Callable[[float], bool] = lambda _: True, why: str = '') -> float:
    """A number that fits. If it does not, `why` says what it is not."""
    try:
        value = float(text)
    except ValueError:  # of it, argparse would name the function
        raise argparse.ArgumentTypeError(f'{text} is not a number') from None
    if not fits(value):
        raise argparse.ArgumentTypeError(f'{text} is {why}')
    return value


def count(text: str, least: int = 1) -> int:
    """1 or more."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text} is not a whole number') from None
    if value < least:
        raise argparse.ArgumentTypeError(f'{text} is less than {least}')
    return value


def none_or_more(text: str) -> int:
    """0 or more."""
    return count(text, least=0)


def share(text: str) -> float:
    """0 to 1."""
    return number(text, lambda value: 0 <= value <= 1, 'not between 0 and 1')


def metres(text: str) -> float:
    """More than 0 and at most 1, as the unit of depth is."""
    return number(text, lambda value: 0 < value <= 1, 'not more than 0 and at most 1 (metres)')


def cube(text: str) -> float:
    """0.05 to 1 m, as the node takes it."""
    return number(text, lambda value: 0.05 <= value <= 1, 'not between 0.05 and 1 (metres)')


def keep_input(output: str | Path | None, source: str | Path | None) -> None:
    """Raise HandPoseError if an output would replace the input, or become a part of the bag that is the input.

    None means no file.
    """
    if not (output and source and Path(source).exists()):
        return
    inside = os.path.realpath(source) == os.path.dirname(os.path.realpath(output))
    same = Path(output).exists() and Path(output).samefile(source)
    if same or (inside and Path(output).suffix in ('.mcap', '.db3', '.yaml')):
        raise HandPoseError(f'{output}: this is the input, which would be lost: choose another place')


def check_outputs(outputs: Iterable[str | Path | None], sources: Sequence[str | Path | None]) -> None:
    """Raise HandPoseError if an output would replace a source or cannot be written. Call this before the work."""
    for output in outputs:
        for source in sources:
            keep_input(output, source)
        if output:
            check_writable(output)


def refuse(args: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that were given but do not apply. `why` follows the name of the option."""
    for name in names:
        if getattr(args, name) != args.parser.get_default(name):
            args.parser.error(f'--{name.replace("_", "-")} {why}')


def add_bag(parser: Any) -> None:
    """Add the options for reading depth from a bag."""
    parser.add_argument('--depth-topic', metavar='TOPIC',
                        help='topic of the depth images; needed if several topics carry depth')
    parser.add_argument('--camera-info-topic', metavar='TOPIC',
                        help='if it is not the camera_info beside the depth topic')
    parser.add_argument('--intrinsics', nargs=4, type=number, metavar=('FX', 'FY', 'CX', 'CY'),
                        help='of the camera, in pixels; they replace those of camera_info')
    parser.add_argument('--depth-scale', type=metres, default=0.001, metavar='M',
                        help='metres per unit of 16-bit depth (0.001)')


@contextmanager
def without_bag_options(remedy: str) -> Iterator[None]:
    """For a verb without the options of `add_bag`: if a bag needs one of them, end the message with the remedy."""
    try:
        yield
    except BagOptionError as error:
        raise InputError(f'{error}; {remedy}') from error


def check_intrinsics(args: argparse.Namespace) -> None:
    """Raise InputError if no camera has these --intrinsics. Call this before the work."""
    if args.intrinsics:
        with naming('--intrinsics'):
            fx, fy, cx, cy = args.intrinsics
            Intrinsics(fx, fy, cx, cy, width=1, height=1)


def bag_options(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments of `add_bag`, for `DepthBag`."""
    check_intrinsics(args)
    return {'depth_topic': args.depth_topic, 'camera_info_topic': args.camera_info_topic,
            'intrinsics': args.intrinsics and tuple(args.intrinsics), 'depth_scale': args.depth_scale}


ESTIMATOR = ('model', 'device', 'side', 'detector', 'cube_size', 'min_score')
"""What `add_estimator` adds."""


def add_estimator(parser: Any) -> None:
    """Add the options for estimating hands."""
    parser.add_argument('--model', help='name of weights that ship, or path of a checkpoint (hand_dense)')
    parser.add_argument('--device', default='auto', help='auto, cpu, cuda or cuda:N (auto)')
    parser.add_argument('--side', default='auto', choices=('auto', 'left', 'right'), help='which hand it is (auto)')
    parser.add_argument('--detector', default='network', choices=('network', 'nearest'),
                        help='how hands are found: by a network, or as what is nearest to the camera (network)')
    parser.add_argument('--cube-size', type=cube, metavar='M',
                        help='side of the cube around a hand, in metres (as the model was trained)')
    parser.add_argument('--min-score', type=share, metavar='S', help='leave out hands below this score (0.4)')


def estimator_options(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments of `add_estimator` without model and device, for `HandPoseEstimator.from_pretrained`."""
    given = {'side': args.side, 'detector': args.detector, 'cube_side': args.cube_size, 'min_score': args.min_score}
    return {name: value for name, value in given.items() if value is not None}


def make_estimator(args: argparse.Namespace) -> HandPoseEstimator:
    """The estimator with the arguments of `add_estimator` and --max-hands."""
    from hand_pose_ros.estimator import HandPoseEstimator  # imports torch: not for --help and bad arguments
    return HandPoseEstimator.from_pretrained(args.model, device=args.device, max_hands=args.max_hands,
                                             **estimator_options(args))
