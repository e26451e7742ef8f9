"""The network that a recipe trains, and what it starts from: fresh weights, those of other networks, the pose prior."""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch import Tensor, nn

from hand_pose_ros.datasets.base import Dataset
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards
from hand_pose_ros.errors import TrainingError
from hand_pose_ros.models import NO_JOINTS, REFINERS, build
from hand_pose_ros.models.checkpoints import Checkpoint, load_checkpoint
from hand_pose_ros.models.dense import ADDED, HandDense
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.models.two_looks import TwoLooks
from hand_pose_ros.skeleton import Skeleton
from hand_pose_ros.training.augmentation import PRESETS, augment
from hand_pose_ros.training.objectives import PoseObjective, RefinerObjective, objective_for, which_count
from hand_pose_ros.training.recipes import Recipe

log = logging.getLogger(__name__)


def first_shard(recipe: Recipe, base: Checkpoint | None, data: Dataset) -> int:
    """The first shard of a run. A refiner starts after the shards on which its base was trained.

    Raises:
        TrainingError: the base of a refiner was trained on the whole dataset.
    """
    first = recipe.first_shard
    if recipe.refiner and (seen := shards_seen(recipe, base, data)):
        first = max(first, seen)
        if data.size is not None and first * recipe.shard_size >= data.size:
            raise TrainingError(f'{recipe.base} was trained on all of {data.name}, so its estimates there are better '
                                'than those that a refiner sees in use: train the base with --set last_shard=N, which '
                                'leaves the shards from N on to the refiner')
    return first


