"""Results as rows of text, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Any

ACCURACY_COLUMNS = ('mm, % of frames', 'frames', 'missed', 'mean', 'median', 'max', '<=20', '<=30', '<=40', '<=50',
                    '<=80 mm', 'AUC', 'translation', 'rigid', 'jitter', 'bone drift')


def accuracy_rows(name: str, summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """A row for a summary with truth, and a row for each of its parts, with the ACCURACY_COLUMNS."""
    parts = summary.get('parts', {}).items()
    return [(name, *_accuracy_cells(summary)), *((f'- {part}', *_accuracy_cells(its)) for part, its in parts)]


def _accuracy_cells(summary: dict[str, Any]) -> tuple[str, ...]:
    return (str(summary['frames']), str(summary['missed_frames']), number(summary['mean_mm'], 3),
            number(summary['median_mm'], 3), number(summary['max_mm'], 1),
            *(number(fraction, 2, '', 100) for fraction in summary['within_mm'].values()),
            number(summary['auc_0_80'], 4), number(summary['mean_translation_aligned_mm'], 2),
            number(summary['mean_rigid_aligned_mm'], 2), number(summary['error_jitter_mm'], 2),
            number(summary['bone_drift_mm'], 2))


def number(value: float | None, digits: int, unit: str = '', factor: float = 1) -> str:
    """A number with this many digits after the point. '-' for None and NaN."""
    return '-' if value is None or isnan(value) else f'{factor * value:.{digits}f}{unit}'


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with aligned columns for the terminal. The first column is aligned to the left."""
    table = [tuple(head), *map(tuple, rows)]
    widths = [max(len(row[k]) for row in table) for k in range(len(head))]
    return '\n'.join('  '.join(cell.ljust(width) if k == 0 else cell.rjust(width) for k, (cell, width) in
                               enumerate(zip(row, widths, strict=True))).rstrip() for row in table)
