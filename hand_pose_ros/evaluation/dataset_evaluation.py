"""Evaluates weights on the test frames of a recorded dataset. The crops are made as in training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from hand_pose_ros.datasets import joints_in_metres, open_dataset
from hand_pose_ros.datasets.base import RecordedDataset
from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation.progress import Progress, silent
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.models.checkpoints import DEFAULT, load_checkpoint
from hand_pose_ros.runtime import make_engine


def evaluate_dataset(name: str, root: Path, model: str | None = None, split: str = 'test', device: str = 'auto',
                     progress: Progress = silent) -> Result:
    """The joints of all frames of a split. The crops start from the labels (original code).

    Args:
        name: of a recorded dataset, see `hand_pose_ros.datasets.open_dataset`.
        root: folder of the dataset.
        model: name of weights that ship, or path of a checkpoint; None = the default.

    Raises:
        InputError: the weights are for other joints.
        DatasetError: the dataset or split does not exist, or its files are missing or damaged.
    """
    dataset = open_dataset(name, split, root)
    assert isinstance(dataset, RecordedDataset) and dataset.size is not None
    checkpoint = load_checkpoint(model)
    if checkpoint.metadata['skeleton'] != dataset.skeleton.name:
        raise InputError(f'{model or DEFAULT}: its joints are those of {checkpoint.metadata["skeleton"]}, but {name} '
                         f'has those of {dataset.skeleton.name}: choose weights that were trained on it')
    engine = make_engine(checkpoint.network, device=device, refiner=checkpoint.refiner)
    predictions, truth = [], []
    numbers = torch.arange(dataset.size).split(dataset.chunk)
    for indices in progress(numbers, len(numbers)):
        batch = dataset.batch(indices)
        cube = batch['cube_center'], batch['cube_side']
        joints = torch.from_numpy(engine.run(batch['patch'].numpy()))
        predictions.append(joints_in_metres(joints, *cube).double().numpy())
        truth.append(joints_in_metres(batch['joints'], *cube).double().numpy())
    note = 'crops start from the labels, as in the original code; left hands are mirrored'
    return Result(f'{model or DEFAULT} on {dataset.name}', dataset.skeleton, dataset.frame(0).intrinsics,
                  np.concatenate(predictions), np.concatenate(truth), notes=(note,),
                  info={'model': model or DEFAULT, 'engine': engine.name, 'dataset': dataset.name}, in_time=False)
