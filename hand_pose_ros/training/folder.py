"""The folder of a training run: its recipe, its progress, and its checkpoints."""

from __future__ import annotations

import json
import logging
import subprocess
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from hand_pose_ros.errors import TrainingError
from hand_pose_ros.files import check_writable, write_bytes, write_json
from hand_pose_ros.training.recipes import Recipe, recipe_from_dict, recipe_to_dict

log = logging.getLogger(__name__)


class RunFolder:
    """The files of one run:

    - config.json: the recipe and the git revision
    - state.safetensors: everything that is needed to resume the run
    - last.safetensors, best.safetensors: checkpoints
    - metrics.jsonl, log.txt, and events for TensorBoard if it is installed
    - .lock: see `lock`
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.state = path / 'state.safetensors'
        self._tensorboard: Any = None
        self._log: logging.Handler | None = None
        self._lock = FileLock(path / '.lock')

    def checkpoint(self, name: str) -> Path:
        """The file of the checkpoint 'best' or 'last'."""
        return self.path / f'{name}.safetensors'

    def recipe(self) -> Recipe:
        """The recipe of the run.

        Raises:
            TrainingError: there is no run in this folder.
        """
        try:
            return recipe_from_dict(json.loads((self.path / 'config.json').read_text())['recipe'])
        except FileNotFoundError:
            raise TrainingError(f'{self.path} holds no run to resume, for there is no config.json in it: give the '
                                'folder of a run, or begin one without --resume') from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TrainingError(f'{self.path} holds no run to resume, for its config.json cannot be used ({error}): '
                                'begin another run in another folder') from error

    def require_none(self) -> None:
        """Raise TrainingError if the folder holds a run already."""
        if self.state.exists():
            raise TrainingError(f'{self.path} holds a run already: continue it with --resume, or choose another --out')

    def lock(self) -> None:
        """Keep other processes from training in this folder, until `close` or the end of this process.

        Raises:
            TrainingError: another process trains in this folder.
            InputError: the folder cannot be made or written.
        """
        check_writable(self.path / '.lock')
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise TrainingError(f'{self.path}: another process trains in this folder: wait for its end, or choose '
                                'another --out') from None
        for left in self.path.glob('.*.safetensors.*.part'):  # left by a process that was killed
            left.unlink(missing_ok=True)

    def create(self, recipe: Recipe) -> None:
        """Write config.json of a new run.

        Raises:
            TrainingError: the folder holds a run already.
        """
        self.require_none()
        write_json(self.path / 'config.json', {'recipe': recipe_to_dict(recipe), 'git': _git_revision()})

    def open(self, step: int, samples: int) -> None:
        """Open the logs. If the run is resumed, what they hold after this step (or number of samples) is removed."""
        metrics = self.path / 'metrics.jsonl'
        if metrics.exists():
            lines = metrics.read_text('utf-8', 'replace').splitlines(keepends=True)
            write_bytes(metrics, ''.join(line for line in lines if _step(line) <= step).encode())
        self._log = logging.FileHandler(self.path / 'log.txt')
        self._log.setFormatter(logging.Formatter('%(asctime)s %(message)s'))
        logger = logging.getLogger(__package__)
        logger.addHandler(self._log)
        logger.setLevel(logging.INFO)
        try:
            from torch.utils.tensorboard import SummaryWriter
            self._tensorboard = SummaryWriter(str(self.path), purge_step=samples + 1 if step else None)
        except ImportError:
            log.info('no events for TensorBoard: it is not installed')

    def write(self, values: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl, and the same values to TensorBoard. One of them must be 'samples'."""
        with open(self.path / 'metrics.jsonl', 'a', encoding='utf-8') as file:
            file.write(json.dumps(values) + '\n')
        if self._tensorboard is not None:
            for name, value in values.items():
                self._tensorboard.add_scalar(name, value, values['samples'])

    def close(self) -> None:
        """Close the logs and release the lock."""
        self._lock.release()
        if self._tensorboard is not None:
            self._tensorboard.close()
        if self._log is not None:
            logging.getLogger(__package__).removeHandler(self._log)
            self._log.close()


def _step(line: str) -> float:
    try:
        return float(json.loads(line)['step'])
    except (ValueError, KeyError, TypeError):  # damaged, or the last line of a process that was killed
        return float('inf')


def _git_revision() -> str | None:
    try:
        return subprocess.run(['git', 'describe', '--always', '--dirty', '--abbrev=12'], cwd=Path(__file__).parent,
                              capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
