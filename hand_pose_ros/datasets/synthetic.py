"""Rendered hands, and whole scenes with hands: `hand_pose_ros.synthetic` seen as datasets without an end."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import torch
from torch import Tensor

import hand_pose_ros.synthetic
from hand_pose_ros.datasets.base import Batch, Dataset, DatasetError
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models.finder import FOCAL
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.benchmark import SENSORS
from hand_pose_ros.synthetic.generator import LEFT, SyntheticHands
from hand_pose_ros.synthetic.stages import Ingredients

INGREDIENTS = tuple(field.name for field in dataclasses.fields(Ingredients))
"""Names of what a variant can leave out."""


class Synthetic(Dataset):
    """Endless samples of one split. 'train', 'val' and 'test' share no identity, no pose and no seed.

    Args:
        split: 'train', 'val' or 'test'.
        device: where they are rendered.
        variant: '' or 'without-NAME', where NAME is an ingredient or 'everything'. Only training samples lack it. Those
            of the other splits are complete, because on them it shows what the ingredient is worth.

    Raises:
        DatasetError: an unknown split or variant.
    """

    name: str
    skeleton = HAND21
    size = None

    def __init__(self, split: str, device: str = 'cpu', variant: str = '') -> None:
        ingredients = _ingredients(variant)
        if split != 'train':
            variant, ingredients = '', None
        self.name = '-'.join(filter(None, ('synthetic', split, variant)))
        self.device = torch.device(device)
        try:
            # The test split begins with the benchmark synthetic-test-v1, and goes on after its end.
            self._hands = SyntheticHands(split, device=device, sensors=SENSORS if split == 'test' else None,
                                         ingredients=ingredients)
        except HandPoseError as error:
            raise DatasetError(f'synthetic: {error}') from error
        self.chunk = self._hands.chunk
        self.fingerprint = f'{self.name}-{self.device.type}-{_code()}'

    def batch(self, indices: Tensor) -> Batch:
        hands = self._hands.batch(indices.to(self.device))
        return {'patch': hands['patch'], 'joints': hands['joints'], 'cube_center': seen_centers(hands),
                'cube_side': hands['cube_side'], 'hand_present': hands['hand_present']}


def seen_centers(hands: Batch) -> Tensor:
    """Centres (B, 3) of the cubes of `SyntheticHands.batch`, mirrored where the patch and its joints are."""
    x, y, z = hands['cube_center'].unbind(-1)
    return torch.stack([torch.where(hands['side'] == LEFT, -x, x), y, z], dim=-1)


class SyntheticScenes(Dataset):
    """Whole images of the same scenes, of 160 x 128 pixels, for `hand_finder`.

    - `patch` (B, 1, 128, 160) is depth in metres, 0 = no reading.
    - `joints` (B, 2, 3) are the middles of one or two hands, as x / z, y / z and z - 1. They are in a cube of 2 m whose
      centre is 1 m in front of a camera that looks through the middle of the image.
    - `shown` (B, 2) tells whether that hand is there.
    - `hand_present` (B,) is `shown` of the first hand.

    Raises:
        DatasetError: an unknown split.
    """

    WIDTH, HEIGHT = 160, 128
    skeleton = HAND21
    size = None

    def __init__(self, split: str, device: str = 'cpu') -> None:
        self.name = f'scenes-{split}'
        self.device = torch.device(device)
        try:
            self._hands = SyntheticHands(split, device=device)
        except HandPoseError as error:
            raise DatasetError(f'scenes: {error}') from error
        self.chunk = self._hands.chunk
        self.fingerprint = f'{self.name}-{self.device.type}-{_code()}'

    def batch(self, indices: Tensor) -> Batch:
        scenes = self._hands.scenes(indices.to(self.device), FOCAL, self.WIDTH, self.HEIGHT)
        u, v, z = scenes['hands'].unbind(-1)
        middles = torch.stack([(u - (self.WIDTH - 1) / 2) / FOCAL, (v - (self.HEIGHT - 1) / 2) / FOCAL, z - 1], dim=-1)
        shown, number = scenes['shown'], len(indices)
        return {'patch': scenes['depth'][:, None], 'joints': torch.where(shown[..., None], middles, 0), 'shown': shown,
                'cube_center': torch.tensor([[0.0, 0.0, 1.0]], device=self.device).repeat(number, 1),
                'cube_side': torch.full((number,), 2.0, device=self.device), 'hand_present': shown[:, 0]}


def _code() -> str:
    """Changes with the code that makes the samples, because any change of it may make other samples."""
    sources = sorted(Path(hand_pose_ros.synthetic.__path__[0]).glob('*.py'))
    return hashlib.sha256(b''.join(path.read_bytes() for path in (*sources, Path(__file__)))).hexdigest()[:12]


def _ingredients(variant: str) -> Ingredients | None:
    if not variant:
        return None
    names = (*INGREDIENTS, 'everything')
    start, _, name = variant.partition('-')
    if start != 'without' or name not in names:
        raise DatasetError(f"synthetic:{variant}: write it as synthetic:without-NAME with one of {', '.join(names)}")
    return Ingredients(**{each: False for each in INGREDIENTS if name in (each, 'everything')})
