"""`hand-pose train`: train a network from a recipe."""

from __future__ import annotations

import argparse
import atexit
import logging
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hand_pose_ros.cli.arguments import count, none_or_more, without_bag_options
from hand_pose_ros.files import check_writable

if TYPE_CHECKING:
    from hand_pose_ros.training.loop import Machine

DESCRIPTION = """\
Train a network from a recipe, on synthetic hands or a recorded dataset. This may take hours. Ctrl-C stops
after the current step and leaves weights that you can use; --resume continues from there."""

EXAMPLES = """examples:
  hand-pose train modern --out runs/modern
  hand-pose train paper --out runs/deep-prior --set samples=1_000_000 --set augmentation=modern
  hand-pose train paper --out runs/direct --set network=shallow --set options.bottleneck=none
  hand-pose train paper --out runs/orref --set refiner=or_ref --set base=runs/deep-prior/best.safetensors
  hand-pose train paper --out runs/nyu --set dataset=nyu --set root=/data/NYU
  hand-pose train --out runs/modern --resume
  torchrun --standalone --nproc-per-node 4 --no-python hand-pose train modern --out runs/m --device cuda --workers 0

recipes: paper, original-code, modern, finder. docs/training.md says what they do, training/recipes.py lists the keys.
"""


BAG_REMEDY = ('training has no such option: write the bag again with one depth topic and its camera_info beside it, as '
              'examples/train_on_your_bags.py does')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('recipe', nargs='?',
                        help='paper, original-code, modern or finder (with --resume: the recipe of the run)')
    parser.add_argument('--out', type=Path, required=True, metavar='RUN', help='folder of the run')
    parser.add_argument('--resume', action='store_true', help='continue the run in RUN')
    add_machine_arguments(parser)


def add_machine_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the values of the recipe, and where to train."""
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', dest='overrides',
                        help='replace a value of the recipe; may be given several times')
    parser.add_argument('--device', default='cpu', help='cpu or cuda (default: %(default)s)')
    parser.add_argument('--workers', type=none_or_more, default=1,
                        help='processes that render or decode; 0: render on the device, for a GPU (default: '
                             '%(default)s)')
    parser.add_argument('--threads', type=count, help='threads of the training process (default: all cores)')
    parser.add_argument('--cache', type=Path, default=Path('~/.cache/hand_pose_ros/samples').expanduser(),
                        help='where rendered and decoded samples are kept for all runs (default: %(default)s)')
    parser.add_argument('--cache-gb', type=count, default=40,
                        help='GB of the cache; beyond it, the samples used longest ago are deleted (default: '
                             '%(default)s)')


def machine(args: argparse.Namespace) -> Machine:
    """Where to train, as the arguments say."""
    from hand_pose_ros.training.loop import Machine

    return Machine(args.cache, args.device, args.workers, args.threads, args.cache_gb)


def show_progress() -> None:
    """Print what is logged; under torchrun, the other processes print only warnings.

    A second Ctrl-C, while Python cleans up after the first one, ends the process silently.
    """
    first = os.environ.get('RANK', '0') == '0'
    logging.basicConfig(level=logging.INFO if first else logging.WARNING, format='%(message)s')
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_DFL)


@without_bag_options(BAG_REMEDY)
def run(args: argparse.Namespace) -> int:
    """Train, or resume, and name the best weights.

    Raises:
        HandPoseError: there is no such recipe, there is a run already, or there is no run to resume.
    """
    from tqdm.contrib.logging import logging_redirect_tqdm

    from hand_pose_ros.training.distributed import process_group
    from hand_pose_ros.training.folder import RunFolder
    from hand_pose_ros.training.loop import Run
    from hand_pose_ros.training.recipes import get_recipe

    if args.resume and (args.recipe or args.overrides):
        args.parser.error('--resume continues with the recipe of the run: give --out and no RECIPE or --set')
    if not args.resume and not args.recipe:
        args.parser.error('give a RECIPE (paper, original-code, modern or finder), or --resume')
    show_progress()
    folder = RunFolder(args.out)
    if not args.resume:
        folder.require_none()  # now, not after the first samples were made
        check_writable(folder.state)
    recipe = folder.recipe() if args.resume else get_recipe(args.recipe, args.overrides)
    with logging_redirect_tqdm(), process_group(args.device) as device:
        training = Run(args.out, recipe, replace(machine(args), device=device))
        training.train(args.resume)
    if training.rank == 0:
        print(f'the best weights in validation: {folder.checkpoint("best")}')
    return 0
