"""One training run: the loop, its validation, and how it is stopped and resumed."""

from __future__ import annotations

import copy
import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from hand_pose_ros.datasets import Batch, open_dataset
from hand_pose_ros.datasets.memory import keep_freed_memory
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards
from hand_pose_ros.errors import TrainingError
from hand_pose_ros.models.checkpoints import load_checkpoint, save_checkpoint
from hand_pose_ros.runtime import check_device
from hand_pose_ros.training.augmentation import augment
from hand_pose_ros.training.folder import RunFolder
from hand_pose_ros.training.gradients import Gradients
from hand_pose_ros.training.losses import Terms
from hand_pose_ros.training.objectives import RefinerObjective
from hand_pose_ros.training.optimizers import learning_rate, make_optimizer
from hand_pose_ros.training.recipes import EPOCH_OF_ENDLESS_DATA, Recipe, recipe_to_dict
from hand_pose_ros.training.start import first_shard, make_objective, shards_seen
from hand_pose_ros.training.state import load_state, save_state, save_tensors
from hand_pose_ros.training.stream import SampleStream
from hand_pose_ros.training.validation import estimate, some_samples

log = logging.getLogger(__name__)

TOLD_EVERY_S = 60.0
"""Seconds between two lines about the progress, where no terminal shows a bar."""


@dataclass(frozen=True)
class Machine:
    """Where to train. On a CPU, only the number of threads can change the result."""

    cache: Path
    """Folder of rendered and decoded samples, shared by all runs."""
    device: str = 'cpu'
    """A device of PyTorch, for example 'cuda:1'."""
    workers: int = 1
    """Number of processes that render or decode. With 0, this process does it on `device`, and keeps the samples in
    memory."""
    threads: int | None = None
    """Number of threads of PyTorch in this process; None = its default."""
    limit_gb: float = 40.0
    """Maximum size of the cache."""
    save_every_s: float = 120.0
    """Seconds after which the state of the run is saved again."""


def open_shards(recipe: Recipe, machine: Machine, split: str, device: torch.device) -> DiskShards | MemoryShards:
    """The samples of a recipe, made as the machine says."""
    opening = partial(open_dataset, recipe.dataset, split, Path(recipe.root) if recipe.root else None,
                      str(device) if machine.workers == 0 else 'cpu')
    if machine.workers == 0:
        return MemoryShards(opening(), recipe.shard_size)
    return DiskShards(opening, machine.cache, recipe.shard_size, machine.workers, machine.limit_gb, device)


