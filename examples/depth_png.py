#!/usr/bin/env python3
"""The joints of the hand in one 16-bit depth PNG, without ROS.

    python examples/depth_png.py demo/depth.png --intrinsics 364.5 364.5 256 208 --picture joints.png
"""

import argparse
import sys

import cv2

from hand_pose_ros.depth import read_png
from hand_pose_ros.drawing import overlay
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.geometry import Intrinsics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('png')
    parser.add_argument('--intrinsics', nargs=4, type=float, required=True, metavar=('FX', 'FY', 'CX', 'CY'))
    parser.add_argument('--depth-scale', type=float, default=0.001, help='metres per unit (0.001)')
    parser.add_argument('--picture', help='draw the joints there')
    args = parser.parse_args()

    depth = read_png(args.png, args.depth_scale)  # (H, W) float32, metres, 0 = no reading
    intrinsics = Intrinsics(*args.intrinsics, width=depth.shape[1], height=depth.shape[0])
    hands = HandPoseEstimator.from_pretrained()(depth, intrinsics)
    for hand in hands:
        print(f'{hand.side} hand, score {hand.score:.2f}')
        for name, (x, y, z), confidence in zip(hand.joint_names, hand.joints, hand.confidence, strict=True):
            print(f'  {name:<12}{x:+.3f} {y:+.3f} {z:.3f} m   {confidence:.2f}')
    if not hands:
        print('no hand')
    if args.picture and not cv2.haveImageWriter(args.picture):
        sys.exit(f'{args.picture}: the kind of picture is told by the end of its name: end it in .png or .jpg')
    if args.picture and not cv2.imwrite(args.picture, overlay(depth, intrinsics, hands)):
        sys.exit(f'{args.picture} cannot be written: is there such a folder?')


if __name__ == '__main__':
    try:
        main()
    except HandPoseError as error:
        sys.exit(str(error))
