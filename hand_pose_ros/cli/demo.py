"""`hand-pose demo`: play a bag through the live node, over real DDS, and draw what comes out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from hand_pose_ros.bags import DepthBag, RecordedHands, read_hands
from hand_pose_ros.cli.arguments import without_bag_options
from hand_pose_ros.drawing import Picture, contact_sheet, overlay
from hand_pose_ros.errors import InputError, counted
from hand_pose_ros.files import in_one_step, write_bytes, write_json
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.resources import resource
from hand_pose_ros.skeleton import Skeleton, get_skeleton

if TYPE_CHECKING:
    from hand_pose_ros.ros.live import Answers

TRUTH_TOPIC = '/truth/joints'
SHEET_PICTURES = 12
ANIMATION_HEIGHT = 320

DESCRIPTION = 'Play a bag through the real node, which runs in another process, and show what comes out.'

EXAMPLES = """examples:
  hand-pose demo
  hand-pose demo --out /tmp/demo
  hand-pose demo --bag recording.mcap --model my_weights.safetensors

It writes sheet.png, animation.webp (any browser shows it) and summary.json to the folder. The exit code is 0 if every
image was answered. The bag that ships shows a synthetic hand, as a simulated camera sees it.
"""

HINT = 'a bag that needs options is for `hand-pose evaluate --via-ros` or `hand-pose estimate --overlay`'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('--out', type=Path, default=Path('demo_output'), metavar='FOLDER',
                        help='where to write the results (demo_output)')
    parser.add_argument('--bag', type=Path,
                        help='play this bag instead of the one that ships; its ground truth, if any, is '
                        f'a HandJointsArray on {TRUTH_TOPIC}')
    parser.add_argument('--model', default='', help='name of weights that ship, or path of a checkpoint (hand_dense)')


@without_bag_options(HINT)
def run(args: argparse.Namespace) -> int:
    """Play the bag, draw the answers and print a summary. Returns 1 if an image got no answer."""
    from hand_pose_ros.evaluation.bag_evaluation import until_damaged
    from hand_pose_ros.ros.conversions import hand_from_msg
    from hand_pose_ros.ros.live import play_through_node

    path = args.bag or resource('demo/hand.mcap')
    args.out.mkdir(parents=True, exist_ok=True)  # now, not after minutes of work
    parameters = {'model': args.model} if args.model else {}
    with DepthBag(path) as bag:
        what = '' if args.bag else ' (a synthetic hand)'
        print(f'playing {counted(len(bag), "depth images")} of {path}{what} through the node ...', flush=True)
        answers = play_through_node(bag, parameters=parameters, patient=True)
        skeleton = get_skeleton(answers.skeleton)
        hands = {stamp: [hand_from_msg(hand, skeleton) for hand in answer.hands]
                 for stamp, answer in answers.hands.items()}
        stamps: list[int] = []
        shown: list[int] = []
        pictures: list[Picture] = []
        notes: list[str] = []
        for frame, _ in until_damaged(bag, notes):
            stamps.append(frame.stamp_ns)
            with suppress(InputError):  # it cannot be decoded, and the node reports it
                pictures.append(overlay(frame.depth, frame.intrinsics, hands.get(frame.stamp_ns, []), skeleton,
                                        ANIMATION_HEIGHT))
                shown.append(frame.stamp_ns)
    for note in notes:
        print(f'NOTE: {note}', file=sys.stderr)
    if not pictures:
        raise InputError(f'{path}: there is no depth image that can be decoded')
    summary = summarise(stamps, answers, hands, _truth(path, skeleton))
    chosen = np.linspace(0, len(pictures) - 1, min(SHEET_PICTURES, len(pictures))).round().astype(int)
    sheet = contact_sheet([pictures[i] for i in chosen], 3)
    write_bytes(args.out / 'sheet.png', cv2.imencode('.png', sheet)[1].tobytes())
    _animate(args.out / 'animation.webp', pictures, shown)
    write_json(args.out / 'summary.json', summary)
    for name, value in summary.items():
        if value is not None:
            print(f'  {name.replace("_", " "):<22}{value if isinstance(value, int) else f"{value:.1f}"}')
    print('latency: from the arrival of an image at a listener to the arrival of its joints there, with decoding (PNG '
          'in the bag that ships)')
    print(f'see {args.out / "sheet.png"} and {args.out / "animation.webp"}')
    if missing := sum(stamp not in answers.hands for stamp in stamps):
        print(f'hand-pose demo: {counted(missing, "images")} got no answer from the node: is the machine too busy?',
              file=sys.stderr)
    return int(missing > 0)


def summarise(stamps: Sequence[int], answers: Answers, hands: dict[int, list[HandEstimate]],
              truth: dict[int, RecordedHands]) -> dict[str, float | int | None]:
    """The numbers of the summary: times in ms, errors in mm, None for what is unknown.

    Args:
        stamps: of the images that were played, ns.
        hands: stamp -> the hands in the answer of the node.
        truth: stamp -> the true hands. The first hand of each is compared.
    """
    latency_ms = np.array([answers.latency_s[stamp] for stamp in stamps if stamp in answers.latency_s]) * 1e3
    errors_mm = [np.linalg.norm(hands[stamp][0].joints - truth[stamp].joints[0], axis=1) * 1e3
                 for stamp in stamps if hands.get(stamp) and stamp in truth and len(truth[stamp].joints)]
    return {
        'frames_in': len(stamps),
        'frames_answered': sum(stamp in answers.hands for stamp in stamps),
        'frames_with_a_hand': sum(bool(hands.get(stamp)) for stamp in stamps),
        'latency_p50_ms': float(np.percentile(latency_ms, 50)) if len(latency_ms) else None,
        'latency_p99_ms': float(np.percentile(latency_ms, 99)) if len(latency_ms) else None,
        'joint_error_mean_mm': float(np.mean(errors_mm)) if errors_mm else None,
        'joint_error_median_mm': float(np.median(errors_mm)) if errors_mm else None,
    }


def _truth(path: Path, skeleton: Skeleton) -> dict[int, RecordedHands]:
    """Stamp -> the true hands, if the bag has them with the joints of this skeleton."""
    try:
        return {hands.stamp_ns: hands for hands in read_hands(path, TRUTH_TOPIC) if hands.skeleton == skeleton.name}
    except InputError:
        return {}  # recorded with a real camera


def _animate(path: Path, pictures: Sequence[Picture], stamps: Sequence[int]) -> None:
    """All pictures at the pace of the recording."""
    from PIL import Image  # comes with matplotlib

    width = max(picture.shape[1] for picture in pictures)
    images = [Image.fromarray(cv2.copyMakeBorder(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), 0, 0, 0,
                                                 width - picture.shape[1], cv2.BORDER_CONSTANT))
              for picture in pictures]
    period_ms = round((stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1) / 1e6)
    with in_one_step(path) as part:
        images[0].save(part, format='WEBP', save_all=True, append_images=images[1:], duration=max(period_ms, 10),
                       loop=0, quality=60, method=0)
