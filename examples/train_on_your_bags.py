#!/usr/bin/env python3
"""Train a small, fast network for your own camera on your own bags.

    python examples/train_on_your_bags.py --train monday.mcap tuesday.mcap --val wednesday.mcap --out my_network \\
        --set augmentation=modern --set samples=500_000
    hand-pose estimate thursday.mcap --model my_network/run/best.safetensors --overlay pictures

For --val, record other people and other poses than for --train. The labels are the hands of which the network that
ships is sure. So the new network cannot be more accurate than that one. It can only be faster, or better adapted to
your camera. If you have better labels (markers, a glove), write them with BagWriter.write_hands, and leave out `label`.
"""

import argparse
import sys
from pathlib import Path

from hand_pose_ros.bags import BagWriter, DepthBag
from hand_pose_ros.cli import main as hand_pose
from hand_pose_ros.cli.arguments import add_bag, bag_options
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandPoseEstimator


def label(bag: DepthBag, out: Path, estimator: HandPoseEstimator, min_score: float) -> int:
    """Copy the images in which a hand is found, and its joints, into a new bag. Returns the number of images."""
    estimator.reset()
    count = 0
    with bag, BagWriter(out) as labelled:
        for frame in bag:
            hands = [hand for hand in estimator(frame.depth, frame.intrinsics) if hand.score >= min_score]
            if hands:
                labelled.write_depth(frame.stamp_ns, frame.frame_id, frame.depth, frame.intrinsics)
                labelled.write_hands(frame.stamp_ns, frame.frame_id, hands)
                count += 1
    return count


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0],
                                     epilog='All other arguments go to hand-pose train.')
    parser.add_argument('--train', nargs='+', type=Path, required=True, metavar='BAG')
    parser.add_argument('--val', nargs='+', type=Path, required=True, metavar='BAG')
    parser.add_argument('--out', type=Path, required=True, metavar='FOLDER', help='gets bags/ and run/')
    parser.add_argument('--min-score', type=float, default=0.8, help='hands below are not learned from (0.8)')
    add_bag(parser.add_argument_group('the bags'))
    args, more = parser.parse_known_args()
    if args.out.exists():
        parser.error(f'{args.out} is there already, with bags that would be learned from, too: choose another --out')

    estimator = HandPoseEstimator.from_pretrained()
    for split in ('train', 'val'):
        for number, bag in enumerate(getattr(args, split)):
            labelled = args.out / 'bags' / split / f'{number}_{bag.stem}.mcap'
            count = label(DepthBag(bag, **bag_options(args)), labelled, estimator, args.min_score)
            print(f'{split}: {count} images of {bag}', flush=True)
    return hand_pose(['train', 'paper', '--out', str(args.out / 'run'), '--set', 'dataset=bags',
                      '--set', f'root={args.out / "bags"}', *more])


if __name__ == '__main__':
    try:
        sys.exit(main())
    except HandPoseError as error:
        sys.exit(str(error))
