"""Datasets of depth images with hand joints. Each has its own file, over one small base."""

from __future__ import annotations

from pathlib import Path

from hand_pose_ros.datasets.base import Batch, Dataset, DatasetError, joints_in_metres

__all__ = ['DATASETS', 'Batch', 'Dataset', 'DatasetError', 'joints_in_metres', 'open_dataset']

DATASETS = ('synthetic', 'scenes', 'nyu', 'icvl', 'msra', 'bags')


def open_dataset(name: str, split: str, root: Path | None = None, device: str = 'cpu') -> Dataset:
    """A dataset by name.

    Args:
        name: one of `DATASETS`. 'msra:P3' leaves out the subject P3. 'synthetic:without-surface' trains on hands that
            lack this ingredient (see `hand_pose_ros.synthetic.stages.Ingredients`), and 'synthetic:without-everything'
            on hands that lack all of them. 'scenes' are whole images of the same scenes, for `hand_finder`.
        split: 'train', 'val' or 'test'. nyu and icvl also have 'test_1' and 'test_2'.
        root: folder of a recorded dataset.
        device: where synthetic hands are rendered.

    Raises:
        DatasetError: there is no such dataset or split, or its files are missing.
    """
    kind, _, variant = name.partition(':')
    if kind not in DATASETS or (variant and kind not in ('msra', 'synthetic')):
        raise DatasetError(f"unknown dataset '{name}': choose one of {', '.join(DATASETS)}, or msra:P1 to msra:P8")
    if kind == 'synthetic':
        from hand_pose_ros.datasets.synthetic import Synthetic
        return Synthetic(split, device, variant)
    if kind == 'scenes':
        from hand_pose_ros.datasets.synthetic import SyntheticScenes
        return SyntheticScenes(split, device)
    if root is None:
        raise DatasetError(f'{name} is read from disk: give its folder with --set root=FOLDER')
    if kind == 'nyu':
        from hand_pose_ros.datasets.nyu import NYU
        return NYU(root, split)
    if kind == 'icvl':
        from hand_pose_ros.datasets.icvl import ICVL
        return ICVL(root, split)
    if kind == 'msra':
        from hand_pose_ros.datasets.msra import MSRA
        return MSRA(root, split, variant or 'P0')
    from hand_pose_ros.datasets.bags import Bags
    return Bags(root, split)
