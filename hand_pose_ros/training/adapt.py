"""Fine-tunes a network to the user's camera, from a recording of a moving hand without labels.

- `look` takes crops of the hand from a bag. The first part of the recording is for training, the last part for judging.
- `label` finds better joints than one look of the network. It shows each crop turned, moved and scaled in many ways
  (test-time augmentation), and fits one hand to the means of the answers.
- `fine_tune` trains the network on these labels, and on as many synthetic hands, so that it forgets little.
- `judge` measures the network before and after.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hand_pose_ros.bags import Frame
from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.datasets.base import mirrored
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.evaluation.bag_evaluation import Settings, evaluate_bag
from hand_pose_ros.evaluation.progress import Progress
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.geometry import crop
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.runtime import Engine
from hand_pose_ros.scoring import explain
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.crops import to_cube
from hand_pose_ros.training.augmentation import Augmentation, augment
from hand_pose_ros.training.fitting import fit_hand
from hand_pose_ros.training.losses import Terms
from hand_pose_ros.training.objectives import objective_for
from hand_pose_ros.training.optimizers import learning_rate, make_optimizer
from hand_pose_ros.training.recipes import RECIPES

LEAST = 20
"""Minimum number of images with a hand, both for training and for judging."""
MOST = 1500
"""Maximum number of images for each. If there are more, images are left out evenly."""
HELD_OUT, GAP, GAP_S = 0.25, 0.05, 1.0
"""The last part of the time is held out for judging. The gap before it is not used, because neighbouring images are
alike. It is this part of the time, but at most this many seconds."""
VIEWS = 12
"""Number of ways in which a crop is shown to the network for its label."""
VARIETY = Augmentation(rotation_deg=180, jitter=0.008, scale=1.2)
"""How a crop is changed for these."""
AGREED_M = 0.012
"""If the answers are further than this from their mean, on average over the joints, the image gets no label."""
STEADY_M, STEADY_ROWS = 0.04, 4
"""If a hand is further than this from its median place in this many images around, it is something else."""
BATCH = 16
"""Number of recorded samples in a batch, and of synthetic ones."""
RATE = 3e-4
"""Learning rate."""
WAY = 0.5
"""How far to go from the old weights to the new ones. Half of the way keeps more than half of the gain, but only a
third of what is forgotten (robust fine-tuning, Wortsman et al. 2022)."""

Numbers = dict[str, float | None]
"""By name; None = unknown. See `judge`."""


@dataclass(frozen=True)
class Look:
    """What the estimator found in a bag.

    Attributes:
        result: joints of all images (NaN = no hand), and the truth if it is known.
        rows: (N,) int64, ascending numbers of the images that the crops are from.
        crops: as the network sees them. Their joints are the estimates. Patches are float16.
    """

    result: Result
    rows: Tensor
    crops: Batch

    def select(self, chosen: NDArray[np.bool_]) -> tuple[Tensor, Batch]:
        """Rows and crops of the chosen images (a bool for each image), at most `MOST`. Patches are float32."""
        index = torch.as_tensor(chosen)[self.rows].nonzero()[:, 0]
        index = index[torch.linspace(0, len(index) - 1, min(len(index), MOST)).round().long()]
        crops = {key: value[index] for key, value in self.crops.items()}
        return self.rows[index], {**crops, 'patch': crops['patch'].float()}

    def split(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The images for training and those for judging, by time. Each is a bool for each image."""
        assert self.result.stamps_ns is not None
        time = (self.result.stamps_ns - np.min(self.result.stamps_ns)) / 1e9
        whole = float(np.max(time))
        end = whole * (1 - HELD_OUT)
        return time < end - min(GAP_S, GAP * whole), time >= end


class _Crops:
    """Keeps the crop of the first hand of each image. Left hands are mirrored."""

    def __init__(self) -> None:
        self._images = 0
        self.samples: list[tuple[Any, ...]] = []

    def add(self, image: Frame, hands: Sequence[HandEstimate]) -> None:
        for hand in hands[:1]:
            patch, center = crop(image.depth, hand.cube, image.intrinsics), hand.cube.center
            joints = hand.cube.to_cube(hand.joints)
            if hand.side == 'left':
                patch, joints, center = mirrored(patch, joints, center)
            self.samples.append((self._images, hand.side, patch.astype(np.float16), joints, center, hand.cube.side))
        self._images += 1

    def batch(self) -> tuple[Tensor, Batch]:
        """Rows and crops. Only hands of the side that most images show are kept."""
        sides = [side for _, side, *_ in self.samples]
        samples = [sample for sample in self.samples if sample[1] == max(set(sides), key=sides.count)]
        rows, _, patches, joints, centers, lengths = zip(*samples, strict=True) if samples else [()] * 6
        return torch.tensor(rows, dtype=torch.int64), {
            'patch': torch.from_numpy(np.array(patches, np.float16)),
            'joints': torch.from_numpy(np.array(joints, np.float32)),
            'cube_center': torch.tensor(centers, dtype=torch.float32),
            'cube_side': torch.tensor(lengths, dtype=torch.float32),
            'hand_present': torch.ones(len(samples), dtype=torch.bool)}


