"""Weights on disk: one safetensors file with everything that is needed to run the network. No pickles."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from hand_pose_ros import __version__
from hand_pose_ros.errors import CheckpointError, HandPoseError
from hand_pose_ros.files import in_one_step
from hand_pose_ros.models import build
from hand_pose_ros.skeleton import get_skeleton

WEIGHTS = Path(__file__).resolve().parents[1] / 'weights'
DEFAULT = 'hand_dense'
_AGAIN = 'copy or download it again, or write it again with save_checkpoint'


@dataclass(frozen=True)
class Checkpoint:
    """A network and its refiner (in eval mode, float32, on the CPU), and their metadata.

    `metadata` holds at least architecture, config, skeleton (a name), cube_side (metres) and version.
    """

    network: nn.Module
    refiner: nn.Module | None = None
    metadata: dict[str, Any] = field(default_factory=dict)


def available() -> dict[str, Path]:
    """The checkpoints that ship with the package: name -> file."""
    return {path.stem: path for path in sorted(WEIGHTS.glob('*.safetensors'))}


def save_checkpoint(path: str | Path, network: nn.Module, metadata: dict[str, Any],
                    refiner: nn.Module | None = None) -> None:
    """Write a network (and its refiner), both made by `build`. The file is written in one step, never half.

    The trained weights are stored as float16. Running statistics stay float32, because their range is open.

    Args:
        metadata: must have 'skeleton' and 'cube_side' [m]. All other keys that JSON can hold are kept.

    Raises:
        CheckpointError: the metadata lacks a key, or a weight is not finite (or too large for float16).
    """
    path = Path(path)
    if missing := {'skeleton', 'cube_side'} - metadata.keys():
        raise CheckpointError(f"the metadata of checkpoint {path} lacks {', '.join(sorted(missing))}")
    metadata = {**metadata, **_description(network), 'version': __version__}
    metadata.pop('refiner', None)  # it belongs to the checkpoint from which these metadata were taken
    tensors = _tensors('network', network)
    if refiner is not None:
        metadata['refiner'] = _description(refiner)
        tensors |= _tensors('refiner', refiner)
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise CheckpointError(f"checkpoint {path} is not written: '{name}' holds values that are "
                                  'not finite or too large for float16 (did training diverge?)')
    with in_one_step(path) as part:
        save_file(tensors, part, metadata={'hand_pose_ros': json.dumps(metadata)})


def load_checkpoint(name_or_path: str | PathLike[str] | None = None) -> Checkpoint:
    """A checkpoint that ships, by name (None = the default), or any other checkpoint, by path.

    Raises:
        CheckpointError: the name is unknown; the file is missing, damaged or of another program; or the weights do not
            fit the network.
    """
    path = _locate(DEFAULT if name_or_path is None else name_or_path)
    metadata, tensors = _read(path)
    network = _restore(path, 'network', metadata, tensors)
    refiner = _restore(path, 'refiner', metadata['refiner'], tensors) if 'refiner' in metadata else None
    try:
        skeleton = get_skeleton(metadata['skeleton'])
    except HandPoseError as error:
        raise CheckpointError(f'checkpoint {path}: {error}') from error
    for part in (metadata, metadata.get('refiner', {})):
        joints = part.get('config', {}).get('joints')
        if joints not in (None, len(skeleton)):
            raise CheckpointError(f"checkpoint {path} predicts {joints} joints, "
                                  f"but its skeleton '{skeleton.name}' has {len(skeleton)}: {_AGAIN}")
    return Checkpoint(network, refiner, metadata)


def described(metadata: Mapping[str, Any]) -> tuple[str, str]:
    """Name and version of a model, for HandSkeleton."""
    return str(metadata.get('name', metadata['architecture'])), str(metadata['version'])


def _description(network: nn.Module) -> dict[str, Any]:
    return {key: vars(network)[key] for key in ('architecture', 'config')}


def _tensors(part: str, network: nn.Module) -> dict[str, Tensor]:
    weights = {name for name, _ in network.named_parameters()}
    return {f'{part}.{name}': (tensor.half() if name in weights else tensor).contiguous().cpu()
            for name, tensor in network.state_dict().items()}


def _locate(name_or_path: str | PathLike[str]) -> Path:
    name = str(name_or_path)
    if name in (shipped := available()):
        return shipped[name]
    path = Path(name_or_path).expanduser()
    if path.is_file():
        return path
    if path.suffix or os.sep in name:
        raise CheckpointError(f'there is no checkpoint file {path}: give another path, or one of '
                              f"{', '.join(shipped) or 'none yet'}, which ship")
    raise CheckpointError(f"there is no checkpoint named '{name}': the ones that ship are "
                          f"{', '.join(shipped) or 'none yet'}; or give the path of a .safetensors file")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with open(path, 'rb') as file:
            start = file.read(9)
    except OSError as error:
        raise CheckpointError(f'checkpoint {path} cannot be read ({error.strerror}): check its permissions') from error
    # A pickle with its protocol, or a zip with a pickle (torch.save). A safetensors file begins with a length, which
    # may have the same bytes. But its header follows.
    if start[8:] != b'{' and re.match(rb'\x80[\x02-\x05]|PK\x03\x04', start):
        raise CheckpointError(f'{path} is a pickle, which can run code when read: give a .safetensors file')
    try:
        with safe_open(path, framework='pt') as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f'checkpoint {path} is damaged or no safetensors file ({error}): '
                              'copy or download it again') from error
    try:
        metadata = json.loads(header['hand_pose_ros'])
        missing = {'architecture', 'config', 'skeleton', 'cube_side', 'version'} - metadata.keys()
    except (KeyError, ValueError, AttributeError) as error:
        raise CheckpointError(f'{path} was not written by hand_pose_ros and does not say which network its weights '
                              'belong to: give weights of `hand-pose train` or save_checkpoint') from error
    if missing:
        raise CheckpointError(f"checkpoint {path} does not say its {', '.join(sorted(missing))}: {_AGAIN}")
    if not (isinstance(metadata['cube_side'], int | float) and 0 < metadata['cube_side'] < math.inf):
        raise CheckpointError(f"checkpoint {path}: its cube_side is {metadata['cube_side']!r:.80}, where metres "
                              'belong: write it again with save_checkpoint')
    return metadata, tensors


def _restore(path: Path, part: str, description: dict[str, Any], tensors: dict[str, Tensor]) -> nn.Module:
    try:
        network = build(description['architecture'], **description['config'])
    except (HandPoseError, TypeError, KeyError) as error:
        raise CheckpointError(f'checkpoint {path}: {error} (was it written by a newer version? '
                              f'this is {__version__})') from error
    prefix = f'{part}.'
    own = {name[len(prefix):]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}
    expected = network.state_dict()
    for name, tensor in expected.items():
        if name not in own:
            raise CheckpointError(f"checkpoint {path} lacks the weights '{name}' of its {part}: {_AGAIN}")
        if own[name].shape != tensor.shape:
            raise CheckpointError(f"checkpoint {path} holds '{name}' of its {part} as {tuple(own[name].shape)} "
                                  f'instead of {tuple(tensor.shape)}: {_AGAIN}')
        if not own[name].isfinite().all():
            raise CheckpointError(f"checkpoint {path} is damaged: '{name}' of its {part} is not finite: {_AGAIN}")
    if unknown := own.keys() - expected.keys():
        raise CheckpointError(f"checkpoint {path} holds '{min(unknown)}', which its {part} has no place for: {_AGAIN}")
    network.load_state_dict(own)  # copies into float32
    return network.requires_grad_(False).eval()
