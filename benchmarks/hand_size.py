"""Would a cube that fits the size of the hand help? Joint errors by size of the hand, on synthetic validation hands.

    python benchmarks/hand_size.py --number 700 --start 21200
    python benchmarks/hand_size.py --number 60 --start 22000 --frames 24

Every image is read in cubes of 0.30 m, of 0.285 m, and of 0.30 m scaled by three sizes of the hand, relative to the
usual one: the true size, the size that the network gives for the first cube, and the size that the estimator would
believe after the earlier images of this hand. Cubes are limited to 0.25 to 0.36 m, for which networks are trained, and
centred as by tracking.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.estimator import SIZE_IMAGES, USUAL_SIZE, HandPoseEstimator
from hand_pose_ros.geometry import Cube, crop
from hand_pose_ros.models.dense import HAND_PER_CUBE
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.generator import SyntheticHands

CUBES = ('0.30 m', '0.285 m', 'true size', 'own size', 'tracked')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--model', help='weights that ship, or a file')
    parser.add_argument('--start', type=int, default=21200, help='first hand of the validation split')
    parser.add_argument('--number', type=int, default=700, help='hands')
    parser.add_argument('--frames', type=int, default=1, help='images of each: more than one show it moving')
    args = parser.parse_args()
    hands, rng, rows = SyntheticHands('val'), np.random.default_rng(args.start), []
    engine = HandPoseEstimator.from_pretrained(args.model, device='cpu', num_threads=1).engine

    def read(sides: Sequence[float]) -> tuple[list[float], dict[str, NDArray[Any]]]:
        """Mean errors in mm of the hand below in cubes of these sides, and all that the network says."""
        cubes = [Cube(tuple(center.tolist()), float(np.clip(side, 0.25, 0.36))) for side in sides]
        flip = -1 if side_of_hand == 'left' else 1
        answer = engine.run_full(np.stack([crop(depth, cube, camera)[..., ::flip] for cube in cubes]))
        found = [cube.from_cube(points * (flip, 1, 1)) for cube, points in zip(cubes, answer['joints'], strict=True)]
        return [1000 * float(np.linalg.norm(points - joints, axis=1).mean()) for points in found], answer

    for index in range(args.start, args.start + args.number):
        told: list[float] = []
        images = hands.sequence(index, args.frames, frames_per_key=3) if args.frames > 1 else [hands.full_frame(index)]
        for depth, camera, joints, side_of_hand in images:
            if side_of_hand == 'none':
                continue
            length = np.linalg.norm(np.diff(joints[list(HAND21.middle_finger)], axis=0), axis=1).sum()
            center = joints.mean(0) + rng.normal(0, 0.008, 3)
            if args.frames > 1 and (center[2] < 0.1 or _share_inside(camera.project(joints), depth.shape) < 0.5):
                continue
            tracked = float(np.exp(sum(told) / (len(told) + SIZE_IMAGES)))
            errors, answer = read([0.30, 0.285, 0.30 * length / USUAL_SIZE, 0.30 * tracked])
            usual = np.log(0.30 * HAND_PER_CUBE / USUAL_SIZE)
            told.append(float(answer['size'][3]) + usual + np.log(tracked))
            own, _ = read([0.30 * np.exp(answer['size'][0] + usual)])
            rows.append([length, *errors[:3], *own, errors[3]])
    table = np.array(rows)
    low, high = np.quantile(table[:, 0], [1 / 3, 2 / 3])
    bounds = {'small': (0, low), 'middle': (low, high), 'large': (high, 1), 'all': (0, 1)}
    print(f'{"length, m":<22}{"images":>8}' + ''.join(f'{name:>12}' for name in CUBES) + '   (mean joint error, mm)')
    for name, (low, high) in bounds.items():
        some = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        print(f'{name:<7}{some[:, 0].min():.3f} - {some[:, 0].max():.3f} {len(some):>8}'
              + ''.join(f'{mean:12.2f}' for mean in some[:, 1:].mean(0)))


def _share_inside(pixels: NDArray[np.float64], shape: tuple[int, ...]) -> float:
    return float(((pixels >= 0) & (pixels < shape[::-1])).all(axis=1).mean())


if __name__ == '__main__':
    main()