def look(bag: str | Path, settings: Settings, progress: Progress) -> Look:
    """Run the estimator on a bag.

    Raises:
        HandPoseError: the bag, the camera, the truth or the weights cannot be used.
    """
    crops = _Crops()
    result = evaluate_bag(bag, settings, progress, lambda *_: nullcontext(crops))
    assert result.stamps_ns is not None
    if len(result.stamps_ns) > 1 and np.ptp(result.stamps_ns) == 0:
        raise InputError(f'{bag}: all images have the stamp {result.stamps_ns[0]} ns, so the images to learn from and '
                         'those to judge on cannot be separated by time: record it again with a running clock')
    return Look(result, *crops.batch())


def require_hands(found: Look, bag: str | Path) -> None:
    """Raise HandPoseError if there are not enough images with a hand, for training or for judging."""
    for part, name in zip(found.split(), ('learn from', 'judge on'), strict=True):
        if (count := int(torch.as_tensor(part)[found.rows].sum())) < LEAST:
            raise HandPoseError(f'{bag}: a hand was found in {count} of the {int(part.sum())} images to {name}, and '
                                f'{LEAST} are needed: record one hand that moves in front of the camera for a minute '
                                'or two (with --side, a hand of that side)')


def consensus(predict: Callable[[NDArray[np.float32]], NDArray[np.float32]], crops: Batch,
              progress: Progress) -> tuple[Tensor, Tensor]:
    """The mean answer of a network to each crop, which it is shown in `VIEWS` ways.

    Args:
        predict: patches (N, 1, 128, 128) -> joints (N, J, 3) in cube units.

    Returns:
        Mean joints (N, J, 3) in cube units of the crops, and the mean distance of the answers from them (N, J) in
        metres.
    """
    count = len(crops['patch'])
    # Augmentation is an affine map of points. These four points show how to map the answers back.
    corners = torch.cat([torch.zeros(1, 3), torch.eye(3)]).expand(count, 4, 3)
    answers = []
    for view in progress(range(VIEWS), VIEWS):
        parts = []
        for rows in torch.arange(count).split(64):
            samples = {key: crops[key][rows] for key in ('patch', 'cube_center', 'cube_side')}
            shown = augment({**samples, 'joints': corners[rows]}, VARIETY, rows, seed=view)
            origin, axes = shown['joints'][:, :1], shown['joints'][:, 1:] - shown['joints'][:, :1]
            parts.append((torch.from_numpy(predict(shown['patch'].numpy())) - origin) @ torch.linalg.inv(axes))
        answers.append(torch.cat(parts))
    views = torch.stack(answers)
    mean = views.mean(0)
    return mean, (views - mean).norm(dim=-1).mean(0) * crops['cube_side'][:, None] / 2


def label(engine: Engine, rows: Tensor, crops: Batch, progress: Progress) -> Batch:
    """The crops that get a label. The labels are their joints.

    Raises:
        HandPoseError: there are too few.
    """
    joints, spread = consensus(engine.run, crops, progress)
    cube = crops['cube_center'], crops['cube_side']
    points = joints_in_metres(joints, *cube)
    middle = points.mean(1)
    around = [middle[(rows - row).abs() <= STEADY_ROWS].median(0).values for row in rows]
    steady = (middle - torch.stack(around)).norm(dim=-1) <= STEADY_M
    keep = steady & (spread.mean(1) <= AGREED_M)
    if (count := int(keep.sum())) < LEAST:
        raise HandPoseError(f'the network is sure in only {count} of {len(rows)} images of the hand, and {LEAST} are '
                            'needed: record it nearer, with open fingers and nothing else in reach')
    crops = {key: value[keep] for key, value in crops.items()}
    trust = 1 / (1 + (spread[keep] / 0.008) ** 2)
    fitted = fit_hand(points[keep], trust, rows[keep], _surface(crops))
    return {**crops, 'joints': to_cube(fitted, crops['cube_center'], crops['cube_side'])}


