"""Everything that a run needs to go on as if it had never stopped, in one safetensors file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from hand_pose_ros.errors import CheckpointError
from hand_pose_ros.files import in_one_step


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors and a dictionary for JSON to one safetensors file, in one step."""
    with in_one_step(path) as part:
        save_file({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, part,
                  metadata={'json': json.dumps(metadata)})


def save_state(path: Path, modules: dict[str, nn.Module], optimizer: Optimizer, progress: dict[str, Any]) -> None:
    """Write the modules, the state of the optimiser, and plain values that JSON can hold (step, best result)."""
    tensors = {f'{name}.{key}': value for name, module in modules.items() for key, value in module.state_dict().items()}
    for index, values in optimizer.state_dict()['state'].items():
        tensors |= {f'optimizer.{index}.{key}': torch.as_tensor(value) for key, value in values.items()}
    # safetensors refuses tensors that share memory, as those of the network and its average might. So each is cloned.
    save_tensors(path, {key: value.clone() for key, value in tensors.items()}, progress)


def load_progress(path: Path) -> dict[str, Any]:
    """Only the plain values. The file must exist and be whole."""
    with safe_open(path, 'pt') as file:
        return json.loads(file.metadata()['json'])


def load_state(path: Path, modules: dict[str, nn.Module], optimizer: Optimizer) -> dict[str, Any]:
    """Read the state of the modules and the optimiser. Returns the plain values.

    Raises:
        CheckpointError: the file is missing or damaged, or belongs to another network.
    """
    try:
        with safe_open(path, 'pt') as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            progress = json.loads(file.metadata()['json'])
        for name, module in modules.items():
            module.load_state_dict(_under(tensors, name))
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in _under(tensors, 'optimizer').items():
            index, name = key.split('.', 1)
            state.setdefault(int(index), {})[name] = value
        optimizer.load_state_dict({'state': state, 'param_groups': optimizer.state_dict()['param_groups']})
        if missing := {'step', 'best_mm', 'data'} - progress.keys():
            raise ValueError(f'it does not say its {min(missing)}')
    except FileNotFoundError as error:
        raise CheckpointError(f'{path} is missing: there is nothing to resume; start without --resume') from error
    except (SafetensorError, AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path} cannot be resumed from: {' '.join(str(error).split())}") from error
    return progress


def _under(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key[len(name) + 1:]: value for key, value in tensors.items() if key.startswith(f'{name}.')}
