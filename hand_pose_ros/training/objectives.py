"""What each network is trained for. An objective is a module that maps a batch to the terms of the loss."""

from __future__ import annotations

from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.models.dense import HAND_PER_CUBE, encode
from hand_pose_ros.models.finder import CELL, FOCAL, cell_rays
from hand_pose_ros.models.two_looks import TwoLooks
from hand_pose_ros.skeleton import Skeleton
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.training.losses import Terms, joint_loss
from hand_pose_ros.training.recipes import Recipe


class PoseObjective(nn.Module):
    """A network that predicts joints."""

    def __init__(self, network: nn.Module, recipe: Recipe, skeleton: Skeleton) -> None:
        super().__init__()
        self.network, self.recipe = network, recipe
        self.joints = list(range(len(skeleton)))
        """Numbers of the joints of the skeleton that are predicted."""

    def forward(self, batch: Batch) -> Terms:
        joints, truth = self.predict(batch['patch']).float(), chosen(batch['joints'], self.joints)
        return {'joints': joint_loss(self.recipe.loss, self.recipe.knee, joints, truth, which_count(batch))}

    def poses(self, batch: Batch) -> Tensor:
        """The poses (B, J, 3) that the network has to predict for these samples. The prior is fitted to them."""
        return batch['joints']

    def predict(self, patch: Tensor) -> Tensor:
        """Patches (B, 1, 128, 128) -> joints (B, J, 3) in cube units."""
        return self.network(patch)


class CenterObjective(PoseObjective):
    """A network that predicts where the palm is in the cube, to centre the cube there (DeepPrior++)."""

    PALMS = ('palm', 'middle_mcp')

    def __init__(self, network: nn.Module, recipe: Recipe, skeleton: Skeleton) -> None:
        super().__init__(network, recipe, skeleton)
        self.joints = [next(skeleton.joint_names.index(name) for name in self.PALMS if name in skeleton.joint_names)]

    def predict(self, patch: Tensor) -> Tensor:
        return self.network(patch)[:, None]


_WEIGHTS = {'maps': 1.0, 'confidence': 0.01, 'hand': 0.01, 'side': 0.01, 'size': 0.01}
"""Weights of the terms of a dense network; the joints have 1. Small terms must not decide what the features are."""


class DenseObjective(PoseObjective):
    """A network with maps of votes for the joints, and with what a tracker needs. Beside the joints, it is trained for:

    - maps: the votes of each cell, not only their sum. So all cells that see something learn from each sample.
    - confidence: whether a joint is within CONFIDENT of the truth.
    - hand: whether the patch shows a hand.
    - side: whether the hand is not mirrored.
    - size: see `HandDense.forward_full`. The network sees the hand relative to its cube, so the size is, too.
    """

    CONFIDENT = 0.020
    """In metres."""

    def __init__(self, network: nn.Module, recipe: Recipe, skeleton: Skeleton) -> None:
        super().__init__(network, recipe, skeleton)
        self.middle_finger = list(skeleton.middle_finger) if skeleton.has_wrist else None

    def forward(self, batch: Batch) -> Terms:
        out = self.network.forward_full(batch['patch'])  # type: ignore[operator]
        return self._terms(out, batch, batch['joints'], batch['joints'].new_ones(()))

    def _terms(self, out: dict[str, Tensor], batch: Batch, truth: Tensor, scale: Tensor) -> Terms:
        """The terms of the loss of the answer to a batch.

        Args:
            truth: joints (B, J, 3) in the units of the answer.
            scale: one such unit in cube units, (B,) or (). A view of the second look has its own units.
        """
        counts, half = which_count(batch), batch['cube_side'] / 2 * scale
        joints, refined = out['joints'].float(), out['unrefined'] is not out['joints']
        directions, closeness = encode(out['positions'], truth)
        seen = out['seen']  # (B, 1, 32, 32)
        smooth_l1 = partial(F.smooth_l1_loss, reduction='none', beta=self.recipe.knee)
        maps = (smooth_l1(out['closeness'], closeness) + smooth_l1(out['directions'], directions).mean(2)) * seen
        maps = maps.mean(1).sum((1, 2)) / seen.sum((1, 2, 3)).clamp(min=1)

        with torch.no_grad():
            right = (joints - truth).norm(dim=-1) * half[:, None] < self.CONFIDENT
            size = self._size(batch) - scale.log()
        extra = {
            'maps': maps * counts,
            'confidence': _binary(out['confidence'], right).mean(1) * counts,
            'hand': _binary(out['hand'], batch['hand_present']),
            'side': _binary(out['side'], ~batch['mirrored']) * batch['hand_present'],
            'size': F.smooth_l1_loss(out['size'].float(), size, reduction='none', beta=0.1) * counts,
        }
        loss = partial(joint_loss, self.recipe.loss, self.recipe.knee, truth=truth, counts=counts)
        return {'joints': loss(joints), **({'unrefined': loss(out['unrefined'].float())} if refined else {}),
                **{name: _WEIGHTS[name] * value.mean() for name, value in extra.items()}}

    def _size(self, batch: Batch) -> Tensor:
        """The size of the hands (B,), see `HandDense.forward_full`. 0 if the skeleton has no wrist."""
        if self.middle_finger is None:
            return torch.zeros_like(batch['cube_side'])
        cube = batch['cube_center'], batch['cube_side']
        bones = chosen(joints_in_metres(batch['joints'], *cube), self.middle_finger).diff(dim=1).norm(dim=-1)
        return torch.log((bones.sum(1) / batch['cube_side']).clamp(min=0.01) / HAND_PER_CUBE)