def shards_seen(recipe: Recipe, base: Checkpoint | None, data: Dataset) -> int:
    """The number of the first shard that a base, and the networks that it started from, have not seen.

    Shards are as large as the recipe says.
    """
    if base is None or base.metadata.get('training_data') != data.name:
        return 0
    of = base.metadata.get('recipe', {})
    if recipe.dataset == 'bags' and of.get('root', recipe.root) != recipe.root:  # other recordings have the same name
        return 0
    size = of.get('shard_size', recipe.shard_size)
    return -(-int(base.metadata['training_shards']) * size // recipe.shard_size)


def make_objective(recipe: Recipe, base: Checkpoint | None, shards: DiskShards | MemoryShards,
                   window: range) -> PoseObjective | RefinerObjective:
    """The network of a recipe and its loss, before the first step.

    Args:
        base: the checkpoint that `recipe.base` names.
        shards: the training samples.
        window: numbers of the shards to which the pose prior is fitted. These are the shards of the first steps. In a
            recorded dataset, they are all shards.

    Raises:
        TrainingError: the parts of the recipe, or its base, do not fit each other.
    """
    skeleton = shards.dataset.skeleton
    if base and base.metadata['skeleton'] != skeleton.name and recipe.network != 'center_refiner':  # all have a palm
        raise TrainingError(f'{recipe.base} gives joints of {base.metadata["skeleton"]}, but {recipe.dataset} has '
                            f'those of {skeleton.name}: choose a base with the same joints')
    if recipe.refiner:
        return _refiner_objective(recipe, base, skeleton)
    network = _make_network(recipe, base, skeleton)
    objective = objective_for(network, recipe, skeleton)
    has_prior = base is not None and _start_from(network, base, recipe)
    bottleneck = vars(network)['config'].get('bottleneck')  # some architectures have one by default
    if bottleneck and not has_prior:
        prior = fit_prior(_training_poses(objective, shards, window, recipe), bottleneck)
        network.set_prior(prior.mean, prior.components)  # type: ignore[operator]
        log.info('the prior keeps %.2f %% of the variance of the poses', 100 * prior.explained_variance_ratio.sum())
    if bottleneck and not recipe.train_prior:
        network.head.reconstruction.requires_grad_(False)  # type: ignore[union-attr]
    return objective


def _refiner_objective(recipe: Recipe, base: Checkpoint | None, skeleton: Skeleton) -> RefinerObjective:
    if base is None:
        raise TrainingError('a refiner needs the checkpoint that it corrects: --set base=FILE')
    if recipe.refiner not in REFINERS:
        raise TrainingError(f'--set refiner={recipe.refiner}: choose one of {", ".join(REFINERS)}')
    if (first := vars(base.network)['architecture']) in NO_JOINTS:
        raise TrainingError(f'{recipe.base} is a {first}, which gives no joints to correct: choose another base')
    options = {name: value for name, value in recipe.options.items() if name != 'bottleneck'}  # a refiner has none
    refiner = build(recipe.refiner, **options | {'joints': len(skeleton)})
    return RefinerObjective(refiner, base.network, recipe, skeleton)


def _make_network(recipe: Recipe, base: Checkpoint | None, skeleton: Skeleton) -> nn.Module:
    """The network of a recipe, with fresh weights. The first of two looks has those of its checkpoint."""
    if recipe.first and recipe.network != 'two_looks':
        raise TrainingError(f'--set first=FILE is for --set network=two_looks, and {recipe.network} has one look')
    if recipe.network in REFINERS:
        raise TrainingError(f'{recipe.network} corrects the joints of another network: train it with '
                            f'--set refiner={recipe.network} --set base=FILE, and leave out --set network')
    if (recipe.network == 'hand_finder') != (recipe.dataset == 'scenes'):
        raise TrainingError(f'{recipe.network} cannot learn from {recipe.dataset}: only hand_finder is trained with '
                            'dataset=scenes, and it needs this dataset')
    if recipe.network == 'hand_finder' and recipe.augmentation != PRESETS['none']:
        raise TrainingError('hand_finder has its own augmentation: leave out --set augmentation')
    given: dict[str, Any] = {}
    if recipe.network not in NO_JOINTS:
        given['joints'] = len(skeleton)
    first = None
    if recipe.network == 'two_looks':
        first = _first_look(recipe, base, skeleton)
        given |= {'root': skeleton.root, 'knuckles': skeleton.knuckles,
                  'first': {key: getattr(first, key) for key in ('width', 'bottleneck', 'blocks', 'refined')}}
    if taken := sorted(given.keys() & recipe.options.keys()):
        raise TrainingError(f'--set options.{taken[0]}: this follows from the dataset or the first look: leave it out')
    network = build(recipe.network, **given, **recipe.options)
    if first is not None:
        network.first.load_state_dict(first.state_dict())  # type: ignore[union-attr]
    return network


def _first_look(recipe: Recipe, base: Checkpoint | None, skeleton: Skeleton) -> HandDense:
    """The first of two looks. It is that of `recipe.first`, or else that of a base with two looks."""
    of = load_checkpoint(recipe.first) if recipe.first else None
    if of is None and base is not None and isinstance(base.network, TwoLooks):
        of = base
    first = of.network if of else None
    first = first.first if isinstance(first, TwoLooks) else first
    if of is None or not isinstance(first, HandDense) or of.metadata['skeleton'] != skeleton.name:
        raise TrainingError(f'two_looks needs a hand_dense with the joints of {skeleton.name} as its first look: '
                            '--set first=FILE')
    return first


def _start_from(network: nn.Module, base: Checkpoint, recipe: Recipe) -> bool:
    """Copy the weights of the base into the network. Returns False if a pose prior must still be fitted.

    The base may lack the prior, and all parts that start as the identity (further blocks of a stage, and the
    refinement). The second of two looks may start from any hand_dense, but not from its prior.

    Raises:
        TrainingError: the base is another network.
    """
    own = base.network.state_dict()
    if isinstance(network, TwoLooks):
        if isinstance(base.network, HandDense):
            own = {f'second.{name}': value for name, value in own.items() if not name.startswith('head.')}
        own |= {f'first.{name}': value for name, value in network.first.state_dict().items()}
    lacking = network.state_dict().keys() - own.keys()
    prior = {name for name in lacking if 'head' in name.split('.')}
    try:
        if needed := [name for name in lacking - prior if not ADDED.search(name)]:
            raise RuntimeError(f'{min(needed)} is missing')
        network.load_state_dict({**network.state_dict(), **own})
    except RuntimeError as error:
        raise TrainingError(f'{recipe.base} holds another network than the recipe names '
                            f'({recipe.network}, {recipe.options})') from error
    return not prior


def _training_poses(objective: PoseObjective, shards: DiskShards | MemoryShards, window: range,
                    recipe: Recipe) -> Tensor:
    """Augmented poses of the window, (N, J, 3). If there are few, each is augmented in several ways."""
    shards.keep(window)
    parts = [{key: value.cpu() for key, value in shards.read(shard).items() if key != 'patch'} for shard in window]
    samples = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    count = len(samples['joints'])
    turns = max(1, min(8, 16_384 // count))
    numbers = torch.arange(turns * count).split(count)
    batches = [augment(samples, recipe.augmentation, some, recipe.seed) for some in numbers]
    return torch.cat([objective.poses(batch)[which_count(batch)] for batch in batches])
