"""The experiments of the paper (section 4). Each is one call, which trains missing networks, tests, and writes results.

All experiments in a folder share their networks, so each is trained once. A training run that was interrupted is
resumed.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.datasets.synthetic import INGREDIENTS
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.evaluation import plots
from hand_pose_ros.evaluation.benchmark_evaluation import NOMINAL
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.files import write_bytes, write_json
from hand_pose_ros.models import REFINERS, build
from hand_pose_ros.models.checkpoints import Checkpoint, load_checkpoint
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.runtime import make_engine
from hand_pose_ros.runtime.engine import Pipeline, TorchEngine
from hand_pose_ros.runtime.timing import measure
from hand_pose_ros.skeleton import Skeleton, get_skeleton
from hand_pose_ros.training import figures
from hand_pose_ros.training.folder import RunFolder
from hand_pose_ros.training.loop import Machine, Run, open_shards
from hand_pose_ros.training.recipes import Recipe, recipe_to_dict
from hand_pose_ros.training.state import load_progress
from hand_pose_ros.training.validation import estimate, some_samples

log = logging.getLogger(__name__)

TEST_SAMPLES = 5000
"""Number of synthetic test samples, which are those of synthetic-test-v1. Recorded datasets use all test frames."""
WIDTHS = (None, 2, 4, 8, 16, 30)
"""Widths of the bottleneck; None = direct regression."""
ITERATIONS = 4
"""Maximum number of iterations of a refiner."""
ROUNDS = 10
"""Rounds of `runtime.timing.measure`."""

PAPER_MS = {'shallow': (0.07, 1.85), 'deep': (0.10, 2.08), 'multi_scale': (0.81, 5.36), 'deep-30': (0.09, 2.29),
            'deep-30 + or_ref': (2.38, 62.91)}
"""Run times of the networks in the paper, in milliseconds (GTX 780 Ti, i7 CPU). Those of refinement are without the
network before it."""


@dataclass
class Laboratory:
    """Where experiments train and test.

    Args:
        folder: for the results, and runs/NAME for each network.
        recipe: what all networks have in common. An experiment changes only the network, so the budgets are equal.
        machine: where to train.
    """

    folder: Path
    recipe: Recipe
    machine: Machine

    def __post_init__(self) -> None:
        self.folder = self.folder.resolve()  # the recipe of a refiner holds the path of its base

    def train(self, name: str, **changes: Any) -> Checkpoint:
        """The trained network with this name. `changes` replace values of the common recipe."""
        folder = RunFolder(self.folder / 'runs' / name)
        recipe = dataclasses.replace(self.recipe, **changes)
        started = folder.state.exists()
        if started and _resolved(folder.recipe()) != _resolved(recipe):
            raise HandPoseError(f'{folder.path} was trained with another recipe: choose another --out, or delete it')
        if not (started and folder.checkpoint('last').exists() and load_progress(folder.state)['finished']):
            log.info('training %s', name)
            Run(folder.path, recipe, self.machine).train(resume=started)
        return load_checkpoint(folder.checkpoint('last'))

    def network(self, architecture: str, width: int | None) -> Checkpoint:
        """The trained network of an architecture, with a bottleneck of this width; None = direct regression."""
        return self.train(label(architecture, width), network=architecture, options=self.options(width))

    def options(self, width: int | None) -> dict[str, Any]:
        """The options of the common recipe, with a bottleneck of this width."""
        return {**self.recipe.options, 'bottleneck': width}

    def check_refiner(self) -> None:
        """Raise HandPoseError if no samples would be left to train a refiner, before any network is trained."""
        recipe = self.recipe
        with closing(open_shards(recipe, self.machine, 'train', torch.device('cpu'))) as shards:
            if shards.dataset.size is not None and recipe.last_shard is None:
                count = -(-shards.dataset.size // recipe.shard_size)
                raise HandPoseError('a refiner learns from frames that its base has not seen: leave some of the '
                                    f'{count} shards of {shards.dataset.name} to it, for example with --set last_shard='
                                    f'{max(1, count * 4 // 5)}')

    def refined(self, refiner: str) -> Checkpoint:
        """Deep-Prior with this refiner. The refiner is trained on the shards after those of Deep-Prior."""
        self.network('deep', 30)
        base = RunFolder(self.folder / 'runs' / label('deep', 30)).checkpoint('last')
        return self.train(f'deep-30-{refiner}', refiner=refiner, base=str(base), last_shard=None)

    @cached_property
    def test(self) -> list[Batch]:
        """The test samples."""
        with closing(open_shards(self.recipe, self.machine, 'test', torch.device('cpu'))) as shards:
            log.info('preparing the test samples (%s)', shards.dataset.name)
            return some_samples(shards, shards.dataset.size or TEST_SAMPLES)

    def result(self, name: str, checkpoint: Checkpoint) -> Result:
        """The joints that a network predicts for the test samples, refined if the checkpoint has a refiner."""
        network, refiner = checkpoint.network, checkpoint.refiner

        def predict(patch: torch.Tensor) -> torch.Tensor:
            joints = network(patch)
            return refiner(patch, joints, iterations=2) if refiner is not None else joints

        estimates, truths = estimate(predict, self.test, torch.device('cpu'))
        return _result(name, get_skeleton(checkpoint.metadata['skeleton']), estimates, truths,
                       samples=checkpoint.metadata['samples'], dataset=self.recipe.dataset)

    def chain(self, name: str, checkpoint: Checkpoint) -> list[Result]:
        """The results after 1, 2, ... ITERATIONS iterations of the refiner."""
        network, refiner = checkpoint.network, checkpoint.refiner
        skeleton = get_skeleton(checkpoint.metadata['skeleton'])
        assert refiner is not None

        def predict(patch: torch.Tensor) -> torch.Tensor:
            joints = [network(patch)]
            for _ in range(ITERATIONS):
                joints.append(refiner(patch, joints[-1], iterations=1))
            return torch.cat(joints[1:], dim=1)

        every = list(range(len(skeleton))) * ITERATIONS
        estimates, truths = (part.unflatten(1, (ITERATIONS, len(skeleton)))
                             for part in estimate(predict, self.test, torch.device('cpu'), every))
        return [_result(f'{name} x{i + 1}', skeleton, estimates[:, i], truths[:, i],
                        samples=checkpoint.metadata['samples'], dataset=self.recipe.dataset) for i in range(ITERATIONS)]

    def truth_through(self, width: int, skeleton: Skeleton) -> Result:
        """The true poses of the test samples, projected onto their principal components.

        No network with a bottleneck of this width can be much better.
        """
        joints, center, side = (torch.cat([batch[key][batch['hand_present']] for batch in self.test])
                                for key in ('joints', 'cube_center', 'cube_side'))
        poses = joints.flatten(1).numpy()
        prior = fit_prior(poses, min(width, len(poses)))
        kept = torch.from_numpy(prior.reconstruct(prior.project(poses))).float().view_as(joints)
        return _result(f'truth in {width} components', skeleton, joints_in_metres(kept, center, side),
                       joints_in_metres(joints, center, side), dataset=self.recipe.dataset)

    def write(self, name: str, table: str, values: dict[str, Any], figure: Figure) -> str:
        """Write NAME.json, NAME.md, NAME.png and NAME.svg. Returns the table."""
        write_json(self.folder / f'{name}.json', {'recipe': recipe_to_dict(self.recipe), **values})
        write_bytes(self.folder / f'{name}.md', table.encode())
        plots.save(figure, self.folder / name)
        return table

    def write_results(self, name: str, results: Sequence[Result], figure: Figure) -> str:
        """Write the results of networks, as `write` does. Returns their table."""
        return self.write(name, accuracy_table(results), {'results': [result.summary() for result in results]}, figure)


def _resolved(recipe: Recipe) -> Recipe:
    """The recipe with an absolute path of its base, so that it can be compared."""
    return dataclasses.replace(recipe, base=recipe.base and str(Path(recipe.base).resolve()))


def _result(name: str, skeleton: Skeleton, estimates: torch.Tensor, truths: torch.Tensor, **info: Any) -> Result:
    note = 'left hands are mirrored; crops as in training; cameras may be mixed: the intrinsics are nominal'
    return Result(name, skeleton, NOMINAL, estimates.double().numpy(), truths.double().numpy(), notes=(note,),
                  info=info, in_time=False)


def label(architecture: str, width: int | None) -> str:
    """The name of a network in tables and folders, for example deep-30 or deep-direct."""
    return f'{architecture}-{width or "direct"}'


def accuracy_table(results: Sequence[Result]) -> str:
    """Markdown table of mean and median error, and of the share of frames whose worst joint is within a distance."""
    rows = ['| network | mean mm | median mm | <= 20 mm | <= 30 mm | <= 40 mm | <= 80 mm |', '|---' * 7 + '|']
    for result in results:
        s = result.summary()
        within = ' | '.join(f'{100 * s["within_mm"][key]:.1f} %' for key in ('20', '30', '40', '80'))
        rows.append(f'| {result.name} | {s["mean_mm"]:.2f} | {s["median_mm"]:.2f} | {within} |')
    return '\n'.join(rows) + '\n'


def networks(lab: Laboratory) -> str:
    """Shallow, Deep and Multi-Scale, without the prior and with bottlenecks of 8 and 30, and DeepPrior++."""
    wanted = [(architecture, width) for architecture in ('shallow', 'deep', 'multi_scale') for width in (None, 8, 30)]
    results = [lab.result(label(*which), lab.network(*which)) for which in [*wanted, ('resnet', 30)]]
    best = sorted(results, key=lambda result: float(np.mean(result.errors_mm)))[:8]
    return lab.write_results('networks', results, plots.curves(best))


def bottleneck(lab: Laboratory) -> str:
    """The Deep network with bottlenecks of several widths, and direct regression (the left figures of the paper)."""
    results = [lab.result(label('deep', width), lab.network('deep', width)) for width in WIDTHS]
    lab.write_results('bottleneck-curves', results, plots.curves(results))
    floors = [lab.truth_through(width, results[0].skeleton) for width in WIDTHS if width is not None]
    return lab.write_results('bottleneck', [*results, *floors], figures.bottleneck(results, floors, WIDTHS))


def refinement(lab: Laboratory) -> str:
    """No refinement, and one to four iterations of StdRef and ORRef (the right figures of the paper)."""
    lab.check_refiner()
    results = [lab.result('deep-30', lab.network('deep', 30))]
    for refiner in REFINERS:
        results += lab.chain(f'deep-30 + {refiner}', lab.refined(refiner))
    twice = [results[0], *(result for result in results if result.name.endswith('x2'))]
    lab.write_results('refinement-curves', twice, plots.curves(twice))
    return lab.write_results('refinement', results, figures.iterations(results))


def joints(lab: Laboratory) -> str:
    """Mean error of each joint with direct regression, with the prior, and with two iterations of refinement."""
    lab.check_refiner()
    results = [lab.result('deep-direct', lab.network('deep', None)), lab.result('deep-30', lab.network('deep', 30)),
               lab.result('deep-30 + or_ref x2', lab.refined('or_ref'))]
    return lab.write_results('joints', results, plots.joint_bars(results))


def qualitative(lab: Laboratory) -> str:
    """Estimate and truth on the patch, and on its points from the side, for good to bad frames."""
    result = lab.result('deep-30', lab.network('deep', 30))
    order = np.argsort(result.errors_mm.mean(1))
    ranks = [int(share * (len(order) - 1)) for share in (0.05, 0.25, 0.5, 0.75, 0.95)]
    figure = figures.qualitative(result, lab.test, order[ranks])
    return lab.write_results('qualitative', [result], figure)


def runtime(lab: Laboratory) -> str:
    """Milliseconds for one hand, on this machine and in the paper. Weights are random, which takes the same time."""
    patch = lab.test[0]['patch'][:1].float().numpy()
    calls: dict[str, Callable[[], Any]] = {}
    for name in PAPER_MS:
        first, _, second = name.partition(' + ')
        architecture, _, width = first.partition('-')
        network = build(architecture, bottleneck=int(width) if width else None)
        refiner = build(second) if second else None
        calls[f'{name}|eager'] = partial(TorchEngine(Pipeline(network, refiner).eval()).run, patch)
        calls[f'{name}|fast'] = partial(make_engine(network, 'cpu', refiner=refiner).run, patch)
    rows = measure(calls, ROUNDS)
    table = ['| network | paper GPU | paper CPU | here, PyTorch | here, fastest engine |', '|---|---|---|---|---|']
    for name, (gpu, cpu) in PAPER_MS.items():
        table.append(f'| {name} | {gpu} | {cpu} | {rows[f"{name}|eager"]["p50_ms"]:.2f} | '
                     f'{rows[f"{name}|fast"]["p50_ms"]:.2f} |')
    text = 'Median milliseconds for one hand.\n\n' + '\n'.join(table) + '\n'
    return lab.write('runtime', text, {'rows': rows, 'paper_ms': PAPER_MS}, figures.runtime(rows, PAPER_MS))


def ingredients(lab: Laboratory) -> str:
    """Deep-Prior, trained on synthetic hands that lack one or all ingredients, and tested on complete ones."""
    if lab.recipe.dataset != 'synthetic':
        raise HandPoseError(f'--set dataset={lab.recipe.dataset}: only synthetic hands have ingredients to leave out')
    results = [lab.result('complete', lab.network('deep', 30))]
    for name in (*INGREDIENTS, 'everything'):
        checkpoint = lab.train(f'deep-30-without-{name}', network='deep', options=lab.options(30),
                               dataset=f'synthetic:without-{name}')
        results.append(lab.result(f'without {name}', checkpoint))
    return lab.write_results('ingredients', results, plots.curves(results))


EXPERIMENTS: dict[str, Callable[[Laboratory], str]] = {
    experiment.__name__: experiment for experiment in (
        networks, bottleneck, refinement, joints, runtime, qualitative, ingredients)}
