"""`hand-pose adapt`: fine-tune a network to a camera of one's own, from a bag without labels."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_pose_ros.cli.arguments import add_bag, bag_options, count, keep_input
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.files import check_writable

if TYPE_CHECKING:
    from hand_pose_ros.evaluation.progress import Progress
    from hand_pose_ros.models.checkpoints import Checkpoint
    from hand_pose_ros.training.adapt import Look

DESCRIPTION = ('Fine-tune a network to your camera, from a bag without labels, and compare it with the original '
               'on images that it did not learn from. It needs no ROS and no GPU, and takes some minutes.')

EXAMPLES = """examples:
  hand-pose adapt my_hand.mcap --out my_camera.safetensors
  hand-pose adapt old.bag --depth-topic /camera/depth/image_raw --side left --out my_camera.safetensors
  hand-pose adapt labelled.mcap --ground-truth /truth/joints --out my_camera.safetensors
  hand-pose estimate other.mcap --model my_camera.safetensors --overlay pictures

Record one hand, alone before the camera, that turns and opens and closes, for one or two minutes: the first three
quarters are learned from, the rest is for the comparison that is printed. docs/adapting.md says what to expect.
"""
CHECKED = 500
"""Number of frames of synthetic-test-v1. They show whether the network has forgotten other hands."""
WORSE = 1.01
"""If the error on these frames grows by more than this factor, there is a warning."""
ROWS = {'found': ('images with a hand, %', 100.0), 'error_mm': ('mean error, mm', 1.0),
        'disagreement_mm': ('disagreement, mm', 1.0), 'jitter_mm': ('jitter, mm', 1.0),
        'bone_drift_mm': ('bone drift, mm', 1.0), 'explained': ('depth explained, %', 100.0)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('bag', metavar='BAG', type=Path, help='a recording of one moving hand (ROS 1, sqlite3, MCAP)')
    parser.add_argument('--out', type=Path, required=True, metavar='FILE',
                        help='write the new weights to this .safetensors')
    parser.add_argument('--model', help='weights to start from: a name or a path (hand_dense)')
    parser.add_argument('--side', default='auto', choices=('auto', 'left', 'right'),
                        help='which hand it is (auto); give it if you can')
    parser.add_argument('--steps', type=count, default=300, metavar='N',
                        help='training steps, of 32 samples each (300)')
    parser.add_argument('--ground-truth', metavar='G', help='only for the comparison: a topic of the bag with '
                        'HandJointsArray, or an .npz file as for `hand-pose evaluate`')
    add_bag(parser)


def run(args: argparse.Namespace) -> int:
    """Adapt, compare, write the weights, and say whether they are better."""
    if args.out.suffix != '.safetensors':
        args.parser.error(f'--out {args.out}: the name must end in .safetensors')
    keep_input(args.out, args.model)
    check_writable(args.out)  # now, not after minutes of work

    import torch

    from hand_pose_ros.datasets import open_dataset
    from hand_pose_ros.datasets.memory import keep_freed_memory
    from hand_pose_ros.datasets.shards import make_shard
    from hand_pose_ros.evaluation.bag_evaluation import Settings
    from hand_pose_ros.models.checkpoints import DEFAULT, load_checkpoint, save_checkpoint
    from hand_pose_ros.runtime import make_engine
    from hand_pose_ros.training.adapt import fine_tune, judge, label, look, require_hands
    from hand_pose_ros.training.validation import estimate

    keep_freed_memory()
    checkpoint = load_checkpoint(args.model)
    name = args.model or DEFAULT
    _check_fits(checkpoint, name)

    def look_with(model: str | None, what: str) -> Look:
        return look(args.bag, Settings(model, 'cpu', estimator={'side': args.side}, bag=bag_options(args),
                                       ground_truth=args.ground_truth), _progress(f'{what}: images'))

    found, engine = look_with(args.model, 'before'), make_engine(checkpoint.network, 'cpu')
    for note in found.result.notes:  # they may say why there are not enough hands
        print(f'NOTE: {note}', file=sys.stderr)
    require_hands(found, args.bag)
    labelled = label(engine, *found.select(found.split()[0]), _progress('labels'))
    before = judge(found, engine, _progress('before: comparison'))
    synthetic = make_shard(open_dataset('synthetic', 'train'), 0, min(1024, 16 * args.steps))
    network = fine_tune(checkpoint.network, labelled, synthetic, args.steps, _progress('training'))

    metadata = {key: value for key, value in checkpoint.metadata.items() if key != 'validation'} | {
        'name': args.out.stem, 'data': f'synthetic hands of this package, and unlabelled depth of {args.bag.name}'}
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / args.out.name
        save_checkpoint(trial, network, metadata)  # judge what will be written: it is rounded to half precision
        network = load_checkpoint(trial).network
        after = judge(look_with(str(trial), 'after'), make_engine(network, 'cpu'), _progress('after: comparison'))
    test = [make_shard(open_dataset('synthetic', 'test'), 0, CHECKED)]
    errors = [1000 * float((joints - truth).norm(dim=-1).mean()) for joints, truth in
              (estimate(each, test, torch.device('cpu')) for each in (checkpoint.network, network))]
    adapted = {'from': name, 'bag': args.bag.name, 'images': len(labelled['patch']), 'steps': args.steps,
               'before': before, 'after': after, 'synthetic_test_v1_mm': errors}
    save_checkpoint(args.out, network, {**metadata, 'adapted': adapted})
    print(f'\n{len(labelled["patch"])} images were learned from; held out were the last '
          f'{int(found.split()[1].sum())} of {len(found.result.predictions)}.\n')
    _tell(args.out, adapted)
    return 0


def _tell(out: Path, adapted: dict[str, Any]) -> None:
    """Print the numbers before and after, and which weights to use."""
    from hand_pose_ros.evaluation.tables import number, text_table
    from hand_pose_ros.training.adapt import is_better

    name, before, after, errors = (adapted[key] for key in ('from', 'before', 'after', 'synthetic_test_v1_mm'))
    rows: list[tuple[str, ...]] = [
        (title, number(before[key], 1, '', factor), number(after[key], 1, '', factor))
        for key, (title, factor) in ROWS.items() if before[key] is not None]
    rows.append((f'synthetic-test-v1, first {CHECKED} frames, mm', *(number(error, 1) for error in errors)))
    print(text_table(('', 'before', 'after'), rows))
    print(f'\nWritten to {out}; use them with --model {out}.')
    if errors[1] > WORSE * errors[0]:
        print(f'WARNING: on synthetic-test-v1 the adapted weights are worse ({errors[0]:.2f} mm before, '
              f'{errors[1]:.2f} mm after): for other hands and cameras use {name}.')
    if not is_better(before, after):
        print(f'The adapted weights are no better on the held-out images: keep {name}.')
    elif before['error_mm'] is None:
        print('The adapted weights agree better with themselves and with the depth on the held-out images. Whether '
              'they are more accurate only labels could tell (--ground-truth): look at the pictures of '
              '`hand-pose estimate --overlay` before and after.')


def _check_fits(checkpoint: Checkpoint, name: str) -> None:
    if checkpoint.metadata['skeleton'] != 'hand21':
        raise HandPoseError(f"{name}: its joints are those of {checkpoint.metadata['skeleton']}, but only weights for "
                            'hand21 can be adapted: give others with --model')
    if checkpoint.refiner is not None:
        raise HandPoseError(f'{name}: it has a refiner, which was trained on the errors of this very network: adapt '
                            'weights without a refiner')


def _progress(what: str) -> Progress:
    from tqdm import tqdm

    def progress(items: Iterable[Any], total: int) -> Iterable[Any]:
        if not sys.stderr.isatty():
            print(f'{what}: {total} ...', file=sys.stderr, flush=True)
        return tqdm(items, what, total, disable=None)
    return progress