def _surface(crops: Batch, count: int = 64) -> Tensor:
    """Some measured points of each crop, (N, count, 3) in metres. In an empty crop, they are at the back face."""
    depth = crops['patch'].flatten(1)
    size = crops['patch'].shape[-1]
    measured = ((depth < 1) & (depth > -1)).float() + 1e-9
    at = torch.multinomial(measured, count, replacement=True, generator=torch.Generator().manual_seed(0))
    column, row = at % size, at // size
    points = torch.stack([(column + 0.5) * 2 / size - 1, (row + 0.5) * 2 / size - 1, depth.gather(1, at)], dim=-1)
    return joints_in_metres(points, crops['cube_center'], crops['cube_side'])


def fine_tune(network: nn.Module, recorded: Batch, synthetic: Batch, steps: int, progress: Progress) -> nn.Module:
    """A copy of a network for hand21, trained on labelled crops and on as many synthetic samples.

    In the end, its weights go back half of the way to the old ones. From the crops it learns only joints. The labels
    are its own, so they do not show how far to trust it.
    """
    original = list(network.parameters())
    # In eval mode, norms keep their statistics, because there are two kinds of samples.
    network = copy.deepcopy(network).requires_grad_(True).eval()
    recipe = replace(RECIPES['modern'], optimizer='adamw', learning_rate=RATE, warmup=0.1)
    objective = objective_for(network, recipe, HAND21)
    objective = objective.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = make_optimizer(recipe, network)
    order = torch.Generator().manual_seed(recipe.seed)
    for step in progress(range(steps), steps):
        for group in optimizer.param_groups:
            group['lr'] = learning_rate(recipe, step / steps)
        numbers = torch.arange(step * BATCH, (step + 1) * BATCH)
        terms: list[Terms] = []
        for samples, mirror in ((recorded, 0.0), (synthetic, recipe.augmentation.mirror)):
            rows = torch.randint(len(samples['patch']), (BATCH,), generator=order)
            batch = {key: value[rows] for key, value in samples.items()}
            batch['patch'] = batch['patch'].float()
            batch = augment(batch, replace(recipe.augmentation, mirror=mirror), numbers, seed=len(terms))
            terms.append(objective(batch))
        learned = [terms[0][name] for name in ('joints', 'unrefined', 'maps') if name in terms[0]]
        loss = torch.stack([*learned, *terms[1].values()]).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    network.requires_grad_(False)
    for new, old in zip(network.parameters(), original, strict=True):
        new.lerp_(old, 1 - WAY)
    return network.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]


def judge(found: Look, engine: Engine, progress: Progress) -> Numbers:
    """Numbers of the held-out images, by name:

    - found: share of the images with a hand
    - error_mm: mean error, if the truth is known
    - disagreement_mm: mean distance of the answers to one crop from their mean, see `consensus`
    - explained: share of the depth that the joints explain, see `scoring.explain`
    - jitter_mm, bone_drift_mm: see `metrics.smoothness`
    """
    held = found.split()[1]
    _, crops = found.select(held)
    own: Numbers = {'disagreement_mm': None, 'explained': None}
    if len(crops['patch']):
        _, spread = consensus(engine.run, crops, progress)
        scores = [explain(patch, joints, float(side), HAND21)[1] for patch, joints, side in
                  zip(crops['patch'].numpy(), crops['joints'].numpy(), crops['cube_side'], strict=True)]
        own = {'disagreement_mm': 1000 * float(spread.mean()), 'explained': float(np.mean(scores))}
    result = found.result
    assert result.stamps_ns is not None
    summary = replace(result, predictions=result.predictions[held], stamps_ns=result.stamps_ns[held], seconds={},
                      info={}, hand_ids=None if result.hand_ids is None else result.hand_ids[held],
                      truth=None if result.truth is None else result.truth[held]).summary()
    return {'found': summary['detection_rate'], 'error_mm': summary.get('mean_mm'), **own,
            'jitter_mm': summary['jitter_mm'], 'bone_drift_mm': summary['bone_drift_mm']}


def is_better(before: Numbers, after: Numbers) -> bool:
    """Whether the numbers of `judge` are better for the adapted weights.

    If the truth is known, the error decides. Otherwise the answers must agree better, and must not explain the depth
    worse. Agreement alone is not enough, because a network that always gives the same answer agrees best.
    """
    def smaller(name: str) -> bool:
        now, was = after[name], before[name]
        return now is not None and was is not None and now < was

    def kept(name: str, slack: float) -> bool:
        return (after[name] or 0) >= (before[name] or 0) - slack

    if before['error_mm'] is not None:
        return kept('found', 0.01) and smaller('error_mm')
    return kept('found', 0.01) and smaller('disagreement_mm') and kept('explained', 0.005)
