"""The training loop."""

from __future__ import annotations

import copy
import json
import logging
import os
import signal
import subprocess
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from hand_pose_ros.datasets import Batch, joints_in_metres, open_dataset
from hand_pose_ros.datasets.memory import keep_freed_memory
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.training.augmentation import augment
from hand_pose_ros.training.objectives import DenseObjective, PoseObjective, RefinerObjective
from hand_pose_ros.training.optimizers import learning_rate, make_optimizer
from hand_pose_ros.training.recipes import EPOCH_OF_ENDLESS_DATA, Recipe, recipe_from_dict, recipe_to_dict
from hand_pose_ros.training.state import load_state, save_state, save_tensors
from hand_pose_ros.training.stream import SampleStream

log = logging.getLogger(__name__)


class TrainingError(HandPoseError):
    """Training that cannot start or go on."""


@dataclass(frozen=True)
class Machine:
    """Where to train; nothing here changes the result on a CPU."""

    cache: Path
    """Folder of rendered and decoded samples, shared by all runs."""
    device: str = 'cpu'
    workers: int = 1
    """Processes that render or decode; 0 = in this process, on `device`, kept in memory (for a GPU)."""
    threads: int | None = None
    limit_gb: float = 40.0
    save_every_s: float = 120.0
    """Seconds between two writings of the state to resume from."""


