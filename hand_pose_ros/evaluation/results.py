"""The result of an evaluation: joints, truth, times, and where they come from. It is saved as one file."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros import __version__
from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation import metrics
from hand_pose_ros.files import in_one_step
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import Skeleton

FORMAT = 1
"""Version of the files. It is raised when older files cannot be read any more."""
DAMAGE = (AttributeError, BadZipFile, EOFError, KeyError, NotImplementedError, TypeError, ValueError, zlib.error)
"""The errors of reading an .npz file that is damaged or of another kind (AttributeError with Python 3.10)."""


@dataclass(frozen=True)
class Result:
    """The joints of N frames.

    Attributes:
        name: for tables and legends.
        intrinsics: of the depth images.
        predictions: (N, J, 3) in metres, optical frame; NaN = not predicted.
        truth: (N, J, 3) in metres, optical frame; NaN = not labelled. None = no truth.
        stamps_ns: (N,) stamps of the depth images, or None. Jitter is not measured across a gap between them.
        seconds: stage -> its times (N,); NaN = did not run.
        parts: name -> (first row, row after the last), for subjects or sequences that are also reported separately.
        notes: what a reader of the numbers must know.
        info: where the result comes from (files, model, device, command).
        in_time: whether each frame follows the one before. If not, jitter and bone drift are None.
        hand_ids: (N,) str, of the tracked hand. Jitter and bone drift are those within each hand. None = it is always
            the same hand.
    """

    name: str
    skeleton: Skeleton
    intrinsics: Intrinsics
    predictions: NDArray[np.float64]
    truth: NDArray[np.float64] | None = None
    stamps_ns: NDArray[np.int64] | None = None
    seconds: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    parts: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    info: Mapping[str, Any] = field(default_factory=dict)
    in_time: bool = True
    hand_ids: NDArray[np.str_] | None = None

    @property
    def errors_mm(self) -> NDArray[np.float64]:
        """Errors (N, J), see `metrics.joint_errors_mm`. Without truth, all are NaN."""
        if self.truth is None:
            return np.full(self.predictions.shape[:2], np.nan)
        return metrics.joint_errors_mm(self.predictions, self.truth)

    def summary(self) -> dict[str, Any]:
        """All numbers of the result, for JSON."""
        detected = np.isfinite(self.predictions).all(-1).any(-1)
        summary: dict[str, Any] = {'name': self.name, 'frames': len(self.predictions)}
        if self.truth is None:
            summary |= metrics.smoothness(self.predictions, self.skeleton, self._hands(), self.stamps_ns)
        else:
            summary |= self._accuracy(slice(None))
        summary |= {'frames_total': len(self.predictions),
                    'detection_rate': float(np.mean(detected)) if self.predictions.size else None}
        if self.parts and self.truth is not None:
            summary['parts'] = {
                name: self._accuracy(slice(start, stop)) for name, (start, stop) in self.parts.items()}
        if self.hand_ids is not None:
            summary['tracks'] = len({*self.hand_ids} - {''})
        if self.seconds:
            summary['latency_ms'] = {
                stage: metrics.percentiles(1000 * seconds) for stage, seconds in self.seconds.items()}
        return summary | {'notes': list(self.notes), **self.info}

    def _hands(self) -> NDArray[np.int64]:
        """(N,) a number for each hand that was tracked in each part: the parts may show different people."""
        part = np.zeros(len(self.predictions), np.int64)
        part[[start for start, _ in self.parts.values()]] = 1
        part = part.cumsum()
        if self.hand_ids is None:
            return part
        names, hands = np.unique(self.hand_ids, return_inverse=True)
        return part * len(names) + hands

    def _accuracy(self, rows: slice) -> dict[str, Any]:
        assert self.truth is not None
        stamps = None if self.stamps_ns is None else self.stamps_ns[rows]
        summary = metrics.summarise(self.predictions[rows], self.truth[rows], self.skeleton, self._hands()[rows],
                                    stamps)
        return summary if self.in_time else summary | dict.fromkeys(metrics.SMOOTHNESS)

    def save(self, path: str | Path) -> None:
        """Write everything to an .npz file. `load` and numpy.load can read it."""
        meta = {'format': FORMAT, 'version': __version__, 'name': self.name, 'notes': self.notes,
                'skeleton': asdict(self.skeleton), 'intrinsics': asdict(self.intrinsics),
                'parts': dict(self.parts), 'info': dict(self.info), 'stages': list(self.seconds),
                'in_time': self.in_time}
        arrays: dict[str, Any] = {'joints': self.predictions, 'meta': np.array(json.dumps(meta))}
        optional = {'truth': self.truth, 'stamps_ns': self.stamps_ns, 'hand_ids': self.hand_ids}
        arrays |= {key: value for key, value in optional.items() if value is not None}
        arrays |= {f'seconds_{k}': seconds for k, seconds in enumerate(self.seconds.values())}
        with in_one_step(path) as part, part.open('wb') as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """Read a file of `save`.

        Raises:
            InputError: the file is missing, damaged, or of another kind, or its arrays do not fit each other.
        """
        try:
            with np.load(path) as file:
                meta = json.loads(file['meta'].item())
                if meta['format'] != FORMAT:
                    raise InputError(f"{path}: version {meta['version']} wrote it in another form: evaluate again")
                name, joint_names, parents = (meta['skeleton'][key] for key in ('name', 'joint_names', 'parents'))
                result = cls(
                    name=meta['name'], skeleton=Skeleton(name, tuple(joint_names), tuple(parents)),
                    intrinsics=Intrinsics(**meta['intrinsics']), predictions=file['joints'],
                    truth=file.get('truth'), stamps_ns=file.get('stamps_ns'),
                    seconds={stage: file[f'seconds_{k}'] for k, stage in enumerate(meta['stages'])},
                    parts={name: (start, stop) for name, (start, stop) in meta['parts'].items()},
                    notes=tuple(meta['notes']), info=meta['info'], in_time=meta.get('in_time', True),
                    hand_ids=file.get('hand_ids'))
            frames = len(result.predictions)
            points = frames, len(result.skeleton), 3
            for key, array, shape in (
                    ('joints', result.predictions, points), ('truth', result.truth, points),
                    ('stamps_ns', result.stamps_ns, (frames,)), ('hand_ids', result.hand_ids, (frames,)),
                    *((f'times of {stage}', seconds, (frames,)) for stage, seconds in result.seconds.items())):
                if array is not None and array.shape != shape:
                    raise InputError(f'{path}: the shape of {key} is {array.shape}, not {shape}: evaluate again')
            return result
        except OSError as error:
            raise InputError(f'{path}: the file cannot be read ({error.strerror or error})') from None
        except DAMAGE:
            raise InputError(f'{path}: not a result of `hand-pose evaluate --out`, or damaged') from None


def told_notes(results: Sequence[Result]) -> list[str]:
    """The notes of all results. If there are several results, each note begins with the name of its result."""
    return [f'{result.name}: {note}' if len(results) > 1 else note for result in results for note in result.notes]


def split_source(source: str) -> tuple[str, str]:
    """Name and path of `FILE` or `NAME=FILE`. Without NAME, the name is empty. The name of FILE may contain a `=`."""
    name, equals, path = source.partition('=')
    return (name, path) if equals and not Path(source).exists() else ('', source)


def named_apart(results: Sequence[Result], sources: Sequence[str]) -> list[Result]:
    """The results with different names.

    If several results have the same name, those to which the user gave no name are named by their file, with as many
    folders as needed. If names are still the same, they are numbered.

    Args:
        sources: of each result, `FILE` or `NAME=FILE`. It is empty for a result that is not from a file.
    """
    names = [result.name for result in results]
    given, paths = zip(*map(split_source, sources), strict=True)
    for parts in range(1, max(len(Path(path).parts) for path in paths) + 1):
        names = [str(Path(*Path(path).with_suffix('').parts[-parts:]))
                 if names.count(name) > 1 and path and not own else name
                 for name, own, path in zip(names, given, paths, strict=True)]
    numbers = [names[:i].count(name) + 1 for i, name in enumerate(names)]
    return [replace(result, name=name if number == 1 else f'{name} ({number})')
            for result, name, number in zip(results, names, numbers, strict=True)]
