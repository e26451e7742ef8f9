"""How often is a hand found in a single image, without tracking? Measured on synthetic test scenes.

    python benchmarks/detection.py --number 1000

Tables, walls, people, held things and second hands are part of the scenes. Images with a hand count only if it is whole
and 0.15 to 1.4 m away. It is *found* if the middle of the first estimate is within 50 mm of the true one. Otherwise,
the estimate is *elsewhere* (it may be of a second hand). *Alarms* are images without a hand in which one is reported.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from hand_pose_ros.cli.arguments import count
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.synthetic.generator import SyntheticHands


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--model', help='weights that ship, or a file')
    parser.add_argument('--split', default='test', choices=('train', 'val', 'test'))
    parser.add_argument('--start', type=int, default=20_000, help='first scene')
    parser.add_argument('--number', type=count, default=1000, help='scenes')
    args = parser.parse_args()
    scenes = SyntheticHands(args.split)
    estimators = {name: HandPoseEstimator.from_pretrained(args.model, device='cpu', detector=name, tracking=False)
                  for name in ('network', 'nearest')}
    outcomes: dict[str, list[str]] = {name: [] for name in estimators}
    alarms: dict[str, list[bool]] = {name: [] for name in estimators}
    seconds: dict[str, list[float]] = {name: [] for name in estimators}
    for index in range(args.start, args.start + args.number):
        depth, camera, joints, side = scenes.full_frame(index)
        if side != 'none' and not _shown(camera.project(joints), joints[:, 2].mean(), depth.shape):
            continue
        for name, estimator in estimators.items():
            start = time.perf_counter()
            hands = estimator(depth, camera)
            seconds[name].append(time.perf_counter() - start)
            if side == 'none':
                alarms[name].append(bool(hands))
                continue
            near = bool(hands) and np.linalg.norm(hands[0].joints.mean(0) - joints.mean(0)) < 0.05
            outcomes[name].append('found' if near else 'elsewhere' if hands else 'none')
    for name, kinds in outcomes.items():
        shares = '  '.join(f'{kind} {kinds.count(kind) / len(kinds):.1%}' for kind in ('found', 'elsewhere', 'none'))
        p50, p99 = 1000 * np.quantile(seconds[name], [0.5, 0.99])
        print(f'{name:<8} {len(kinds)} images: {shares}  alarms {sum(alarms[name])} of {len(alarms[name])}  '
              f'ms p50 {p50:.1f} p99 {p99:.1f}')


def _shown(pixels: np.ndarray, z: float, shape: tuple[int, ...]) -> bool:
    return bool(((pixels >= 0) & (pixels < shape[::-1])).all() and 0.15 < z < 1.4)


if __name__ == '__main__':
    main()
