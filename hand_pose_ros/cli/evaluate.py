"""`hand-pose evaluate`: score a prediction file, or the estimator on bags."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from hand_pose_ros.bags import DepthBag
from hand_pose_ros.cli.arguments import (
    ESTIMATOR,
    add_bag,
    add_estimator,
    bag_options,
    check_outputs,
    count,
    estimator_options,
    keep_input,
    refuse,
)
from hand_pose_ros.cli.hand_bag import HandBag
from hand_pose_ros.errors import HandPoseError, InputError, counted
from hand_pose_ros.evaluation import published
from hand_pose_ros.evaluation.ground_truth import read_truth, with_truth
from hand_pose_ros.evaluation.results import Result, named_apart, split_source, told_notes
from hand_pose_ros.evaluation.tables import ACCURACY_COLUMNS, accuracy_rows, number, text_table
from hand_pose_ros.files import write_json
from hand_pose_ros.skeleton import get_skeleton

if TYPE_CHECKING:
    from hand_pose_ros.evaluation.bag_evaluation import Settings

DESCRIPTION = ('Score predictions in a text file against labels, or run the estimator over bags and score it. Without '
               'ground truth, report only what needs none, such as frame rate and jitter.')

EXAMPLES = """examples:
  hand-pose evaluate --predictions NYU.txt.gz --ground-truth labels.txt.gz --dataset nyu --report out
  hand-pose evaluate recording.mcap --report out
  hand-pose evaluate recording.mcap --ground-truth /truth/joints --json result.json --out result.npz
  hand-pose evaluate day1/*.bag --depth-topic /camera/depth/image_rect --intrinsics 476 476 314 243 --out results
  hand-pose evaluate synthetic-test-v1 --model hand_dense --json result.json
  hand-pose evaluate nyu --root /data/NYU --split test_2 --model runs/nyu/best.safetensors --json result.json
  torchrun --nproc-per-node 4 --no-python hand-pose evaluate bags/*.mcap --out results

Text files have one frame per line, with `u v d` for each joint, in pixels and millimetres. A line may begin with a file
name. The file may be gzipped.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('bags', nargs='*', metavar='BAG', help='a ROS 1 file, a ROS 2 folder, or an .mcap or .db3 '
                        'file; or synthetic-test-v1, the benchmark, which is made on the spot; or, with --root, nyu, '
                        'icvl, msra or msra:P1 to msra:P8')
    parser.add_argument('--ground-truth', metavar='G', help='text file of labels; with a bag also an .npz file with '
                        'joints (frames, joints, 3) in metres, or a topic of the bag with HandJointsArray')
    parser.add_argument('--json', metavar='FILE', help='write all numbers to this file')
    parser.add_argument('--report', metavar='FOLDER', help='write report.html and the plots to this folder')
    parser.add_argument('--out', metavar='FILE', help='write the result to this .npz, for `hand-pose compare`; with '
                        'several bags a folder')
    parser.add_argument('--compare', nargs='+', default=[], metavar='[NAME=]FILE',
                        help='more results for the report: an .npz of --out, or a text file of the same dataset')
    text = parser.add_argument_group('predictions as text')
    text.add_argument('--predictions', metavar='P', help='text file; or an .npz file with 2D joints `uv` of NYU, which '
                      'are lifted with --depth-folder')
    text.add_argument('--dataset', choices=sorted(published.DATASETS), help='whose joints and camera the text has')
    text.add_argument('--depth-folder', metavar='FOLDER', help='depth_1_%%07d.png of NYU, for overlays and 2D joints')
    text.add_argument('--protocol', choices=('paper', 'code'), default='paper',
                      help='2D joints beside the hand get the depth of the back face of the cube (paper, the default), '
                      'or their true depth (the code of the paper, which favours them)')
    bags = parser.add_argument_group('bags')
    add_bag(bags)
    add_estimator(bags)
    bags.add_argument('--out-bag', metavar='BAG', help='write /hand/joints and /hand/markers there, to be played '
                      'beside the original; with several bags a folder')
    bags.add_argument('--via-ros', action='store_true', help='play the bag through the live node at the recorded rate, '
                      'and report dropped images and the latency from image to joints')
    bags.add_argument('--jobs', type=count, metavar='N',
                      help='how many bags to process at the same time (default: one per core)')
    recorded = parser.add_argument_group('recorded datasets')
    recorded.add_argument('--root', type=Path, metavar='FOLDER', help='folder of nyu, icvl or msra, as distributed')
    recorded.add_argument('--split', help='test (the default), val or train; nyu and icvl also have test_1 and test_2')


def run(args: argparse.Namespace) -> int:
    """Evaluate, write the outputs and print the numbers. Returns 1 if a bag failed or is damaged."""
    if bool(args.bags) == bool(args.predictions):
        args.parser.error('give either bags or --predictions')
    places: dict[str, str] = {}
    for bag in args.bags:
        place = os.path.abspath(bag)  # links may have names of their own
        if place in places:  # both would write the same files
            args.parser.error(f'{places[place]} and {bag} are the same bag: give it once')
        places[place] = bag
    if args.out and len(args.bags) < 2 and Path(args.out).suffix != '.npz':
        args.parser.error(f'--out {args.out}: the result is an .npz file')
    out = Path(args.out) / 'any.npz' if args.out and len(args.bags) > 1 else args.out
    compared = [split_source(source)[1] for source in args.compare]
    check_outputs((args.json, out, args.report and Path(args.report) / 'report.html'),
                  (*args.bags, args.ground_truth, args.predictions, *compared))
    if args.predictions:
        refuse(args, (*ESTIMATOR, 'depth_topic', 'camera_info_topic', 'depth_scale', 'out_bag', 'via_ros', 'jobs',
                      'root', 'split'), 'is for bags and recorded datasets: these joints are estimated already')
        return _run_text(args)
    refuse(args, ('dataset', 'depth_folder', 'protocol'), 'is for --predictions')
    recorded = len(args.bags) == 1 and re.fullmatch(r'nyu|icvl|msra(:P\d)?', args.bags[0]) is not None
    if not recorded:
        refuse(args, ('root', 'split'), 'is for nyu, icvl and msra')
    if recorded or args.bags == ['synthetic-test-v1']:
        return _run_dataset(args, args.bags[0], recorded)
    return _run_bag(args) if len(args.bags) == 1 else _run_bags(args)


def _run_text(args: argparse.Namespace) -> int:
    if not args.ground_truth or not args.dataset:
        args.parser.error('--predictions needs --ground-truth and --dataset')
    dataset = published.DATASETS[args.dataset]
    if args.intrinsics:
        fx, fy, cx, cy = args.intrinsics
        dataset = replace(dataset, intrinsics=replace(dataset.intrinsics, fx=fx, fy=fy, cx=cx, cy=cy))
    if args.depth_folder:
        from hand_pose_ros.evaluation import tompson  # imports torch, which text alone does not need

    if Path(args.predictions).suffix == '.npz':
        if not args.depth_folder:
            args.parser.error(f'--predictions {args.predictions}: an .npz file holds 2D joints, which need '
                              '--depth-folder')
        result = tompson.load_tompson(args.predictions, args.ground_truth, args.depth_folder, dataset, args.protocol)
    else:
        result = published.load_published(args.predictions, args.ground_truth, dataset)
    if args.depth_folder and len(result.predictions) != published.DATASETS['nyu'].frames:
        raise InputError(f'--depth-folder needs all 8252 test frames of NYU, but {args.predictions} and '
                         f'{args.ground_truth} have {len(result.predictions)} in common: leave out --depth-folder')
    others = [published.load_result(source, args.ground_truth, dataset) for source in args.compare]
    read_depths = partial(tompson.read_nyu_depths, args.depth_folder) if args.depth_folder else None
    _deliver(result, others, read_depths, args.json, args.out, args.report, args.compare)
    return 0


def _run_dataset(args: argparse.Namespace, name: str, recorded: bool) -> int:
    refuse(args, ('side', 'detector', 'cube_size', 'min_score', 'ground_truth', 'depth_topic', 'camera_info_topic',
                  'intrinsics', 'depth_scale', 'out_bag', 'via_ros', 'jobs'),
           f'is for bags: crops, sides and truth are those of {name}')
    if recorded and args.root is None:
        args.parser.error(f'{name} is read from disk: give its folder with --root')
    others = [published.load_result(source) for source in args.compare]
    if recorded:
        from hand_pose_ros.evaluation.dataset_evaluation import evaluate_dataset
        result = evaluate_dataset(name, args.root, args.model, args.split or 'test', args.device, _progress('batches'))
    else:
        from hand_pose_ros.evaluation.benchmark_evaluation import evaluate_benchmark
        result = evaluate_benchmark(args.model, args.device, progress=_progress('batches'))
    _deliver(result, others, None, args.json, args.out, args.report, args.compare)
    return 0


def _run_bag(args: argparse.Namespace) -> int:
    from hand_pose_ros.evaluation.bag_evaluation import evaluate_bag, read_depths

    keep_input(args.out_bag, args.bags[0])
    others = [published.load_result(source) for source in args.compare]  # before the work: one may be missing
    settings = _settings(args)
    sink = partial(HandBag, args.out_bag) if args.out_bag else None
    result = _evaluate_live(args, settings) if args.via_ros else \
        evaluate_bag(args.bags[0], settings, _progress('frames'), sink)
    depths = partial(read_depths, args.bags[0], settings=settings)
    _deliver(result, others, depths, args.json, args.out, args.report, args.compare)
    return int(result.info['damaged'])


def _evaluate_live(args: argparse.Namespace, settings: Settings) -> Result:
    """The answers of the live node to a bag. Images without an answer count as images without a hand."""
    if args.out_bag:
        args.parser.error('--out-bag does not work with --via-ros: record /hand/joints instead')
    from hand_pose_ros.evaluation.bag_evaluation import until_damaged
    from hand_pose_ros.models.checkpoints import DEFAULT, load_checkpoint
    from hand_pose_ros.ros.live import play_through_node

    parameters = {'model': args.model, 'device': args.device, 'side': args.side, 'detector': args.detector,
                  'cube_size': args.cube_size, 'min_score': args.min_score, 'depth_scale': args.depth_scale,
                  'max_hands': 1}  # as without the node: only one hand is compared
    if args.intrinsics:
        parameters |= {f'intrinsics.{name}': value for name, value in zip(('fx', 'fy', 'cx', 'cy'), args.intrinsics,
                                                                          strict=True)}
    skeleton = get_skeleton(load_checkpoint(args.model).metadata['skeleton'])
    truth = args.ground_truth and read_truth(args.ground_truth, args.bags[0], skeleton)
    notes: list[str] = []
    stamps: list[int] = []
    intrinsics, frame_id = None, ''
    with DepthBag(args.bags[0], **settings.bag) as bag:
        for frame, _ in until_damaged(bag, notes):
            stamps.append(frame.stamp_ns)
            if intrinsics is None:
                with suppress(InputError):  # it cannot be decoded; any other image will do
                    intrinsics, frame_id = frame.intrinsics, frame.frame_id
        if intrinsics is None:
            raise InputError(f'{args.bags[0]}: there is no depth image that can be decoded')
        answers = play_through_node(bag, args.camera_info_topic,
                                    {name: value for name, value in parameters.items() if value is not None})
        topic = bag.depth_topic
    joints = np.full((len(stamps), len(skeleton), 3), np.nan)
    ids = [''] * len(stamps)
    for row, stamp in enumerate(stamps):
        if stamp in answers.hands and answers.hands[stamp].hands:
            hand = answers.hands[stamp].hands[0]
            joints[row], ids[row] = [(point.x, point.y, point.z) for point in hand.joints], hand.id
    latency = np.array([answers.latency_s.get(stamp, np.nan) for stamp in stamps])
    dropped = sum(stamp not in answers.hands for stamp in stamps)
    damaged = bool(notes)
    if dropped:
        notes.append(f'{dropped} of {len(stamps)} images got no answer from the node and count as images without a '
                     'hand.')
    result = Result(
        Path(args.bags[0]).stem, skeleton, intrinsics, joints, stamps_ns=np.array(stamps), hand_ids=np.array(ids),
        seconds={'image to joints': latency}, notes=tuple(notes), info={
            'bag': args.bags[0], 'depth_topic': topic, 'model': args.model or DEFAULT, 'device': args.device,
            'via_ros': True, 'dropped': dropped, 'damaged': damaged})
    return with_truth(result, truth, frame_id) if truth else result


def _run_bags(args: argparse.Namespace) -> int:
    from hand_pose_ros.evaluation.bag_evaluation import evaluate_bags, read_depths

    if args.compare or args.via_ros:
        args.parser.error('--compare and --via-ros work with one bag, not with several')
    settings, names = _settings(args), _names(args.bags)
    sinks = {bag: partial(HandBag, Path(args.out_bag) / f'{names[bag]}.mcap') for bag in args.bags if args.out_bag}
    for bag in sinks:
        keep_input(Path(args.out_bag) / f'{names[bag]}.mcap', bag)
    summaries: dict[str, Any] = {}
    try:
        for bag, outcome in evaluate_bags(args.bags, settings, args.jobs, _progress('bags'), sinks):
            with tqdm.external_write_mode():
                print(f'\n{bag}', flush=True)
                if isinstance(outcome, HandPoseError):
                    print(f'FAILED: {outcome}', file=sys.stderr)
                    summaries[str(bag)] = {'error': str(outcome)}
                    continue
                result = replace(outcome, name=names[str(bag)])
                summaries[str(bag)] = result.summary()
                _deliver(result, [], partial(read_depths, bag, settings=settings),
                         out=args.out and Path(args.out) / f'{result.name}.npz',
                         report=args.report and Path(args.report) / result.name)
    finally:  # also after Ctrl-C
        if args.json and summaries:
            write_json(args.json, {'bags': {bag: summaries[bag] for bag in args.bags if bag in summaries}})
    failed = [bag for bag, summary in summaries.items() if 'error' in summary or summary['damaged']]
    if failed:
        print(f'\n{len(failed)} of {len(summaries)} bags failed or {"is" if len(failed) == 1 else "are"} damaged: '
              + ', '.join(failed), file=sys.stderr)
    return int(bool(failed))


def _settings(args: argparse.Namespace) -> Settings:
    from hand_pose_ros.evaluation.bag_evaluation import Settings

    return Settings(args.model, args.device, ground_truth=args.ground_truth, bag=bag_options(args),
                    estimator=estimator_options(args))


def _names(bags: Sequence[str]) -> dict[str, str]:
    """A short, unique name for each bag."""
    stems = [Path(bag).stem for bag in bags]
    names: dict[str, str] = {}
    for bag, stem in zip(bags, stems, strict=True):
        name = stem if stems.count(stem) == 1 else '_'.join(Path(bag).parts).strip('/\\_.')
        taken = sum(other == name or other.startswith(f'{name}-') for other in names.values())
        names[bag] = f'{name}-{taken + 1}' if taken else name
    return names


def _deliver(result: Result, others: Sequence[Result], read_depths: Callable[[Sequence[int]], dict[int, Any]] | None,
             json: str | None = None, out: str | Path | None = None, report: str | Path | None = None,
             sources: Sequence[str] = ()) -> None:
    """Write the outputs and print the numbers. `sources` are the files of the other results."""
    result, *others = named_apart([result, *others], ['', *sources])
    for note in told_notes([result, *others]):
        print(f'NOTE: {note}', file=sys.stderr)
    summary = result.summary()
    if json:  # files come first, because printing may fail
        write_json(json, summary)
    if out:
        result.save(out)
    print_summaries([(result.name, summary), *((other.name, other.summary()) for other in others)])
    if report:
        from hand_pose_ros.evaluation.report import write_report
        if any(other.skeleton != result.skeleton for other in others):
            raise InputError(f'--compare: all results must have the joints of {result.skeleton.name}')
        print(f'report: {write_report([result, *others], report, read_depths)}')


def print_summaries(summaries: Iterable[tuple[str, dict[str, Any]]]) -> None:
    """Print one table of accuracy, and for each result the numbers that need no truth."""
    summaries = list(summaries)
    rows = [row for name, summary in summaries if 'mean_mm' in summary for row in accuracy_rows(name, summary)]
    if rows:
        print(text_table(ACCURACY_COLUMNS, rows))
    for name, summary in summaries:
        if 'latency_ms' not in summary:
            continue
        line = (f'{name}: {counted(summary["frames_total"], "frames")}, '
                f'{number(summary["detection_rate"], 1, " %", 100)} with a hand, {_tracks(summary)}{_pace(summary)}')
        if 'mean_mm' not in summary:  # with truth, the table says more
            line += (f', jitter {number(summary["jitter_mm"], 2, " mm")}, '
                     f'bone drift {number(summary["bone_drift_mm"], 2, " mm")}')
        print(line)
        keys = ('mean', 'p50', 'p90', 'p99', 'max')
        print(text_table(('ms', *keys), [(stage, *(number(row.get(key), 3) for key in keys))
                                         for stage, row in summary['latency_ms'].items()]))


def _tracks(summary: dict[str, Any]) -> str:
    if 'tracks' not in summary:  # a file that an earlier version wrote
        return ''
    return f'{counted(summary["tracks"], "tracks")}, '


def _pace(summary: dict[str, Any]) -> str:
    return f'{summary["dropped"]} dropped' if 'dropped' in summary else f'{summary["frames_per_s"]} frames/s'


def _progress(unit: str) -> Callable[[Iterable[Any], int], Iterable[Any]]:
    return lambda items, total: tqdm(items, total=total, unit=f' {unit}', disable=None)  # only on a terminal
