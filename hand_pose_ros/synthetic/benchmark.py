"""The benchmark synthetic-test-v1: 5,000 frames that no training sees. All make the same ones from their seeds.

    for batch in frames():
        predict(batch['patch']) ...

The frames are those of the split 'test', which shares no hand, pose or other random number with 'train' and 'val'. A
SHA-256 of the first frames identifies them. It covers every bit, so it also changes if another version of PyTorch or
another processor rounds differently. In that case `digest` and the results still agree to about a thousandth.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import torch
from torch import Tensor

from hand_pose_ros.synthetic.generator import SyntheticHands

NAME = 'synthetic-test-v1'
FRAMES = 5000
PREFIX = 64
SENSORS = ('primesense', 'kinect1', 'sr305', 'kinect2', 'azure', 'pmd', 'senz3d', 'd435', 'd415')

PREFIX_SHA256 = '84732b6b16bfdc57aeccfa51c31f5a35e0270e3f35fee90e07f49bf76ba223ff'
"""SHA-256 of the first PREFIX frames, made with PREFIX_MADE_WITH."""
PREFIX_MADE_WITH = 'torch 2.13.0, AVX512'
PREFIX_DIGEST = (0.718286, 0.225034, 0.614583)


def frames(number: int = FRAMES, *, device: str | torch.device = 'cpu', batch: int = 64) -> Iterator[dict[str, Tensor]]:
    """The first `number` frames in batches, as `SyntheticHands.batch` returns them."""
    hands = SyntheticHands('test', sensors=SENSORS, device=device)
    for indices in torch.arange(number).split(batch):
        yield hands.batch(indices)


def checksum(batch: dict[str, Tensor]) -> str:
    """SHA-256 of all that a batch holds, with the keys in alphabetical order."""
    digest = hashlib.sha256()
    for key in sorted(batch):
        digest.update(key.encode())
        digest.update(batch[key].cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def digest(batch: dict[str, Tensor]) -> tuple[float, float, float]:
    """Mean of the patches, root mean square of the joints (cube units) and share of visible joints."""
    return (float(batch['patch'].double().mean()), float(batch['joints'].double().square().mean().sqrt()),
            float(batch['visible'].double().mean()))


def made_with() -> str:
    """What the last bits of the frames depend on, besides this code."""
    return f'torch {torch.__version__.split("+")[0]}, {torch.backends.cpu.get_cpu_capability()}'
