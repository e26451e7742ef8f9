"""How far are estimated fingertips from the marked ones in real depth frames?

    python benchmarks/annotated_frames.py FRAMES --model hand_dense deep_prior --json results.json --overlays FOLDER

FRAMES holds annotations.json: `frames`, each with sensor, file, width, height, fx, fy, cx, cy, depth_scale_m, side,
`points` {joint: [u, v, depth_mm] or null} and `doubtful` [joints]. Every frame is treated as the first one that the
estimator sees, so the hand is searched in it. Errors are lateral, at the annotated depth, in mm, and of all visible
fingertips that are not doubtful. If no hand is found in a frame, its errors are infinite. Milliseconds are the median
of whole frames, from the array in metres to the joints.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import hand_pose_ros.estimator
from hand_pose_ros.depth import read_png
from hand_pose_ros.drawing import contact_sheet, overlay
from hand_pose_ros.estimator import HandEstimate, HandPoseEstimator
from hand_pose_ros.evaluation.metrics import finite_or_none
from hand_pose_ros.files import write_json
from hand_pose_ros.geometry import Intrinsics


def camera_of(frame: dict[str, Any]) -> Intrinsics:
    return Intrinsics(*(frame[key] for key in ('fx', 'fy', 'cx', 'cy', 'width', 'height')))


def tip_errors_mm(frame: dict[str, Any], hand: HandEstimate | None) -> dict[str, float]:
    """Lateral error of each fingertip that is marked and not doubtful. Without a hand, it is infinite."""
    camera, errors = camera_of(frame), {}
    for name, mark in frame['points'].items():
        if mark is None or not name.endswith('_tip') or name in frame['doubtful']:
            continue
        errors[name] = float('inf')
        if hand is not None:
            u, v = camera.project(hand.joints[hand.joint_names.index(name)])
            errors[name] = float(np.hypot((u - mark[0]) / camera.fx, (v - mark[1]) / camera.fy) * mark[2])
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('frames', type=Path, help='folder with annotations.json')
    parser.add_argument('--model', nargs='+', default=[None], help='weights that ship, or files')
    parser.add_argument('--json', type=Path)
    parser.add_argument('--overlays', type=Path, help='write one sheet of all frames for each model here')
    parser.add_argument('--min-score', type=float, help='(that of the estimator)')
    parser.add_argument('--readings', type=int, default=hand_pose_ros.estimator.READINGS,
                        help='how often a cube is read if its joints are not in its middle (%(default)s)')
    parser.add_argument('--detector', default='network', choices=('network', 'nearest'))
    parser.add_argument('--sides-known', action='store_true', help='tell the estimator whether it is a left hand')
    args = parser.parse_args()
    hand_pose_ros.estimator.READINGS = args.readings
    frames = json.loads((args.frames / 'annotations.json').read_text())['frames']
    table: dict[str, dict[str, Any]] = {}
    for model in args.model:
        options = {} if args.min_score is None else {'min_score': args.min_score}
        estimator = HandPoseEstimator.from_pretrained(model, device='cpu', detector=args.detector, **options)
        estimator.warm_up()
        errors: dict[str, list[float]] = {}
        seconds: dict[str, list[float]] = {}
        sides: dict[str, list[bool]] = {}
        pictures = []
        for frame in frames:
            depth = read_png(args.frames / frame['file'], frame['depth_scale_m'])
            estimator.reset()
            estimator.side = frame['side'] if args.sides_known else 'auto'
            start = time.perf_counter()
            hands = estimator(depth, camera_of(frame))
            seconds.setdefault(frame['sensor'], []).append(time.perf_counter() - start)
            hand = hands[0] if hands else None
            errors.setdefault(frame['sensor'], []).extend(tip_errors_mm(frame, hand).values())
            sides.setdefault(frame['sensor'], []).append(hand is not None and hand.side == frame['side'])
            pictures.append(overlay(depth, camera_of(frame), hands, estimator.skeleton, 320))
        name = Path(model or 'default').stem
        for sensor, values in errors.items():
            table[f'{name} {sensor}'] = {
                'frames': len(sides[sensor]), 'tips': len(values), 'missed': int(np.isinf(values).sum()),
                'median_mm': round(float(np.median(values)), 1),
                'p90_mm': round(float(np.quantile(values, 0.9, method='lower')), 1),
                'within_20_mm': round(float(np.mean(np.array(values) <= 20)), 3),
                'side_right': round(float(np.mean(sides[sensor])), 3),
                'ms': round(1000 * float(np.median(seconds[sensor])), 1)}
        if args.overlays:
            args.overlays.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(args.overlays / f'{name}.png'), contact_sheet(pictures, 6))
    for name, row in table.items():
        print(f'{name:<28}' + '  '.join(f'{key} {value}' for key, value in row.items()))
    if args.json:
        write_json(args.json, finite_or_none(table))


if __name__ == '__main__':
    main()
