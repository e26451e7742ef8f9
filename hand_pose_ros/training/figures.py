"""The figures of the experiments. Each function returns a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.evaluation import metrics
from hand_pose_ros.evaluation.plots import COLORS, STYLE
from hand_pose_ros.evaluation.results import Result

ESTIMATE, TRUTH = COLORS[0], COLORS[1]


@matplotlib.rc_context(STYLE)
def bottleneck(results: Sequence[Result], floors: Sequence[Result], widths: Sequence[int | None]) -> Figure:
    """Mean error, and share of frames within 40 mm, over the width of the bottleneck.

    Args:
        results: one for each width.
        floors: `Laboratory.truth_through` for each width that is not None.
        widths: None = direct regression, which is drawn as a line.
    """
    figure = Figure((9, 3.6), layout='constrained')
    for axes, title, score in zip(
            figure.subplots(1, 2), ('Mean error, mm', 'Frames with all joints within 40 mm, %'),
            (lambda r: metrics.mean_mm(r.errors_mm), lambda r: 100 * metrics.success_curve(r.errors_mm, [40])[0]),
            strict=True):
        points = {width: score(result) for width, result in zip(widths, results, strict=True)}
        with_prior = {width: value for width, value in points.items() if width is not None}
        axes.axhline(points[None], color=COLORS[1], ls='--', label='direct')
        axes.plot(list(with_prior), list(with_prior.values()), 'o-', color=COLORS[0], label='through the prior')
        axes.plot(list(with_prior), [score(floor) for floor in floors], ':', color='grey', label='the truth itself')
        axes.set(title=title, xlabel='width of the bottleneck', xticks=list(with_prior))
        axes.legend(fontsize=9)
    return figure


@matplotlib.rc_context(STYLE)
def iterations(results: Sequence[Result]) -> Figure:
    """Mean error over the number of refinements N. The first result has none, and the others are named 'NAME xN'."""
    figure = Figure((5.5, 3.8), layout='constrained')
    axes = figure.subplots()
    names = dict.fromkeys(result.name.rpartition(' x')[0] for result in results[1:])
    for name, color in zip(names, COLORS, strict=False):
        chain = [results[0], *(result for result in results[1:] if result.name.rpartition(' x')[0] == name)]
        means = [metrics.mean_mm(result.errors_mm) for result in chain]
        axes.plot(range(len(chain)), means, 'o-', color=color, label=name)
    axes.set(title='Mean error, mm', xlabel='iterations of the refinement',
             xticks=range(max(int(result.name.rpartition(' x')[2]) for result in results[1:]) + 1))
    axes.legend(fontsize=9)
    return figure


@matplotlib.rc_context(STYLE)
def runtime(rows: Mapping[str, Mapping[str, float]], paper_ms: Mapping[str, tuple[float, float]]) -> Figure:
    """Milliseconds of each network, here and in the paper. `rows` are named 'NAME|eager' and 'NAME|fast'."""
    figure = Figure((7.5, 3.6), layout='constrained')
    axes = figure.subplots()
    at = np.arange(len(paper_ms))
    bars = {'paper, CPU': [cpu for _, cpu in paper_ms.values()],
            'here, PyTorch': [rows[f'{name}|eager']['p50_ms'] for name in paper_ms],
            'here, fastest': [rows[f'{name}|fast']['p50_ms'] for name in paper_ms]}
    for k, (name, values) in enumerate(bars.items()):
        axes.bar(at + (k - 1) * 0.27, values, 0.25, color=COLORS[k], label=name)
    axes.set_yscale('log')
    axes.yaxis.set_major_formatter('{x:g}')
    axes.set_xticks(at, list(paper_ms))
    axes.set(title='Time for one hand, ms')
    axes.legend(fontsize=9)
    return figure


@matplotlib.rc_context(STYLE)
def qualitative(result: Result, batches: Sequence[Batch], rows: NDArray[np.int64]) -> Figure:
    """A column for each frame. It shows the patch, and its points from the side, with the estimate and the truth."""
    frames = [(batch, k) for batch in batches for k in batch['hand_present'].nonzero()[:, 0].tolist()]
    figure = Figure((2.7 * len(rows), 5.8), layout='constrained')
    for column, axes in zip(rows, figure.subplots(2, len(rows)).T, strict=True):
        batch, k = frames[column]
        center, side, patch = batch['cube_center'][k], batch['cube_side'][k], batch['patch'][k, 0].float()
        assert result.truth is not None
        skeletons = [(result.truth[column], TRUTH, 'truth'), (result.predictions[column], ESTIMATE, 'estimate')]
        cloud = _points(patch, center, side)
        for view, turn in zip(axes, (0.0, 70.0), strict=True):
            seen = _turned(cloud, center, turn)
            view.scatter(seen[:, 0], seen[:, 1], c=cloud[:, 2], s=1.5, cmap='Greys_r', linewidths=0,
                         vmax=float(center[2] + side))
            for joints, color, name in skeletons:
                flat = _turned(torch.from_numpy(joints).float(), center, turn)
                for i, bone in enumerate(result.skeleton.bones):
                    view.plot(*flat[list(bone)].T, color=color, lw=1.4, alpha=0.9, label=None if i else name)
            reach = float(side) / 2
            view.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect='equal', xticks=[], yticks=[])
        axes[0].set_title(f'{result.errors_mm[column].mean():.0f} mm')
        axes[1].set_title('from the side', fontsize=9)
    figure.axes[0].legend(fontsize=8, loc='lower left')
    return figure


def _points(patch: torch.Tensor, center: torch.Tensor, side: torch.Tensor) -> torch.Tensor:
    """The readings of a patch as points (N, 3) in metres."""
    rows, columns = (patch < 1).nonzero(as_tuple=True)
    scale = 2 / patch.shape[0]
    units = torch.stack([(columns + 0.5) * scale - 1, (rows + 0.5) * scale - 1, patch[rows, columns]], dim=1)
    return joints_in_metres(units[None], center[None], side[None])[0]


def _turned(points: torch.Tensor, center: torch.Tensor, degrees: float) -> NDArray[np.float32]:
    """x and y (N, 2) relative to the centre, after a turn about the vertical axis through the centre."""
    x, y, z = (points - center).unbind(1)
    angle = np.radians(degrees)
    return torch.stack([x * np.cos(angle) + z * np.sin(angle), y], dim=1).numpy()
