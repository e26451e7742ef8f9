"""Draws two_looks.webp: hands of synthetic-test-v1 as the first look of hand_dense sees them, below as the second does.

    python docs/images/two_looks.py
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hand_pose_ros.drawing import Picture, contact_sheet, draw_joints, shade
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.synthetic.benchmark import frames

HANDS, ENLARGED = 8, 2


def picture(patch: torch.Tensor, joints: torch.Tensor) -> Picture:
    """A patch (1, 128, 128) as if it were a depth image, with joints (J, 3) in its units."""
    depth = np.kron(np.where(patch[0] < 1, 0.5 + 0.15 * patch[0], 0), np.ones((ENLARGED, ENLARGED))).astype(np.float32)
    half = depth.shape[0] / 2
    camera = Intrinsics(half, half, half - 0.5, half - 0.5, *depth.shape)
    z = 0.5 + 0.15 * joints[:, 2:].numpy()
    shown = shade(depth, camera)
    draw_joints(shown, np.concatenate([joints[:, :2].numpy() * z, z], axis=1), camera)
    return shown


@torch.inference_mode()
def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    network = load_checkpoint('hand_dense').network
    batch = next(iter(frames(50)))
    chosen = batch['hand_present'].nonzero()[:HANDS, 0]
    patch = batch['patch'][chosen]
    (_, seen), first = network.look(patch), network.first(patch)
    second = network.second(seen)
    pictures = [*map(picture, patch, first), *map(picture, seen, second)]
    sheet = contact_sheet(pictures, columns=HANDS)
    Image.fromarray(sheet[..., ::-1]).save(Path(__file__).with_name('two_looks.webp'), quality=80)


if __name__ == '__main__':
    main()
