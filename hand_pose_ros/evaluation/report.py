"""A report of results as one HTML file, with tables, curves and frames. It works offline."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hand_pose_ros import __version__
from hand_pose_ros.drawing import FINGER_COLORS, caption, close_up
from hand_pose_ros.errors import counted
from hand_pose_ros.evaluation import metrics, plots
from hand_pose_ros.evaluation.published import DATASETS
from hand_pose_ros.evaluation.results import Result, told_notes
from hand_pose_ros.evaluation.tables import ACCURACY_COLUMNS, accuracy_rows, number
from hand_pose_ros.files import write_bytes
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.skeleton import FINGERS

Depth = NDArray[np.float32]
ReadDepths = Callable[[Sequence[int]], Mapping[int, Depth]]
"""Rows of the result -> those of their depth images (H, W) in metres that exist."""

_VIEW_SIDE_M = 0.30
_CLOUD_POINTS = 2500
_DEFINITIONS = (
    ('mean, median, max', 'Euclidean distance of single joints in the camera frame, without alignment, over all '
     'joints that were predicted.'),
    ('<= d', 'Share of frames whose worst joint is within d mm. A missed joint or frame is a failure at every d.'),
    ('AUC', 'Area under this curve from 0 to 80 mm, divided by 80.'),
    ('translation, rigid', 'Mean error after each frame was moved, or moved and turned, onto the truth: what is '
     'left is the error of the pose.'),
    ('tracks', 'How many hands were tracked. A hand that is lost and found again is a new one.'),
    ('jitter', 'RMS second difference of the error between frames over √6: the size of noise that is independent '
     'from frame to frame. Without truth: of the joints themselves, so that real acceleration counts too. Frames of '
     'different hands are not compared, nor frames between which an image is missing.'),
    ('bone drift', 'Standard deviation of the length of a bone over the frames of one hand, mean of the bones: 0 for a '
     'real hand.'),
)


def write_report(results: Sequence[Result], folder: str | Path, read_depths: ReadDepths | None = None) -> Path:
    """Write report.html, and its plots as PNG and SVG, into a folder.

    Args:
        results: first the result that the report is about, then those for comparison. All have the same skeleton.
        read_depths: reads the depth images for the overlays and the 3D views.

    Returns:
        The path of report.html.

    Raises:
        InputError: the folder cannot be written.
    """
    result, folder, notes = results[0], Path(folder), told_notes(results)
    summary = result.summary()
    scored = [r for r in results if r.truth is not None]
    figures = _figures(scored, result)
    for name, figure in figures.items():
        plots.save(figure, folder / name)
    cards = _cards(result, read_depths)
    sections = [
        _section('Notes', ''.join(f'<p>{escape(note)}</p>' for note in notes), 'notes') if notes else '',
        _tiles(summary),
        _section('Accuracy', _accuracy(scored)) if result.truth is not None else '',
        *(_section(title, _data_image('svg+xml', (folder / f'{name}.svg').read_bytes(), title) + extra)
          for name, title, extra in (
            ('curves', 'How many frames and joints are within a distance', _published(result)),
            ('joints', 'Which joints are hard', _fingers(scored)),
            ('errors', 'Which frames are hard', ''),
            ('latency', 'What a frame costs', _latency(summary))) if name in figures),
        _section('Frames', '<p class="soft">Drag a 3D view to turn it, turn the wheel to zoom, double-click to go back.'
                 + (' The truth is dashed.' if result.truth is not None else '') + '</p><div class="frames">'
                 + ''.join(card.html for card in cards) + '</div>') if cards else '',
        _section('More numbers', more) if (more := _more(result)) else '',
        _section('Where this comes from', _table(
            ('', ''), sorted((key, str(value)) for key, value in result.info.items()
                             if not _rows(value)), text=True)),
        _section('What the numbers mean', '<dl>' + ''.join(
            f'<dt>{escape(term)}</dt><dd>{escape(text)}</dd>' for term, text in _DEFINITIONS) + '</dl>'),
    ]
    template = Template(files(__package__).joinpath('report.html').read_text('utf-8'))
    html = template.substitute(
        title=escape(result.name), body='\n'.join(sections), frames=json.dumps({
            'bones': result.skeleton.bones, 'views': [card.view for card in cards],
            'colors': ['rgb({},{},{})'.format(*FINGER_COLORS[finger]) for finger in result.skeleton.fingers]},
            allow_nan=False, separators=(',', ':')),
        subtitle=f'{counted(summary["frames_total"], "frames")}, {result.skeleton.name}, hand_pose_ros {__version__}')
    path = folder / 'report.html'
    write_bytes(path, html.encode(errors='replace'))  # names of files may not be UTF-8
    return path


@dataclass(frozen=True)
class _Card:
    """A frame in the report: its part of the page, and the points of its 3D view."""

    html: str
    view: dict[str, Any]


def _cards(result: Result, read_depths: ReadDepths | None) -> list[_Card]:
    cards: list[_Card] = []
    shown = _interesting_frames(result)
    depths = read_depths([row for _, row in shown]) if read_depths else {}
    for title, row in shown:
        estimate = result.predictions[row]
        truth = result.truth[row] if result.truth is not None else np.full_like(estimate, np.nan)
        known = truth if np.isfinite(truth).all() else estimate
        center = np.nanmean(known, axis=0)
        cube = Cube.at(center, _VIEW_SIDE_M)
        depth = depths.get(row)
        panels = {}
        for name, joints in (('estimate', estimate), ('truth', truth)):
            if depth is not None and np.isfinite(joints).all():
                panels[name] = close_up(depth, result.intrinsics, cube, joints, result.skeleton)
                caption(panels[name], name)
        kind = ('blind', 'single', '')[len(panels)]
        picture = '' if not panels else _data_image(
            'png', cv2.imencode('.png', np.hstack(list(panels.values())))[1].tobytes(),
            f'joints on the depth image: {", ".join(panels)}')
        cards.append(_Card(
            f'<div class="frame {kind}"><h3>{escape(title)}</h3>{picture}'
            f'<canvas data-view="{len(cards)}" aria-label="3D view"></canvas></div>',
            {'estimate': _millimetres(estimate, cube), 'truth': _millimetres(truth, cube),
             'cloud': _cloud(depth, result.intrinsics, cube) if depth is not None else []}))
    return cards


def _interesting_frames(result: Result) -> list[tuple[str, int]]:
    """Titles and rows of the best, median and worst frame. Without truth, the first, middle and last with a hand."""
    means = metrics.frame_means_mm(result.errors_mm)
    scored = np.isfinite(means)
    names, order = ('Best', 'Median', 'Worst'), np.argsort(means)[:scored.sum()]  # those without a mean are last
    if not len(order):
        names, order = ('First', 'Middle', 'Last'), np.flatnonzero(np.isfinite(result.predictions).all((1, 2)))
    if not len(order):
        return []
    rows = order[[0, len(order) // 2, -1]].tolist()
    shown = {row: f'{name}: frame {row + 1}' + (f', {means[row]:.1f} mm' if scored[row] else '')
             for name, row in zip(names, rows, strict=True)}
    return [(title, row) for row, title in shown.items()]


def _cloud(depth: Depth, intrinsics: Intrinsics, cube: Cube) -> list[int]:
    """Points of the surface in the cube, x y z x y z ..., in whole millimetres from its centre."""
    half = cube.side / 2
    v, u = np.nonzero((depth > max(cube.center[2] - half, 0)) & (depth < cube.center[2] + half))
    points = intrinsics.back_project(np.stack([u, v], -1), depth[v, u]) - np.array(cube.center)
    points = points[(np.abs(points) < half).all(-1)]
    return np.rint(1000 * points[::max(1, len(points) // _CLOUD_POINTS)]).astype(int).ravel().tolist()


def _millimetres(joints: NDArray[np.floating[Any]], cube: Cube) -> list[list[float] | None]:
    return [np.round(1000 * (joint - cube.center), 1).tolist() if np.isfinite(joint).all() else None
            for joint in joints]


def _figures(scored: Sequence[Result], result: Result) -> dict[str, Figure]:
    figures = {}
    if result.truth is not None:
        figures = {'curves': plots.curves(scored), 'joints': plots.joint_bars(scored)}
    if np.isfinite(metrics.frame_means_mm(result.errors_mm)).sum() > 1:
        figures['errors'] = plots.over_time(result)
    if result.seconds and len(result.predictions):
        figures['latency'] = plots.latency(result)
    return figures


def _tiles(summary: dict[str, Any]) -> str:
    within = summary.get('within_mm', {})
    stages = summary.get('latency_ms', {})
    latency = stages.get('total') or stages.get('image to joints', {})  # the live node has only this
    tiles = [
        ('mean error', number(summary.get('mean_mm'), 1, ' mm')),
        ('median of joints', number(summary.get('median_mm'), 1, ' mm')),
        ('frames within 40 mm', number(within.get('40'), 1, ' %', 100)),
        ('area under the curve', number(summary.get('auc_0_80'), 3)),
        ('hands found', number(summary['detection_rate'], 1, ' %', 100)),
        ('tracks', number(summary.get('tracks'), 0)),
        ('frames per second', number(summary.get('frames_per_s'), 0)),
        ('latency, 99th percentile', number(latency.get('p99'), 1, ' ms')),
        ('jitter', number(summary.get('error_jitter_mm', summary.get('jitter_mm')), 1, ' mm')),
    ]
    return '<div class="tiles">' + ''.join(
        f'<div class="tile"><b>{value}</b><span class="soft">{label}</span></div>'
        for label, value in tiles if value != '-') + '</div>'


def _accuracy(scored: Sequence[Result]) -> str:
    return _table(ACCURACY_COLUMNS, [row for r in scored for row in accuracy_rows(r.name, r.summary())])


def _fingers(scored: Sequence[Result]) -> str:
    rows = [(r.name, *(number(v, 1) for v in metrics.per_finger_mm(r.errors_mm, r.skeleton).values())) for r in scored]
    return _table(('mean error, mm', *FINGERS, 'palm'), rows)


def _latency(summary: dict[str, Any]) -> str:
    stages = summary.get('latency_ms', {})
    total = stages.get('total', {}).get('mean')
    return _table(('ms', 'mean', 'p50', 'p90', 'p99', 'max', 'share'), [
        (stage, *(number(row.get(key), 2) for key in ('mean', 'p50', 'p90', 'p99', 'max')),
         number(row['mean'] / total if total and row else None, 0, ' %', 100)) for stage, row in stages.items()])


def _published(result: Result) -> str:
    dataset = DATASETS.get(str(result.info.get('dataset')))
    if dataset is None:
        return ''
    return (f'<p class="soft">Published means on {dataset.name} (table of Moon et al., V2V-PoseNet, 2018):</p>'
            + _table(('method', 'mean, mm'), [(name, f'{mean:g}') for name, mean in dataset.published]))


def _more(result: Result) -> str:
    """The tables in the info of a result: of the benchmark, errors by visibility, and the calibration."""
    return ''.join(f'<p class="soft">{escape(key.replace("_", " "))}:</p>'
                   + _table(rows[0], [tuple(map(_cell, row.values())) for row in rows])
                   for key, value in result.info.items() if (rows := _rows(value)))


def _rows(value: Any) -> list[dict[str, Any]]:
    """The rows of a table; empty if the value is no table."""
    rows = value if isinstance(value, list) else [value]
    return rows if all(isinstance(row, dict) for row in rows) else []


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return ' to '.join(map(str, value))
    return f'{value:.3f}' if isinstance(value, float) else str(value)


def _table(head: Iterable[str], rows: Iterable[Sequence[str]], text: bool = False) -> str:
    kind = ' class="text"' if text else ''
    lines = ''.join('<tr>' + ''.join(f'<td{kind}>{escape(cell)}</td>' for cell in row) + '</tr>' for row in rows)
    titles = ''.join(f'<th>{escape(cell)}</th>' for cell in head)
    return f'<div class="scroll"><table>{"" if text else f"<tr>{titles}</tr>"}{lines}</table></div>'


def _section(title: str, content: str, kind: str = '') -> str:
    return f'<section class="{kind}"><h2>{escape(title)}</h2>{content}</section>'


def _data_image(kind: str, data: bytes, alternative: str) -> str:
    return f'<img src="data:image/{kind};base64,{b64encode(data).decode()}" alt="{escape(alternative)}">'