class Run:
    """One training run and its folder.

    config.json (recipe, version, git revision) · state.safetensors (to resume) · last.safetensors and best.safetensors
    (checkpoints to use) · metrics.jsonl · log.txt · TensorBoard events, if it is installed.
    """

    def __init__(self, folder: Path, recipe: Recipe, machine: Machine) -> None:
        self.folder, self.recipe, self.machine = folder, recipe, machine
        self.rank, self.world = int(os.environ.get('RANK', 0)), int(os.environ.get('WORLD_SIZE', 1))
        if recipe.batch_size % self.world:
            raise TrainingError(f'a batch of {recipe.batch_size} cannot be shared equally by {self.world} processes')
        keep_freed_memory()
        if machine.threads:
            torch.set_num_threads(machine.threads)
        torch.manual_seed(recipe.seed)
        self.device = torch.device(machine.device)
        if self.device.type == 'cuda':
            self.device = torch.device('cuda', int(os.environ.get('LOCAL_RANK', 0)))

        base = load_checkpoint(recipe.base) if recipe.base else None
        self.shards = self._open_shards('train')
        self.stream = SampleStream(self.shards, recipe.batch_size, recipe.seed, recipe.reuse,
                                   self._first_shard(base), recipe.last_shard, (self.rank, self.world))
        self.skeleton = self.shards.dataset.skeleton
        self.budget = recipe.samples or recipe.epochs * (self.stream.epoch_size() or EPOCH_OF_ENDLESS_DATA)
        self.steps = -(-self.budget // recipe.batch_size)

        if recipe.precision not in ('float32', 'bfloat16'):
            raise TrainingError(f"unknown precision '{recipe.precision}': choose float32 or bfloat16")
        # Channels last is what fast convolutions of few channels want, and twice as fast for them on a CPU.
        self.objective = self._make_objective(base).to(self.device, memory_format=torch.channels_last)
        self.averaged = copy.deepcopy(self.objective) if recipe.average else self.objective
        self.optimizer = make_optimizer(recipe, self.objective)
        self.step, self.best_mm = 0, float('inf')
        self._stop = False
        self._saved = time.monotonic()

    # What is trained, on what

    def _open_shards(self, split: str) -> DiskShards | MemoryShards:
        recipe, machine = self.recipe, self.machine
        device = str(self.device) if machine.workers == 0 else 'cpu'
        opening = partial(open_dataset, recipe.dataset, split, Path(recipe.root) if recipe.root else None, device)
        if machine.workers == 0:
            return MemoryShards(opening(), recipe.shard_size)
        return DiskShards(opening, machine.cache, recipe.shard_size, machine.workers, machine.limit_gb)

    def _first_shard(self, base: Checkpoint | None) -> int:
        first = self.recipe.first_shard
        if self.recipe.refiner and base and base.metadata.get('training_data') == self.shards.dataset.name:
            first = max(first, int(base.metadata['training_shards']))
            if self.shards.dataset.size is not None and first * self.recipe.shard_size >= self.shards.dataset.size:
                raise TrainingError(
                    f'{self.recipe.base} was trained on all of {self.shards.dataset.name}, so a refiner would learn from '
                    'estimates that are too good: train the base with --set last_shard=N and leave the rest to the refiner')
        return first

    def _make_objective(self, base: Checkpoint | None) -> PoseObjective | RefinerObjective:
        recipe, joints = self.recipe, len(self.skeleton)
        if recipe.refiner:
            if base is None:
                raise TrainingError('a refiner needs the checkpoint that it corrects: --set base=FILE')
            self.base: nn.Module | None = base.network
            return RefinerObjective(build(recipe.refiner, joints=joints), base.network, recipe)
        self.base = None
        network = build(recipe.network, joints=joints, **recipe.options)
        if base is not None:
            network.load_state_dict(base.network.state_dict())
        elif recipe.options.get('bottleneck'):
            prior = fit_prior(self._training_poses(), recipe.options['bottleneck'])
            network.set_prior(prior.mean, prior.components)  # type: ignore[operator]
            log.info('the prior keeps %.2f %% of the variance of the training poses',
                     100 * prior.explained_variance_ratio.sum())
        if recipe.options.get('bottleneck') and not recipe.train_prior:
            network.head.reconstruction.requires_grad_(False)  # type: ignore[union-attr]
        if hasattr(network, 'forward_full'):
            return DenseObjective(network, recipe, self.skeleton)
        return PoseObjective(network, recipe)

    def _training_poses(self) -> Tensor:
        """Poses as the network will meet them, augmented; the first shard has enough for a covariance."""
        samples = self.shards.read(self.stream.first)
        samples = {key: value.cpu() for key, value in samples.items() if key != 'patch'}
        poses = []
        for turn in range(8):  # each as often as it takes to cover the augmentation
            numbers = torch.arange(len(samples['joints'])) + turn * len(samples['joints'])
            poses.append(augment(samples, self.recipe.augmentation, numbers, self.recipe.seed)['joints'])
        return torch.cat(poses)[samples['hand_present'].repeat(8)]

    # The loop

    def train(self, resume: bool = False) -> dict[str, Any]:
        """Train to the end of the budget and return the last validation.

        Raises:
            TrainingError: the folder holds a run already, the loss is not finite any more, or a signal ended the run.
        """
        self._start(resume)
        module: nn.Module = self.objective
        if self.world > 1:
            if self.device.type == 'cuda':
                module = nn.SyncBatchNorm.convert_sync_batchnorm(module)
            module = DistributedDataParallel(module, [self.device.index] if self.device.index is not None else None)
        result: dict[str, Any] = {}
        with tqdm(total=self.budget, initial=self.step * self.recipe.batch_size, unit='samples', unit_scale=True,
                  smoothing=0.05, disable=self.rank > 0, dynamic_ncols=True) as bar:
            while self.step < self.steps:
                terms = self._train_step(module)
                self.step += 1
                bar.update(self.recipe.batch_size)
                done = self.step * self.recipe.batch_size
                every = self.recipe.val_every
                if self.step % 50 == 0 or self.step == self.steps:
                    values = {name: round(float(value), 6) for name, value in terms.items()}
                    bar.set_postfix({**values, **{k: v for k, v in result.items() if k == 'val_mm'}})
                    self._write({'step': self.step, 'samples': done, **values, 'rate': round(bar.format_dict['rate'] or 0, 1),
                                 'learning_rate': self.optimizer.param_groups[0]['lr']})
                if self._stop:
                    self._save()
                    raise TrainingError(f'stopped by a signal after {done:,} samples; continue with --resume')
                if done // every > (done - self.recipe.batch_size) // every or self.step == self.steps:
                    result = self._validate()
                    self._save()
                elif time.monotonic() - self._saved > self.machine.save_every_s:
                    self._save()
        self.shards.close()
        return result

    def _train_step(self, module: nn.Module) -> dict[str, Tensor]:
        recipe = self.recipe
        for group in self.optimizer.param_groups:
            group['lr'] = learning_rate(recipe, self.step / self.steps)
        batch, numbers = self.stream.batch(self.step)
        batch = {key: value.to(self.device, non_blocking=True) for key, value in batch.items()}
        batch = augment(batch, recipe.augmentation, numbers, recipe.seed)
        batch['numbers'] = numbers.to(self.device) + (recipe.seed << 41)
        torch.manual_seed((recipe.seed * 1_000_003 + self.step) * 1009 + self.rank)  # dropout
        module.train()
        with self._autocast():
            terms = module(batch)
        loss = torch.stack(list(terms.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if not torch.isfinite(loss):
            self._fail(batch, terms)
        self.optimizer.step()
        if recipe.average:
            self._update_average()
        return terms

    def _autocast(self) -> AbstractContextManager[Any]:
        half = self.recipe.precision == 'bfloat16'
        return torch.autocast(self.device.type, torch.bfloat16) if half else nullcontext()

    @torch.no_grad()
    def _update_average(self) -> None:
        decay = min(self.recipe.average, (1 + self.step) / (10 + self.step))  # the random start is forgotten soon
        trained, averaged = list(self.objective.parameters()), list(self.averaged.parameters())
        torch._foreach_lerp_(averaged, trained, 1 - decay)
        for mine, theirs in zip(self.averaged.buffers(), self.objective.buffers(), strict=True):
            mine.copy_(theirs)

    def _fail(self, batch: Batch, terms: dict[str, Tensor]) -> None:
        path = self.folder / f'failed_batch_{self.step}_{self.rank}.safetensors'
        save_tensors(path, batch, {'step': self.step, 'terms': {name: str(float(value)) for name, value in terms.items()}})
        raise TrainingError(
            f'the loss of step {self.step} is not finite ({", ".join(f"{k} {float(v)}" for k, v in terms.items())}); the batch '
            f'is in {path}. Resume with a smaller --set learning_rate= (now {self.recipe.learning_rate}), or look at the batch')

    # Validation and files

    @torch.no_grad()
    def _validate(self) -> dict[str, Any]:
        """Mean error on identities that training does not see; rank 0 alone."""
        if self.rank:
            return {}
        errors = validate(self.averaged, self._validation(), self.device)
        worst = errors.amax(1)
        result = {'val_mm': round(float(errors.mean()), 3),
                  **{f'val_within_{mm}': round(float((worst <= mm).float().mean()), 4) for mm in (20, 30, 40)}}
        self._write({'step': self.step, 'samples': self.step * self.recipe.batch_size, **result})
        log.info('%s samples: %s', f'{self.step * self.recipe.batch_size:,}', result)
        if result['val_mm'] < self.best_mm:
            self.best_mm = result['val_mm']
            self._save_checkpoint('best', result)
        self._save_checkpoint('last', result)
        return result

    def _validation(self) -> list[Batch]:
        if not hasattr(self, '_validation_shards'):
            shards = self._open_shards('val')
            wanted = min(self.recipe.val_samples, shards.dataset.size or self.recipe.val_samples)
            numbers = range(-(-wanted // self.recipe.shard_size))
            shards.keep(numbers)
            self._validation_shards = [shards.read(i) for i in numbers]
            excess = sum(len(s['patch']) for s in self._validation_shards) - wanted
            if excess:
                last = self._validation_shards[-1]
                self._validation_shards[-1] = {key: value[:-excess] for key, value in last.items()}
            if isinstance(shards, DiskShards):
                shards.close()
        return self._validation_shards

    def _save_checkpoint(self, name: str, result: dict[str, Any]) -> None:
        objective = self.averaged
        metadata = {'skeleton': self.skeleton.name, 'cube_side': 0.30, 'samples': self.step * self.recipe.batch_size,
                    'validation': result, 'recipe': recipe_to_dict(self.recipe),
                    'training_data': self.shards.dataset.name, 'training_shards': self.stream.shards_used(self.step)}
        path = self.folder / f'{name}.safetensors'
        if isinstance(objective, RefinerObjective):
            assert self.base is not None
            save_checkpoint(path, self.base, metadata, refiner=objective.refiner)
        else:
            save_checkpoint(path, objective.network, metadata)

    def _modules(self) -> dict[str, nn.Module]:
        return {'trained': self.objective, **({'averaged': self.averaged} if self.recipe.average else {})}

    def _save(self) -> None:
        self._saved = time.monotonic()
        if self.rank == 0:
            save_state(self.folder / 'state.safetensors', self._modules(), self.optimizer,
                       {'step': self.step, 'best_mm': self.best_mm if self.best_mm < float('inf') else None})

    def _start(self, resume: bool) -> None:
        if self.rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
        state = self.folder / 'state.safetensors'
        if resume:
            progress = load_state(state, self._modules(), self.optimizer)
            self.step, self.best_mm = progress['step'], progress['best_mm'] or float('inf')
        elif state.exists():
            raise TrainingError(f'{self.folder} holds a run already: continue it with --resume, or choose another --out')
        elif self.rank == 0:
            _write_json(self.folder / 'config.json', {'recipe': recipe_to_dict(self.recipe), 'git': _git_revision()})
        self._tensorboard = None
        if self.rank == 0:
            logging.getLogger('hand_pose_ros').addHandler(logging.FileHandler(self.folder / 'log.txt'))
            try:
                from torch.utils.tensorboard import SummaryWriter
                self._tensorboard = SummaryWriter(str(self.folder))
            except ImportError:
                log.info('no TensorBoard events: it is not installed')
        log.info('%s %s samples, %s steps, %s', 'resuming at step %d,' % self.step if resume else 'starting,',
                 f'{self.budget:,}', f'{self.steps:,}', self.recipe)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def _on_signal(self, *_: Any) -> None:
        self._stop = True

    def _write(self, values: dict[str, Any]) -> None:
        if self.rank:
            return
        with open(self.folder / 'metrics.jsonl', 'a', encoding='utf-8') as file:
            file.write(json.dumps(values) + '\n')
        if self._tensorboard is not None:
            for name, value in values.items():
                self._tensorboard.add_scalar(name, value, values['samples'])


def resume_recipe(folder: Path) -> Recipe:
    """The recipe that a run was started with.

    Raises:
        TrainingError: the folder holds no run.
    """
    try:
        return recipe_from_dict(json.loads((folder / 'config.json').read_text())['recipe'])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f'{folder} holds no run to resume ({error})') from error


@torch.no_grad()
def validate(objective: PoseObjective | RefinerObjective, batches: list[Batch], device: torch.device) -> Tensor:
    """Distances (N, J) in mm between estimated and true joints, of the samples that show a hand."""
    objective.eval()
    errors = []
    for shard in batches:
        for start in range(0, len(shard['patch']), 256):
            batch = {key: value[start:start + 256].to(device) for key, value in shard.items()}
            estimate = objective.predict(batch['patch'].float())
            cube = batch['cube_center'], batch['cube_side']
            distance = joints_in_metres(estimate, *cube) - joints_in_metres(batch['joints'], *cube)
            errors.append(1000 * distance.norm(dim=-1)[batch['hand_present']].cpu())
    return torch.cat(errors)


def _write_json(path: Path, values: dict[str, Any]) -> None:
    temporary = path.with_suffix('.tmp')
    temporary.write_text(json.dumps(values, indent=2))
    os.replace(temporary, path)


def _git_revision() -> str | None:
    try:
        return subprocess.run(['git', 'describe', '--always', '--dirty', '--abbrev=12'], cwd=Path(__file__).parent,
                              capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
