"""Kinds of values on the command line, refused with one sentence where they cannot be."""

from __future__ import annotations

import argparse
from pathlib import Path

from hand_pose_ros.errors import HandPoseError


def count(text: str) -> int:
    """1 or more."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is less than 1')
    return value


def share(text: str) -> float:
    """0 to 1."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f'{text} is not between 0 and 1')
    return value


def metres(text: str) -> float:
    """More than 0 and at most 1, as the side of a cube and the unit of depth are."""
    value = float(text)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f'{text} is not more than 0 and at most 1 (metres)')
    return value


def none_or_more(text: str) -> int:
    """0 or more."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'{text} is less than 0')
    return value


def keep_input(output: str | Path | None, source: str | Path) -> None:
    """Raise HandPoseError if an output would replace the input."""
    if output is not None and Path(output).exists() and Path(source).exists() and Path(output).samefile(source):
        raise HandPoseError(f'{output}: this is the input, which would be lost: choose another place')
