"""Rendered hands: `hand_pose_ros.synthetic` seen as a dataset without an end."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import torch
from torch import Tensor

import hand_pose_ros.synthetic
from hand_pose_ros.datasets.base import Batch, Dataset, DatasetError
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.stages import Ingredients

INGREDIENTS = tuple(field.name for field in dataclasses.fields(Ingredients))
"""What a variant can do without."""
LEFT = 1
"""`side` of a left hand, as in the message HandJoints."""


class Synthetic(Dataset):
    """Endless samples of one split; 'train', 'val' and 'test' share no identity, no pose and no seed.

    Args:
        split: 'train', 'val' or 'test'.
        device: where they are rendered.
        variant: '' or 'without-NAME' with an ingredient, or 'everything': the training samples lack it, the others are
            complete all the same, for what it is worth shows on them.

    Raises:
        DatasetError: an unknown split or variant.
    """

    name: str
    skeleton = HAND21
    size = None

    def __init__(self, split: str, device: str = 'cpu', variant: str = '') -> None:
        from hand_pose_ros.synthetic.benchmark import SENSORS
        from hand_pose_ros.synthetic.generator import SyntheticHands
        ingredients = _ingredients(variant)
        if split != 'train':
            variant, ingredients = '', None
        self.name = '-'.join(filter(None, ('synthetic', split, variant)))
        self.device = torch.device(device)
        try:
            # The test split is the benchmark synthetic-test-v1 and goes on behind its end.
            self._hands = SyntheticHands(split, device=device, sensors=SENSORS if split == 'test' else None,
                                         ingredients=ingredients)
        except HandPoseError as error:
            raise DatasetError(f'synthetic: {error}') from error
        # Any change of the code that makes the samples makes other samples.
        sources = sorted(Path(hand_pose_ros.synthetic.__path__[0]).glob('*.py'))
        code = hashlib.sha256(b''.join(path.read_bytes() for path in sources)).hexdigest()
        self.fingerprint = f'{self.name}-{self.device.type}-{code[:12]}'

    def batch(self, indices: Tensor) -> Batch:
        hands = self._hands.batch(indices.to(self.device))
        # The patch of a left hand comes mirrored; the centre of its cube must follow.
        mirror = torch.where(hands['side'] == LEFT, -1.0, 1.0).to(self.device)
        center = hands['cube_center'] * torch.stack([mirror, torch.ones_like(mirror), torch.ones_like(mirror)], dim=-1)
        return {'patch': hands['patch'], 'joints': hands['joints'], 'cube_center': center,
                'cube_side': hands['cube_side'], 'hand_present': hands['hand_present']}


def _ingredients(variant: str) -> Ingredients | None:
    if not variant:
        return None
    names = (*INGREDIENTS, 'everything')
    start, _, name = variant.partition('-')
    if start != 'without' or name not in names:
        raise DatasetError(f"synthetic:{variant}: write it as synthetic:without-NAME with one of {', '.join(names)}")
    return Ingredients(**{each: False for each in INGREDIENTS if name in (each, 'everything')})
