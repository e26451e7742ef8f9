"""The `hand-pose` command: one file per verb, imported only when it is asked for.

A verb is a module with DESCRIPTION, EXAMPLES, `add_arguments(parser)` and `run(args) -> int`. `args.parser` is that
parser. If the module has a HINT, it follows the message about unknown arguments. Exit codes: 0 done, 1 failed, 2 bad
arguments.
"""

from __future__ import annotations

import argparse
import importlib
import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from hand_pose_ros import __version__
from hand_pose_ros.errors import HandPoseError

VERBS = {
    'demo': 'play the bag that ships through the live node and show what comes out',
    'estimate': 'find the joints in a bag or in 16-bit depth PNGs',
    'estimator': 'run the ROS 2 node',
    'view': 'show depth images and hands in 3D, live or from a bag',
    'replay': 'publish a bag on ROS topics',
    'evaluate': 'score a prediction file, or the estimator on a bag',
    'compare': 'compare several results side by side',
    'train': 'train a network from a recipe',
    'adapt': 'fine-tune a network to your camera, from a bag without labels',
    'experiment': 'repeat an experiment of the paper',
    'synth': 'make or show synthetic depth hands',
    'bench': 'measure speed on this machine',
    'doctor': 'check what is installed and whether it works',
}


class _Parser(argparse.ArgumentParser):
    """Reports bad arguments in one sentence, like all other errors, and without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'{self.prog}: {message} (--help says what can be given)\n')


@contextmanager
def _ending_like_ctrl_c() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, so that nothing half-made is left behind. Training and the node have handlers
    of their own.
    """
    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not interrupt the clean-up
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _open_standard_streams() -> None:
    """Open /dev/null in place of closed standard streams.

    Otherwise, the next file that is opened takes the place of one, and receives what libraries print.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it takes the lowest free number
    sys.stdout, sys.stderr = (stream or open(os.devnull, 'w') for stream in (sys.stdout, sys.stderr))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')  # as on standard error, because file names may hold any bytes


@contextmanager
def _printing() -> Iterator[None]:
    """If something cannot be printed (`| head`, a full disk), name standard output in the OSError.

    Without this, Python would report the error once more at exit.
    """
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            error.filename = 'standard output'
        try:
            sys.stdout.flush()
        except OSError:
            error.filename = 'standard output'
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    _open_standard_streams()
    argv = list(sys.argv[1:] if argv is None else argv)
    name = ' '.join(['hand-pose', *argv[:1]])
    try:
        with _ending_like_ctrl_c(), _printing():
            module, args = _parsed(argv)
            return module.run(args)
    except HandPoseError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 1
    except OSError as error:  # a file that cannot be read or written
        what = f'{error.filename}: {error.strerror}' if error.filename else str(error)
        if isinstance(error, FileExistsError | NotADirectoryError):
            what += ', and a folder is needed: give another name'
        print(f'{name}: {what}', file=sys.stderr)
        return 1
    except RuntimeError as error:
        if type(error).__name__ != 'OutOfMemoryError':  # of PyTorch, which most verbs need not import
            raise
        less = '--device cpu' if argv[0] not in ('train', 'experiment') else (
            'a lower --set batch_size, and --workers 1 or more')
        print(f'{name}: {str(error).partition(". ")[0]}: end other programs on the GPU, or give {less}',
              file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ImportError) as error:
        # Modules in C that are interrupted while they are imported make an ImportError of it.
        if not isinstance(error.__cause__ or error, KeyboardInterrupt):
            raise
        print(f'{name}: interrupted', file=sys.stderr)
        return 1


def _parsed(argv: list[str]) -> tuple[Any, argparse.Namespace]:
    """The module of the verb, and its arguments."""
    parser = _Parser(
        prog='hand-pose', description='3D hand joints from depth images.',
        epilog='hand-pose VERB --help explains each verb.')
    parser.add_argument('--version', action='version', version=f'hand-pose {__version__}')
    subparsers = parser.add_subparsers(dest='verb', metavar='VERB', required=True)
    module = None
    # Only the verb that was asked for is imported: torch, matplotlib and ROS are slow to load.
    for verb, summary in VERBS.items():
        subparser = subparsers.add_parser(verb, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter)
        subparser.set_defaults(parser=subparser)
        if argv[:1] == [verb]:
            module = importlib.import_module(f'hand_pose_ros.cli.{verb}')
            subparser.description, subparser.epilog = module.DESCRIPTION, module.EXAMPLES
            module.add_arguments(subparser)
    args, unknown = parser.parse_known_args(argv)
    if module is None:
        parser.error('the verb comes first')
    if unknown:
        hint = f'; {module.HINT}' if hasattr(module, 'HINT') else ''
        args.parser.error(f'unrecognized arguments: {" ".join(unknown)}{hint}')
    return module, args
