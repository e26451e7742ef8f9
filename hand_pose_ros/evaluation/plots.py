"""Plots of results. Each function returns a matplotlib Figure, and `save` writes it as PNG and SVG."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager
from numpy.typing import NDArray

from hand_pose_ros.evaluation import metrics
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.evaluation.tables import number
from hand_pose_ros.files import write_bytes

# Okabe & Ito (2008). They can be told apart with any colour vision, and in grey.
COLORS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000', '#B8A800')
LINES = ('-', '--', ':', '-.')
"""Line styles, for curves that share a color."""
HATCHES = ('', '////', '....', 'xxxx')
"""The same for bars."""
LINE_INCHES = 0.19
"""Height of an entry of a legend."""
LONGEST = 80
"""Maximum number of letters of a name in a legend."""

_CJK = ('Noto Sans CJK JP', 'WenQuanYi Micro Hei', 'WenQuanYi Zen Hei', 'Droid Sans Fallback')
"""Fonts with Chinese, Japanese and Korean letters, which names of files may have."""

STYLE: dict[Any, Any] = {
    'font.family': ['DejaVu Sans', *(name for name in _CJK if name in fontManager.get_font_names())],
    'font.size': 10, 'axes.titlesize': 11, 'axes.titleweight': 'bold', 'axes.titlelocation': 'left',
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.grid': True, 'grid.color': '#e4e7eb',
    'grid.linewidth': 0.8, 'axes.axisbelow': True, 'axes.edgecolor': '#8a94a0', 'xtick.color': '#4a5560',
    'ytick.color': '#4a5560', 'axes.labelcolor': '#2a3138', 'legend.frameon': False,
    'svg.hashsalt': 'hand_pose_ros',  # the same figure gives the same file
    'text.parse_math': False,  # names of files may hold $
}


@matplotlib.rc_context(STYLE)
def curves(results: Sequence[Result]) -> Figure:
    """Fraction of frames with all joints within a distance, and fraction of joints within it."""
    distances = np.linspace(0, 80, 321)
    figure, (left, right) = _figure(10.5, 4.1 + LINE_INCHES * len(results), 2)
    for k, (result, color) in enumerate(_colored(results)):
        errors = result.errors_mm
        style = {'color': color, 'lw': 1.6 if k else 2.4, 'ls': LINES[k // len(COLORS) % len(LINES)]}
        left.plot(distances, 100 * metrics.success_curve(errors, distances), **style,
                  label=f'{_entry(result)}   AUC {number(metrics.auc(errors), 3)}, '
                        f'mean {number(metrics.mean_mm(errors), 1, " mm")}')
        right.plot(distances, 100 * metrics.pck(errors, distances), **style)
    left.set(title='Frames with all joints within', ylabel='frames, %')
    right.set(title='Joints within', ylabel='joints, %')
    for axes in (left, right):
        axes.set(xlim=(0, 80), ylim=(0, 100), xlabel='distance, mm')
    figure.legend(loc='outside lower left', fontsize=9)  # outside, so that it never covers a curve
    return figure


@matplotlib.rc_context(STYLE)
def joint_bars(results: Sequence[Result]) -> Figure:
    """Mean error of each joint, for results side by side. They must have the same skeleton."""
    skeleton = results[0].skeleton
    rows = len(results) if len(results) > 1 else 0
    figure, (axes,) = _figure(max(7.0, 0.5 * len(skeleton) + 2), 4 + LINE_INCHES * rows)
    width = 0.8 / len(results)
    for k, (result, color) in enumerate(_colored(results)):
        means = metrics.per_joint_mm(result.errors_mm)
        axes.bar(np.arange(len(skeleton)) + (k + 0.5) * width - 0.4, means, width * 0.92, color=color, lw=0,
                 ec='white', hatch=HATCHES[k // len(COLORS) % len(HATCHES)], label=_entry(result))
    axes.set_xticks(range(len(skeleton)), [name.replace('_', ' ') for name in skeleton.joint_names],
                    rotation=45, ha='right', rotation_mode='anchor')
    axes.set(title='Error of each joint', ylabel='mean error, mm', xlim=(-0.6, len(skeleton) - 0.4))
    axes.grid(axis='x', visible=False)
    if rows:
        figure.legend(loc='outside lower left', fontsize=9)
    return figure


@matplotlib.rc_context(STYLE)
def over_time(result: Result) -> Figure:
    """Mean and worst error of each frame, of which some are known. Missed frames are marked at the bottom.

    Parts are separated.
    """
    errors = result.errors_mm
    means, worst = metrics.frame_means_mm(errors), metrics.worst_joints_mm(errors)
    figure, (axes,) = _figure(10.5, 3.4)
    at, label = _time_axis(result)
    _band(axes, at, worst, COLORS[5], 'worst joint')
    _band(axes, at, means, COLORS[0], 'mean of joints')
    missed = metrics.missed_frames(errors)
    highest = np.where(np.isfinite(worst), worst, means)  # if a joint was missed, there is only a mean
    top = np.percentile(highest[np.isfinite(highest)], 99.8) * 1.05
    if missed.any():
        axes.plot(at[missed], np.full(missed.sum(), 0.01 * top), '|', color=COLORS[1], ms=9, clip_on=False,
                  label='missed')
    for name, (start, _) in result.parts.items():
        axes.axvline(at[start], color='#4a5560', lw=1, ls=':')
        axes.annotate(name, (at[start], 1), xycoords=('data', 'axes fraction'), xytext=(4, -2), fontsize=9,
                      textcoords='offset points', va='top', color='#4a5560')
    axes.set(title='Error of each frame', xlabel=label, ylabel='error, mm', ylim=(0, top or 1),
             xlim=(at[0], at[-1]))
    axes.legend(fontsize=9, ncols=3, loc='lower right', bbox_to_anchor=(1, 1))
    return figure


@matplotlib.rc_context(STYLE)
def latency(result: Result) -> Figure:
    """Milliseconds of each stage in each frame, stacked. If there are too many frames, the mean of every few frames."""
    at, label = _time_axis(result)
    group = _group(len(at))
    title = f'Time of each frame (mean of {group})' if group > 1 else 'Time of each frame'
    at = _grouped(at, group).mean(1)
    stages = {stage: 1000 * _grouped(np.nan_to_num(seconds), group).mean(1)
              for stage, seconds in result.seconds.items() if stage != 'total'}
    if len(at) == 1:
        at, stages = np.array([0.5, 1.5]), {stage: ms.repeat(2) for stage, ms in stages.items()}  # to have a width
    figure, (axes,) = _figure(10.5, 3.2)
    axes.stackplot(at, *stages.values(), labels=list(stages), colors=COLORS, lw=0, step='mid')
    total = np.sum(list(stages.values()), axis=0)
    axes.set(title=title, xlabel=label, ylabel='ms', ylim=(0, np.percentile(total, 99.5) * 1.1 or 1),
             xlim=(at[0], at[-1]))
    axes.legend(fontsize=9, ncols=len(stages), loc='lower right', bbox_to_anchor=(1, 1))
    return figure


def to_bytes(figure: Figure, form: str) -> bytes:
    """The figure as the content of a 'png' or 'svg' file."""
    buffer = BytesIO()
    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings('ignore', 'Glyph')  # there is a box in place of a letter that no font has
        figure.savefig(buffer, format=form, dpi=150, metadata={'Date': None} if form == 'svg' else None)
    return buffer.getvalue()


def save(figure: Figure, path: str | Path) -> None:
    """Write `path`.png and `path`.svg."""
    for form in ('png', 'svg'):
        write_bytes(f'{path}.{form}', to_bytes(figure, form))


def _figure(width: float, height: float, columns: int = 1) -> tuple[Figure, NDArray[np.object_]]:
    """A figure and its row of axes. Without pyplot, which may open a display and keeps every figure."""
    figure = Figure((width, height), layout='constrained')
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def _colored(results: Sequence[Result]) -> list[tuple[Result, str]]:
    return [(result, COLORS[k % len(COLORS)]) for k, result in enumerate(results)]


def _entry(result: Result) -> str:
    """The name of a result in a legend. A long one loses its middle.

    It begins with a blank, because legends leave out names that begin with _.
    """
    name, half = result.name, LONGEST // 2
    return f' {name}' if len(name) <= LONGEST else f' {name[:half]} … {name[-half:]}'


def _time_axis(result: Result) -> tuple[NDArray[np.float64], str]:
    if result.stamps_ns is None or len(result.stamps_ns) < 2 or (np.diff(result.stamps_ns) <= 0).any():
        return np.arange(1, len(result.predictions) + 1, dtype=np.float64), 'frame'
    return (result.stamps_ns - result.stamps_ns[0]) / 1e9, 'time, s'


def _group(frames: int) -> int:
    """How many frames share a place in a plot, so that there are 800 at most. More would be thinner than a pixel."""
    return -(-frames // 800)


def _grouped(values: NDArray[np.float64], group: int) -> NDArray[np.float64]:
    """(N,) -> (N // group, group). The frames that fill no group are left out."""
    return values[:len(values) // group * group].reshape(-1, group)


def _band(axes: Axes, at: NDArray[np.float64], values: NDArray[np.float64], color: str, label: str) -> None:
    """A line through the values. If there are too many frames, the range and median of every few frames."""
    values = np.where(np.isfinite(values), values, np.nan)
    group = _group(len(values))
    if group == 1:
        axes.plot(at, values, '.-', color=color, lw=1.2, ms=3, label=label)  # dots show single frames
        return
    grouped = np.ma.masked_invalid(_grouped(values, group))
    middle = _grouped(at, group).mean(1)
    axes.fill_between(middle, grouped.min(1), grouped.max(1), color=color, alpha=0.25, lw=0)
    axes.plot(middle, np.ma.median(grouped, axis=1), '.-', color=color, lw=1, ms=2,
              label=f'{label} (median, range of {group})')