class SecondLookObjective(DenseObjective):
    """The second of two looks. It sees the hand as the first look finds it, with the same errors as in use."""

    network: TwoLooks

    def forward(self, batch: Batch) -> Terms:
        view, seen = self.network.look(batch['patch'])
        out = self.network.second.forward_full(seen)
        return self._terms(out, batch, view.into(batch['joints']), view.scale)

    def poses(self, batch: Batch) -> Tensor:
        return self.network.upright(batch['joints'], self._size(batch)).into(batch['joints'])


class FinderObjective(PoseObjective):
    """A network that finds the middles of hands in whole images (Zhou et al. 2019, Objects as Points).

    The target of the score of a cell is 1 at a middle, and falls with the distance. The loss is the quality focal loss
    (Li et al. 2020), for which easy cells hardly count. Cells near a middle are also trained to predict where it is.
    Half of the images are mirrored, and some readings are lost.
    """

    SPREAD = 0.035
    """Standard deviation of the target around a middle, in metres."""
    DROPOUT = 0.2
    """Maximum share of readings of an image that are lost."""

    def __init__(self, network: nn.Module, recipe: Recipe, skeleton: Skeleton) -> None:
        super().__init__(network, recipe, skeleton)
        self.joints = [0]  # validation compares with the middle of the first hand

    def forward(self, batch: Batch) -> Terms:
        depth, truth = batch['patch'], batch['joints']
        random = Random(batch['numbers'])
        mirrored = random.fork(0).chance(0.5)
        depth = torch.where(mirrored[:, None, None, None], depth.flip(3), depth)
        truth = truth * torch.stack([1 - 2 * mirrored.float(), *truth.new_ones(2, len(truth))], -1)[:, None]
        share = random.fork(1).uniform(high=self.DROPOUT)[:, None, None, None]
        depth = depth * (random.fork(2).uniform(*depth.shape[1:]) >= share)

        logits, middles = self.network(depth)
        hands, z = batch['shown'].float(), (1 + truth[..., 2]).clamp(min=0.1)  # (B, 2)
        apart = (cell_rays(middles) - truth[..., :2, None, None]).square().sum(2).sqrt()  # (B, 2, h, w) at 1 m
        spread = (self.SPREAD / z).clamp(min=0.7 * CELL / FOCAL)[..., None, None]
        near = torch.exp(-0.5 * (apart / spread).square()) * hands[..., None, None]
        target, whose = near.max(dim=1)
        quality = (target - logits.sigmoid()).square()
        score = F.binary_cross_entropy_with_logits(logits, target, reduction='none') * quality

        mine = truth[torch.arange(len(truth), device=truth.device)[:, None, None], whose].permute(0, 3, 1, 2)
        off = (middles - mine) * torch.cat([(1 + mine[:, 2:]).expand(-1, 2, -1, -1), torch.ones_like(mine[:, 2:])], 1)
        place = F.smooth_l1_loss(off, torch.zeros_like(off), reduction='none', beta=0.01).sum(1)
        # Per image, because all processes have the same number of images. An image has about one hand.
        return {'score': score.sum() / len(depth), 'place': 2 * (place * target * (target > 0.2)).sum() / len(depth)}

    def predict(self, patch: Tensor) -> Tensor:
        """(B, 1, H, W) metres -> the middle of the likeliest hand (B, 1, 3)."""
        logits, middles = self.network(patch)
        best = logits.flatten(1).argmax(1)
        return middles.flatten(2)[torch.arange(len(patch), device=patch.device), :, best][:, None]


