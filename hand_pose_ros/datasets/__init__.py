"""Datasets of depth images with hand joints: one file each over one small base."""

from __future__ import annotations

from pathlib import Path

from hand_pose_ros.datasets.base import Batch, Dataset, DatasetError, joints_in_metres

__all__ = ['DATASETS', 'Batch', 'Dataset', 'DatasetError', 'joints_in_metres', 'open_dataset']

DATASETS = ('synthetic', 'nyu', 'icvl', 'msra', 'bags')


def open_dataset(name: str, split: str, root: Path | None = None, device: str = 'cpu') -> Dataset:
    """A dataset by name.

    Args:
        name: one of `DATASETS`.
        split: 'train', 'val' or 'test'.
        root: folder of a recorded dataset.
        device: where synthetic hands are rendered.

    Raises:
        DatasetError: no such dataset or split, or its files are missing.
    """
    if name not in DATASETS:
        raise DatasetError(f"unknown dataset '{name}': choose one of {', '.join(DATASETS)}")
    if split not in ('train', 'val', 'test'):
        raise DatasetError(f"unknown split '{split}': choose train, val or test")
    if name == 'synthetic':
        from hand_pose_ros.datasets.synthetic import Synthetic
        return Synthetic(split, device)
    if root is None:
        raise DatasetError(f'{name} is read from disk: give its folder with --set root=FOLDER')
    if name == 'nyu':
        from hand_pose_ros.datasets.nyu import NYU
        return NYU(root, split)
    if name == 'icvl':
        from hand_pose_ros.datasets.icvl import ICVL
        return ICVL(root, split)
    if name == 'msra':
        from hand_pose_ros.datasets.msra import MSRA
        return MSRA(root, split)
    from hand_pose_ros.datasets.bags import Bags
    return Bags(root, split)
