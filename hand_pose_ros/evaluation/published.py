"""Published results: the text format of the field, and the three datasets for which it is used.

A line is a frame, and has `u v d` for each joint, in pixels and millimetres, separated by blanks. A line may begin with
the name of a file, and the file may be gzipped. Joints become metres in the optical frame (y down), also those of NYU
and MSRA, whose own frames have y up. Errors are distances, so they do not depend on this.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.errors import InputError, counted
from hand_pose_ros.evaluation.results import Result, split_source
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import Skeleton, get_skeleton

Rows = slice | NDArray[np.intp]
Match = tuple[Rows, Rows, tuple[str, ...]]
"""Rows of the predictions, the rows of the truth that belong to them, and notes."""


@dataclass(frozen=True)
class Dataset:
    """A test set.

    Attributes:
        intrinsics: of its depth images.
        parts: its sequences or subjects, name -> (first row, row after the last). Empty if it has none.
        published: (method, mean error in mm) from the table of V2V-PoseNet (Moon et al. 2018).
    """

    name: str
    intrinsics: Intrinsics
    skeleton: Skeleton
    parts: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    published: tuple[tuple[str, float], ...] = ()

    @property
    def frames(self) -> int:
        """Number of test frames; 0 = not fixed."""
        return max((stop for _, stop in self.parts.values()), default=0)


DATASETS = {dataset.name: dataset for dataset in (
    # NYU has two test subjects (Tompson et al. 2014). The bone lengths of the labels change between these rows.
    Dataset('nyu', Intrinsics(588.03, 587.07, 320, 240, 640, 480), get_skeleton('nyu14'),
            {'subject 1': (0, 2440), 'subject 2': (2440, 8252)},
            (('DeepPrior with refinement', 19.73), ('DeepModel', 17.04), ('DeepPrior++', 12.24))),
    # The code of DeepPrior has 241.42 for both focal lengths of ICVL, with which means are about 0.013 mm lower.
    Dataset('icvl', Intrinsics(240.99, 240.96, 160, 120, 320, 240), get_skeleton('icvl16'),
            {'sequence 1': (0, 702), 'sequence 2': (702, 1596)},
            (('LRF', 12.58), ('DeepPrior', 10.4), ('DeepPrior++', 8.1))),
    Dataset('msra', Intrinsics(241.42, 241.42, 160, 120, 320, 240), get_skeleton('msra21'),
            published=(('DeepPrior++', 9.5),)),
)}


@dataclass(frozen=True)
class Labels:
    """The content of a text file.

    Attributes:
        uvd: (N, J, 3), pixels and millimetres.
        names: of the files of the frames; empty if the lines have none.
    """

    path: Path
    uvd: NDArray[np.float64]
    names: tuple[str, ...] = ()

    def points(self, intrinsics: Intrinsics) -> NDArray[np.float64]:
        """Joints (N, J, 3) in metres, optical frame; NaN = missing.

        A joint is missing if one of its numbers is not finite, or its depth is 0 or less. Files of results have 0 0 0
        for a joint that was not found.
        """
        uvd = self.uvd.copy()
        uvd[~np.isfinite(uvd).all(-1) | (uvd[..., 2] <= 0)] = np.nan
        return intrinsics.back_project(uvd[..., :2], uvd[..., 2] / 1000)


def read_text(path: str | Path, skeleton: Skeleton) -> Labels:
    """Read a file of predictions or labels. Blank lines are skipped.

    Raises:
        InputError: the file cannot be read or is empty, a line does not have 3 numbers for each joint of the skeleton,
            only some lines begin with a name, or the depths are not in millimetres.
    """
    path = Path(path)
    rows, names = [], []
    for number, line in enumerate(_text(path).splitlines(), 1):
        fields = line.split()
        if not fields:
            continue
        if not _is_number(fields[0]):
            names.append(fields.pop(0))
        if len(fields) != 3 * len(skeleton):
            raise InputError(
                f'{path}: line {number} has {counted(len(fields), "numbers")}, but the {len(skeleton)} joints of '
                f'{skeleton.name} have u v d each, {3 * len(skeleton)} together, with blanks between them: choose '
                'another --dataset, or mend the line')
        try:
            rows.append(np.array(fields, np.float64))
        except ValueError:
            wrong = next(text for text in fields if not _is_number(text))
            raise InputError(f"{path}: line {number} has '{wrong}' where a number belongs "
                             '(write nan for a missing joint)') from None
    if not rows:
        raise InputError(f'{path}: there is no line with joints in it: give a file that has some')
    if names and len(names) != len(rows):
        raise InputError(f'{path}: {len(names)} of {len(rows)} lines begin with a file name: '
                         'give all of them one, or none')
    uvd = np.stack(rows).reshape(len(rows), len(skeleton), 3)
    depth = uvd[..., 2][uvd[..., 2] > 0]
    if depth.size and np.median(depth) < 20:
        raise InputError(f'{path}: the median depth is {np.median(depth):.3g}, which looks like metres: '
                         'the third number of a joint is its depth in millimetres')
    return Labels(path, uvd, tuple(names))


def load_published(predictions: str | Path, truth: str | Path, dataset: Dataset) -> Result:
    """Predictions and labels of a dataset, matched row by row.

    If both files have names, they are matched by name. Otherwise both must have the same number of rows, or one of them
    has all rows of the dataset and the other those of one part. In this case, a note says so.

    Raises:
        InputError: a file cannot be read, see `read_text`, or the rows cannot be matched.
    """
    camera = dataset.intrinsics
    guess, label = read_text(predictions, dataset.skeleton), read_text(truth, dataset.skeleton)
    if guess.names and label.names:
        rows_p, rows_t, notes = _match_names(guess, label)
    else:
        rows_p, rows_t, notes = _match_counts(guess, label, dataset)
    whole = len(guess.uvd) == len(label.uvd) == dataset.frames
    joints, labels = guess.points(camera)[rows_p], label.points(camera)[rows_t]
    if missed := int((np.isnan(joints) & ~np.isnan(labels)).any(-1).sum()):
        notes += (f'{missed} joints are missing in {guess.path.name} (nan, or no depth): they count as failures in '
                  'curves and fractions, and are left out of averages.',)
    return Result(
        name=Path(predictions).name.removesuffix('.gz').removesuffix('.txt'),
        skeleton=dataset.skeleton, intrinsics=camera,
        predictions=joints, truth=labels, in_time=isinstance(rows_t, slice) or bool((np.diff(rows_t) == 1).all()),
        parts=dict(dataset.parts) if whole else {}, notes=notes,
        info={'predictions': str(predictions), 'ground_truth': str(truth), 'dataset': dataset.name,
              'intrinsics': f'fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}'})


def load_result(source: str, truth: str | Path | None = None, dataset: Dataset | None = None) -> Result:
    """A result from `FILE` or `NAME=FILE`. It is an .npz file that `Result.save` wrote, or predictions as text.

    Args:
        truth, dataset: for text, as in `load_published`.

    Raises:
        InputError: the file cannot be used, or it is text, and truth or dataset are missing.
    """
    name, path = split_source(source)
    if Path(path).suffix == '.npz':
        result = Result.load(path)
    elif not Path(path).is_file():
        raise InputError(f'{path}: there is no such file')
    elif truth is None or dataset is None:
        raise InputError(f'{path}: predictions as text need --ground-truth and --dataset')
    else:
        result = load_published(path, truth, dataset)
    return replace(result, name=name) if name else result


def _match_counts(guess: Labels, label: Labels, dataset: Dataset) -> Match:
    everything = slice(None)
    p, t = len(guess.uvd), len(label.uvd)
    if p == t:
        return everything, everything, ()
    for part, (start, stop) in dataset.parts.items():
        if {p, t} == {stop - start, dataset.frames}:
            short, long = (guess, label) if p < t else (label, guess)
            note = (f'{short.path.name} has {min(p, t)} frames, as many as {part} of {dataset.name}: it is matched '
                    f'to rows {start + 1}-{stop} of {long.path.name}; the other {abs(p - t)} are not scored.')
            rows = slice(start, stop)
            return (everything, rows, (note,)) if p < t else (rows, everything, (note,))
    parts = ', '.join(f'{stop - start} ({part})' for part, (start, stop) in dataset.parts.items())
    raise InputError(f'{guess.path} has {p} frames but {label.path} has {t}: which row belongs to which is unknown; '
                     'give files of the same length' + (f', or one of {parts} of {dataset.name}' if parts else ''))


def _match_names(guess: Labels, label: Labels) -> Match:
    for labels in (guess, label):
        if len(set(labels.names)) < len(labels.names):
            twice = next(name for name in labels.names if labels.names.count(name) > 1)
            raise InputError(f"{labels.path}: the file name '{twice}' stands on two lines: keep one of them")
    row = {name: k for k, name in enumerate(label.names)}
    unknown = next((name for name in guess.names if name not in row), None)
    if unknown is not None:
        raise InputError(f"{guess.path}: '{unknown}' is not in {label.path}: both must name frames alike")
    left = len(label.names) - len(guess.names)
    note = (f'{guess.path.name} names {len(guess.names)} of the {len(label.names)} frames of {label.path.name}; '
            f'the other {left} are not scored.')
    rows = np.array([row[name] for name in guess.names])
    order = rows.argsort()  # the order of the dataset, on which parts and neighbours depend
    return order, rows[order], (note,) if left else ()


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
        if data[:2] == b'\x1f\x8b':
            data = gzip.decompress(data)
        return data.decode()
    except OSError as error:
        raise InputError(f'{path}: the file cannot be read ({error.strerror or error})') from None
    except (EOFError, UnicodeDecodeError, zlib.error):
        raise InputError(f'{path}: this is not text, or a gzip file that was cut short') from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