class Run:
    """One training run: `Run(folder, recipe, machine).train()`.

    Raises:
        HandPoseError: the data, a checkpoint or a value of the recipe cannot be used.
    """

    def __init__(self, folder: Path, recipe: Recipe, machine: Machine) -> None:
        self.folder, self.recipe, self.machine = RunFolder(folder), recipe, machine
        self.rank, self.world = int(os.environ.get('RANK', 0)), int(os.environ.get('WORLD_SIZE', 1))
        if recipe.batch_size % self.world:
            raise TrainingError(f'a batch of {recipe.batch_size} cannot be shared equally by {self.world} processes')
        keep_freed_memory()
        torch.backends.cudnn.benchmark = True  # all steps have the same shapes
        if machine.threads:
            torch.set_num_threads(machine.threads)
        self._stop = self._waiting = self._ending = False
        check_device(machine.device)  # before minutes of rendering
        self.device = torch.device(machine.device)
        if self.device.type == 'cuda' and self.device.index is not None:
            torch.cuda.set_device(self.device)  # graphs are captured on the current device

        torch.manual_seed(recipe.seed)
        self.base = load_checkpoint(recipe.base) if recipe.base else None
        self.shards = open_shards(recipe, machine, 'train', self.device)
        self.skeleton = self.shards.dataset.skeleton
        # Opened now, so that missing validation data are an error before the training.
        self._val_shards = open_shards(recipe, machine, 'val', self.device)
        if (other := self._val_shards.dataset.skeleton.name) != self.skeleton.name:
            raise TrainingError(f'{self._val_shards.dataset.name} has joints of {other}, but '
                                f'{self.shards.dataset.name} those of {self.skeleton.name}: both must have the same')
        if recipe.last_shard is not None and self.shards.dataset.size is None:
            raise TrainingError(f'--set last_shard={recipe.last_shard} is for recorded datasets, but {recipe.dataset} '
                                'has no end: choose the number of its samples with --set samples=N')
        begin = first_shard(recipe, self.base, self.shards.dataset)
        self.stream = SampleStream(self.shards, recipe.batch_size, recipe.seed, recipe.reuse, begin, recipe.last_shard,
                                   (self.rank, self.world))
        first = load_checkpoint(recipe.first) if recipe.first else None
        # What the networks that it starts from have seen, the new network has seen.
        self._seen = max(shards_seen(recipe, each, self.shards.dataset) for each in (self.base, first))
        self.budget = recipe.samples or recipe.epochs * (self.stream.epoch_size or EPOCH_OF_ENDLESS_DATA)
        self.steps = -(-self.budget // recipe.batch_size)

        with self._signals(), self._interruptible():
            try:
                objective = make_objective(recipe, self.base, self.shards, self.stream.window(0)).to(self.device)
            except BaseException:
                self.shards.close()
                raise
        # On a CPU, convolutions of few channels are twice as fast with channels last.
        self.objective = objective.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged = copy.deepcopy(self.objective) if recipe.average else self.objective
        self.optimizer = make_optimizer(recipe, self.objective)
        self._next: Batch | None = None
        self._aside = torch.cuda.Stream(self.device, priority=-1) if self.device.type == 'cuda' else None
        self.step, self.best_mm = 0, float('inf')
        self._validated = 0
        """Step of the last validation."""
        self._result: dict[str, Any] = {}
        """Result of the last validation."""
        self._saved = time.monotonic()

    # The loop

    def train(self, resume: bool = False) -> dict[str, Any]:
        """Train to the end of the budget. Returns the result of the last validation.

        Raises:
            TrainingError: the folder holds a run already, the loss is not finite any more, or a signal ended the run.
            CheckpointError: `resume`, but the folder has no state to resume from, or a damaged one.
        """
        with self._signals():
            try:
                self._begin(resume)
                return self._loop(self._distributed())
            except KeyboardInterrupt:  # between two steps, see `_signals`
                if not self.step:
                    raise
                self._save()
                if self.rank == 0 and self._validated < self.step:
                    self._save_checkpoint('last', {})
                raise TrainingError(f'stopped by a signal after {self.step * self.recipe.batch_size:,} samples, with '
                                    f"weights in {self.folder.checkpoint('last')}; hand-pose train --out "
                                    f'{self.folder.path} --resume goes on (an experiment goes on by the same command)'
                                    ) from None
            finally:
                self.shards.close()
                self.folder.close()

    def _begin(self, resume: bool) -> None:
        if self.rank == 0:
            self.folder.lock()
        if resume:
            progress = load_state(self.folder.state, self._modules(), self.optimizer)
            self.step, self.best_mm = progress['step'], progress['best_mm'] or float('inf')
            if progress['data'] != self.shards.dataset.fingerprint:
                log.warning('the training data, or the code that makes them, have changed since step %s', self.step)
            self._validated, self._result = progress.get('validated', 0), progress.get('result', {})
            if self._validated >= self.steps and self.rank == 0:
                log.info('the run in %s is finished already', self.folder.path)
        elif self.rank == 0:
            self.folder.create(self.recipe)
        if self.rank == 0:
            self.folder.open(self.step, self.step * self.recipe.batch_size)
            log.info('%s on %s, step %s of %s, %s samples each; the recipe is in %s/config.json',
                     self.recipe.refiner or self.recipe.network, self.shards.dataset.name, self.step, self.steps,
                     self.recipe.batch_size, self.folder.path)

    def _loop(self, module: nn.Module) -> dict[str, Any]:
        recipe = self.recipe
        gradients = Gradients(module, self._autocast, captured=self.device.type == 'cuda' and self.world == 1)
        since, at = self.step, time.monotonic()
        told = at
        with tqdm(total=self.budget, initial=self.step * recipe.batch_size, unit='samples', unit_scale=True,
                  smoothing=0.05, disable=self.rank > 0 or None, dynamic_ncols=True) as bar:
            if self._validated < self.step and self._to_validate():  # the run was stopped before this validation
                self._validate()
            while self.step < self.steps:
                terms = self._train_step(gradients)
                bar.update(recipe.batch_size)
                done, last = self.step * recipe.batch_size, self.step == self.steps
                if (self.step % 50 == 0 or last) and self.rank == 0:
                    values = {name: round(float(value), 6) for name, value in terms.items()}
                    bar.set_postfix({**values, **self._result})
                    rate = (self.step - since) * recipe.batch_size / (time.monotonic() - at)
                    since, at = self.step, time.monotonic()
                    if bar.disable and at - told > TOLD_EVERY_S:
                        told = at
                        log.info('%s of %s samples, %.0f/s, %s', f'{done:,}', f'{self.budget:,}', rate, values)
                    self.folder.write({'step': self.step, 'samples': done, **values, 'rate': round(rate, 1),
                                       'learning_rate': self.optimizer.param_groups[0]['lr']})
                if self._ending and not last:
                    raise KeyboardInterrupt
                if self._to_validate():
                    self._save()  # a validation that fails must not lose what was trained
                    self._validate()
                elif time.monotonic() - self._saved > self.machine.save_every_s:
                    self._save()
        return self._result

    def _to_validate(self) -> bool:
        """Whether to validate after the last step."""
        done, size, every = self.step * self.recipe.batch_size, self.recipe.batch_size, self.recipe.val_every
        return self.step >= self.steps or done // every > (done - size) // every

    def _train_step(self, gradients: Gradients) -> Terms:
        """One step. It depends only on the weights, the state of the optimiser, the recipe and its number."""
        recipe = self.recipe
        for group in self.optimizer.param_groups:
            group['lr'] = learning_rate(recipe, self.step / self.steps)
        batch, self._next = self._next or self._prepare(), None
        if self._aside:
            torch.cuda.current_stream(self.device).wait_stream(self._aside)
        torch.manual_seed((recipe.seed * 1_000_003 + self.step) * 1009 + self.rank)  # for dropout
        terms = gradients(batch)
        self.optimizer.step()
        if recipe.average:
            self._update_average()
        self.step += 1
        try:
            if self._aside and self.step < self.steps:
                self._next = self._prepare()  # while the GPU computes this step
        finally:  # also if a signal ends the wait, because a spoilt state must not be saved
            self._check(batch, terms)
        return terms

    def _prepare(self) -> Batch:
        """The batch of the next step, on the device and augmented."""
        with self._interruptible(), torch.cuda.stream(self._aside) if self._aside else nullcontext():
            batch, numbers = self.stream.batch(self.step)
            batch = {key: value.to(self.device, non_blocking=True) for key, value in batch.items()}
            batch = augment(batch, self.recipe.augmentation, numbers, self.recipe.seed)
            # Not shifted as in `augment`, so that an objective draws other random numbers.
            batch['numbers'] = numbers.to(self.device) + (self.recipe.seed << 41)
        return batch

    def _check(self, batch: Batch, terms: Terms) -> None:
        """Make sure that the loss of the last step is finite, and find out whether the run must end after this step."""
        loss = torch.stack(list(terms.values())).sum()
        self._ending = self._stop
        if self.world > 1:  # if one process must stop, all stop after the same step
            shared = torch.stack([loss, loss.new_tensor(float(self._stop))])
            dist.all_reduce(shared)
            loss, self._ending = shared[0], bool(shared[1])
        if not torch.isfinite(loss):
            self._fail(batch, terms)

    def _autocast(self) -> AbstractContextManager[Any]:
        half = self.recipe.precision == 'bfloat16'
        return torch.autocast(self.device.type, torch.bfloat16) if half else nullcontext()

    @torch.no_grad()
    def _update_average(self) -> None:
        decay = min(self.recipe.average, (1 + self.step) / (10 + self.step))  # the random start is soon forgotten
        # Buffers, too. Running statistics are noisy and belong to the last weights. While the learning rate is high,
        # averaging them is worth millimetres.
        mine, theirs = ([*module.parameters(), *module.buffers()] for module in (self.averaged, self.objective))
        moving = [i for i, tensor in enumerate(mine) if tensor.is_floating_point()]
        torch._foreach_lerp_([mine[i] for i in moving], [theirs[i] for i in moving], 1 - decay)
        for i in set(range(len(mine))).difference(moving):
            mine[i].copy_(theirs[i])

    def _fail(self, batch: Batch, terms: Terms) -> None:
        step = self.step - 1
        path = self.folder.path / f'failed_batch_{step}_{self.rank}.safetensors'
        values = {name: str(value.item()) for name, value in terms.items()}
        save_tensors(path, batch, {'step': step, 'terms': values})
        raise TrainingError(f'the loss of step {step} is not finite ({values}); its batch is in {path}. If the batch '
                            f'looks right, train again with a learning_rate below {self.recipe.learning_rate}')

    def _distributed(self) -> nn.Module:
        if self.world == 1:
            return self.objective
        if self.device.type == 'cuda':
            nn.SyncBatchNorm.convert_sync_batchnorm(self.objective)
        return DistributedDataParallel(self.objective, [self.device] if self.device.type == 'cuda' else None)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """SIGTERM and Ctrl-C end the run after the current step, or at once while it waits for samples."""
        def stop(*_: Any) -> None:
            self._stop, waiting, self._waiting = True, self._waiting, False
            if waiting and self.world == 1:  # several processes stop together, after the same step
                raise KeyboardInterrupt
        before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """A signal in here ends the run at once. This is for waiting for samples, which does not change the run."""
        self._waiting = True
        try:
            yield
        finally:
            self._waiting = False

    # Validation and files

    def _validate(self) -> None:
        """Measure the error on the validation samples, and save the network. Only the first process does this."""
        if self.rank:
            return
        objective = self.averaged.eval()
        estimates, truths = estimate(objective.predict, self._validation, self.device, objective.joints)
        errors = 1000 * (estimates - truths).norm(dim=-1)
        within = {f'val_within_{mm}': round(float((errors.amax(1) <= mm).float().mean()), 4) for mm in (20, 30, 40)}
        result = {'val_mm': round(float(errors.mean()), 3), **within}
        log.info('%s samples: %s', f'{self.step * self.recipe.batch_size:,}', result)
        if result['val_mm'] < self.best_mm:
            self.best_mm = result['val_mm']
            self._save_checkpoint('best', result)
        self._save_checkpoint('last', result)
        self.folder.write({'step': self.step, 'samples': self.step * self.recipe.batch_size, **result})
        self._validated, self._result = self.step, result
        self._save()

    @cached_property
    def _validation(self) -> list[Batch]:
        with closing(self._val_shards) as shards, self._interruptible():
            return some_samples(shards, self.recipe.val_samples)

    def _save_checkpoint(self, name: str, result: dict[str, Any]) -> None:
        shards = max(self.stream.shards_used(self.step), self._seen)
        metadata = {'skeleton': self.skeleton.name, 'cube_side': self.shards.dataset.cube_side, 'validation': result,
                    'samples': self.step * self.recipe.batch_size, 'recipe': recipe_to_dict(self.recipe),
                    'training_data': self.shards.dataset.name, 'training_shards': shards}
        if isinstance(self.averaged, RefinerObjective):
            assert self.base is not None
            save_checkpoint(self.folder.checkpoint(name), self.base.network, metadata, self.averaged.refiner)
        else:
            save_checkpoint(self.folder.checkpoint(name), self.averaged.network, metadata)

    def _modules(self) -> dict[str, nn.Module]:
        return {'trained': self.objective, **({'averaged': self.averaged} if self.recipe.average else {})}

    def _save(self) -> None:
        self._saved = time.monotonic()
        if self.rank == 0:
            save_state(self.folder.state, self._modules(), self.optimizer,
                       {'step': self.step, 'finished': self._validated >= self.steps, 'validated': self._validated,
                        'result': self._result,
                        'data': self.shards.dataset.fingerprint,
                        'best_mm': self.best_mm if self.best_mm < float('inf') else None})
