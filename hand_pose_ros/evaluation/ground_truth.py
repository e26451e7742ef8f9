"""Where the hands of a bag really were: from a topic of it, an .npz file, or a text file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.bags import read_hands
from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation.published import read_text
from hand_pose_ros.evaluation.results import DAMAGE, Result

TOLERANCE_NS = 10_000_000
"""A label belongs to the image with the nearest stamp, if it is not further away than this (10 ms)."""

Joints = NDArray[np.float64]


def with_truth(result: Result, source: str, bag: str | Path) -> Result:
    """The result of N images of a bag, with the true joints; images without a label get a note.

    Args:
        source: a topic of the bag with HandJointsArray, one hand a message; an .npz file with `joints` (M, J, 3) in
            metres and, if M is not N, `stamps_ns` (M,); or a text file with `u v d` per joint and a line for each
            image, see `published`.

    Raises:
        InputError: there is no such source, or it does not fit the images.
    """
    stamps, joints = _read(source, bag, result)
    expected = (len(result.skeleton), 3)
    if joints.ndim != 3 or joints.shape[1:] != expected:
        raise InputError(f'{source}: the truth has the shape {joints.shape}, but the joints of the estimator '
                         f'({result.skeleton.name}) need (frames, {expected[0]}, 3)')
    if stamps is None:
        if len(joints) != len(result.predictions):
            raise InputError(f'{source}: {len(joints)} labels for {len(result.predictions)} images: give one for each '
                             'image, or an .npz file with stamps_ns')
        truth = joints
    else:
        truth = _match(stamps, joints, result, source)
    missing = int(np.isnan(truth).all((1, 2)).sum())
    notes = (f'{missing} of {len(truth)} images have no label in {source} and are not scored.',) if missing else ()
    return replace(result, truth=truth, notes=(*result.notes, *notes), info={**result.info, 'ground_truth': source})


def _read(source: str, bag: str | Path, result: Result) -> tuple[NDArray[np.int64] | None, Joints]:
    if not Path(source).is_file():
        if not source.startswith('/'):
            raise InputError(f'{source}: there is no such file, and it is no topic either, which begins with /')
        return _read_topic(source, bag)
    if Path(source).suffix == '.npz':
        try:
            with np.load(source) as file:
                stamps, joints = file.get('stamps_ns'), file['joints'].astype(np.float64)
        except (OSError, *DAMAGE):
            raise InputError(f'{source}: not an .npz file with an array joints (frames, joints, 3) in metres') from None
        if stamps is not None and stamps.shape != (len(joints),):
            raise InputError(f'{source}: stamps_ns of shape {stamps.shape} for {len(joints)} labels: give one for each')
        return stamps, joints
    return None, read_text(source, result.skeleton).points(result.intrinsics)


def _read_topic(topic: str, bag: str | Path) -> tuple[NDArray[np.int64], Joints]:
    messages = [message for message in read_hands(bag, topic) if len(message.joints)]
    if not messages:
        raise InputError(f'{bag}: {topic} has no hand in any message, so there is nothing to compare with')
    for message in messages:
        if len(message.joints) > 1:
            raise InputError(f'{bag}: {topic} has {len(message.joints)} hands at {message.stamp_ns} ns, but one hand '
                             'an image is evaluated: record one topic for each hand')
    return (np.array([message.stamp_ns for message in messages]),
            np.stack([message.joints[0] for message in messages]).astype(np.float64))


def _match(stamps: NDArray[np.int64], joints: Joints, result: Result, source: str) -> Joints:
    """For each image the label with the nearest stamp; NaN (J, 3) if none is near enough."""
    assert result.stamps_ns is not None
    order = np.argsort(stamps, kind='stable')
    stamps, joints = stamps[order], joints[order]
    right = np.searchsorted(stamps, result.stamps_ns).clip(1, max(1, len(stamps) - 1))
    candidates = np.stack([right - 1, right.clip(max=len(stamps) - 1)])
    distances = np.abs(stamps[candidates] - result.stamps_ns)
    nearest = np.take_along_axis(candidates, distances.argmin(0)[None], 0)[0]
    near = distances.min(0) <= TOLERANCE_NS
    if not near.any():
        raise InputError(f'{source}: no label is within {TOLERANCE_NS / 1e6:.0f} ms of an image: the nearest is '
                         f'{distances.min() / 1e9:.3f} s away; are the stamps of the same clock?')
    truth = np.full((len(near), *joints.shape[1:]), np.nan)
    truth[near] = joints[nearest[near]]
    return truth