class RefinerObjective(nn.Module):
    """A refiner of the joints of a base network. The base is not trained.

    The refiner must learn from errors that the base makes on new data. So the base was not trained on its samples.
    Jitter is added to the estimates of the base, so that the refiner also sees errors that did not occur. As in use,
    the second iteration starts from the result of the first.
    """

    ITERATIONS = 2
    JITTER = 0.03
    """Standard deviation in cube units (4.5 mm in a cube of 0.3 m)."""

    def __init__(self, refiner: nn.Module, base: nn.Module, recipe: Recipe, skeleton: Skeleton) -> None:
        super().__init__()
        self.refiner, self.recipe = refiner, recipe
        self.joints = list(range(len(skeleton)))
        self._base = [base.eval().requires_grad_(False)]  # a list, so that it is not trained, saved or averaged

    def forward(self, batch: Batch) -> Terms:
        estimate = self._estimate(batch['patch'])
        estimate = estimate + Random(batch['numbers']).normal(*estimate.shape[1:], std=self.JITTER)
        terms = {}
        for i in range(self.ITERATIONS):
            estimate = self.refiner(batch['patch'], estimate, iterations=1).float()
            terms[f'joints_{i + 1}'] = joint_loss(
                self.recipe.loss, self.recipe.knee, estimate, batch['joints'], which_count(batch))
        return terms

    def predict(self, patch: Tensor) -> Tensor:
        return self.refiner(patch, self._estimate(patch), iterations=self.ITERATIONS)

    def _estimate(self, patch: Tensor) -> Tensor:
        with torch.no_grad():
            return self._base[0].to(patch.device)(patch).float()


OBJECTIVES: dict[str, type[PoseObjective]] = {
    'hand_dense': DenseObjective, 'two_looks': SecondLookObjective, 'center_refiner': CenterObjective,
    'hand_finder': FinderObjective}
"""By architecture. All other architectures have a `PoseObjective`."""


def objective_for(network: nn.Module, recipe: Recipe, skeleton: Skeleton) -> PoseObjective:
    """The objective of a network that `models.build` made."""
    return OBJECTIVES.get(str(vars(network)['architecture']), PoseObjective)(network, recipe, skeleton)


def chosen(joints: Tensor, which: list[int]) -> Tensor:
    """Some of the joints (B, J, 3). A list as an index would be copied to the GPU, which a CUDA graph cannot hold."""
    return torch.stack([joints[:, joint] for joint in which], dim=1)


def which_count(batch: Batch) -> Tensor:
    """The samples whose joints count, (B,) bool. They show a hand, and are not mirrored."""
    return batch['hand_present'] & ~batch['mirrored']


def _binary(logits: Tensor, target: Tensor) -> Tensor:
    return F.binary_cross_entropy_with_logits(logits.float(), target.float(), reduction='none')
