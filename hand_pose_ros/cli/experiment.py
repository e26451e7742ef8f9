"""`hand-pose experiment`: repeat an experiment of the paper."""

from __future__ import annotations

import argparse
from pathlib import Path

from hand_pose_ros.cli.arguments import without_bag_options
from hand_pose_ros.cli.train import BAG_REMEDY, add_machine_arguments, machine, show_progress

DESCRIPTION = """\
Repeat an experiment of the paper: train the networks that it needs, test them, and write tables and plots.
This may take hours. After Ctrl-C, start the same command again to continue."""

EXAMPLES = """experiments:
  networks      Shallow, Deep and Multi-Scale, each direct and with a bottleneck of 8 and 30, and DeepPrior++
  bottleneck    width of the bottleneck against direct regression
  refinement    none, StdRef and ORRef, and the number of iterations
  joints        mean error of each joint
  runtime       milliseconds per hand, beside the paper's
  qualitative   estimates and truth on depth and on the point cloud from the side
  ingredients   (ours) what each ingredient of the synthetic hands is worth: trained without it, tested with all

Each writes NAME.json, NAME.md, NAME.png and NAME.svg; bottleneck and refinement also write their curves, as
NAME-curves.*. Networks are trained with equal budgets into OUT/runs and shared by all experiments in OUT. An
interrupted training continues.

examples:
  hand-pose experiment bottleneck --out results --set samples=300_000
  hand-pose experiment networks --out results-nyu --set dataset=nyu --set root=/data/NYU --set epochs=20
"""

NAMES = ('networks', 'bottleneck', 'refinement', 'joints', 'runtime', 'qualitative', 'ingredients')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('name', choices=NAMES, metavar='NAME', help='see below')
    parser.add_argument('--out', type=Path, required=True, metavar='OUT', help='folder of results and trained networks')
    parser.add_argument('--recipe', default='paper', help='recipe of all networks (default: %(default)s)')
    add_machine_arguments(parser)


@without_bag_options(BAG_REMEDY)
def run(args: argparse.Namespace) -> int:
    """Train what is missing, test, write the results and print the table."""
    from tqdm.contrib.logging import logging_redirect_tqdm

    from hand_pose_ros.training.experiments import EXPERIMENTS, Laboratory
    from hand_pose_ros.training.recipes import get_recipe

    show_progress()
    recipe = get_recipe(args.recipe, args.overrides)
    args.out.mkdir(parents=True, exist_ok=True)
    with logging_redirect_tqdm():
        print(EXPERIMENTS[args.name](Laboratory(args.out, recipe, machine(args))))
    return 0
