"""`hand-pose compare`: several results side by side."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from hand_pose_ros.cli.arguments import check_outputs, count
from hand_pose_ros.cli.evaluate import print_summaries
from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation import metrics
from hand_pose_ros.evaluation.published import DATASETS, load_result
from hand_pose_ros.evaluation.results import Result, named_apart, split_source, told_notes
from hand_pose_ros.files import write_json

DESCRIPTION = 'Compare any number of results: tables, curves, and confidence intervals of their differences.'

EXAMPLES = """examples:
  hand-pose compare a.npz b.npz --out plots
  hand-pose compare 'before=a.npz' 'after=b.npz' --json difference.json
  hand-pose compare DeepPrior.txt.gz DeepPrior-ORRef.txt.gz --ground-truth labels.txt.gz --dataset nyu --out plots

The others are compared with the first result, frame by frame. If the interval of a difference does not contain 0, the
difference on these frames is more than chance.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('results', nargs='+', metavar='[NAME=]FILE',
                        help='an .npz of `hand-pose evaluate --out` with ground truth, or a text file of predictions')
    parser.add_argument('--ground-truth', metavar='G', help='labels for the results that are text files')
    parser.add_argument('--dataset', choices=sorted(DATASETS),
                        help='joints and camera of the results that are text files')
    parser.add_argument('--json', metavar='FILE', help='write all numbers to this file')
    parser.add_argument('--out', metavar='FOLDER',
                        help='write report.html, and curves and bars as PNG and SVG, to this folder')
    parser.add_argument('--block', type=count, default=30, metavar='N',
                        help='block size of the bootstrap: neighbouring frames have similar errors (default: 30)')


def run(args: argparse.Namespace) -> int:
    """Compare, print, and write what was asked for."""
    if len(args.results) < 2:
        args.parser.error('give at least two results')
    check_outputs((args.json, args.out and Path(args.out) / 'report.html'),
                  (args.ground_truth, *(split_source(source)[1] for source in args.results)))
    dataset = DATASETS[args.dataset] if args.dataset else None
    results = named_apart([load_result(source, args.ground_truth, dataset) for source in args.results], args.results)
    for note in told_notes(results):
        print(f'NOTE: {note}', file=sys.stderr)
    for result in results:
        if result.truth is None:
            raise InputError(f'{result.name} has no ground truth: evaluate it with --ground-truth')
    summaries = [result.summary() for result in results]
    print_summaries(zip((result.name for result in results), summaries, strict=True))
    first, differences = results[0], []
    for other in results[1:]:
        reason = _not_paired(other, first)
        if reason:
            print(f'NOTE: {other.name} and {first.name} {reason}: no interval for their difference', file=sys.stderr)
            continue
        difference, low, high = metrics.paired_bootstrap(
            metrics.frame_means_mm(other.errors_mm), metrics.frame_means_mm(first.errors_mm), block=args.block)
        print(f'{other.name} - {first.name}: {difference:+.3f} mm, 95 % interval {low:+.3f} to {high:+.3f}')
        differences.append({'result': other.name, 'minus': first.name, 'mean_mm': difference,
                            'interval_mm': [low, high]})
    if args.json:
        write_json(args.json, {'results': summaries, 'differences': differences})
    if args.out:
        from hand_pose_ros.evaluation.report import write_report
        if any(result.skeleton != first.skeleton for result in results):
            raise InputError('results with different joints cannot be drawn into one picture: leave out --out')
        print(f'report: {write_report(results, Path(args.out))}')
    return 0


def _not_paired(a: Result, b: Result) -> str:
    """Why two results cannot be compared frame by frame; empty if they can."""
    assert a.truth is not None and b.truth is not None
    if a.predictions.shape != b.predictions.shape:
        return f'have {len(a.predictions)} and {len(b.predictions)} frames' if a.skeleton == b.skeleton \
            else 'have different joints'
    if not np.allclose(a.truth, b.truth, atol=1e-6, equal_nan=True):
        return 'were evaluated on different truth'
    if np.isfinite(metrics.frame_means_mm(a.errors_mm) + metrics.frame_means_mm(b.errors_mm)).sum() < 2:
        return 'have fewer than two frames with a hand in common'
    return ''
