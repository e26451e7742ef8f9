"""The true joints of a bag, from one of its topics, an .npz file, or a text file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.bags import check_frame, read_hands
from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation.published import Labels, read_text
from hand_pose_ros.evaluation.results import DAMAGE, Result
from hand_pose_ros.skeleton import Skeleton

TOLERANCE_NS = 10_000_000
"""A label belongs to the image with the nearest stamp, if the two are at most this far apart (10 ms)."""

Joints = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """The true joints of M frames, as they are in their source.

    Attributes:
        source: the file or topic.
        joints: (M, J, 3) in metres, optical frame; or the labels of a text file, which need the intrinsics for that.
        stamps_ns: (M,); None = there is one frame for each image of the bag, in order.
        frame_id: of the coordinates; empty if the source does not name it.
    """

    source: str
    joints: Joints | Labels
    stamps_ns: NDArray[np.int64] | None = None
    frame_id: str = ''


def read_truth(source: str, bag: str | Path, skeleton: Skeleton) -> Truth:
    """The true joints of a bag.

    Args:
        source: one of these.

            - A topic of the bag, with HandJointsArray and one hand per message.
            - An .npz file with `joints` (M, J, 3) in metres. If there are fewer labels than images, it also has
              `stamps_ns` (M,).
            - A text file with a line for each image, and `u v d` for each joint, see `published`.

    Raises:
        InputError: the source does not exist, cannot be read, or does not fit the skeleton.
    """
    truth = _read(source, bag, skeleton)
    if not isinstance(truth.joints, Labels):
        shape, expected = truth.joints.shape, (len(skeleton), 3)
        if len(shape) != 3 or shape[1:] != expected:
            raise InputError(f'{source}: the truth has the shape {shape}, but the joints of the estimator '
                             f'({skeleton.name}) need (frames, {expected[0]}, 3)')
        if not len(truth.joints):
            raise InputError(f'{source}: its array joints has no labels, so there is nothing to compare with')
        if truth.stamps_ns is not None and truth.stamps_ns.shape != shape[:1]:
            raise InputError(f'{source}: stamps_ns of shape {truth.stamps_ns.shape} for {shape[0]} labels: give one '
                             'for each')
    return truth


def with_truth(result: Result, truth: Truth, frame_id: str) -> Result:
    """The result of a bag, with the true joints. If images have no label, a note says so.

    Args:
        frame_id: of the images.

    Raises:
        InputError: the truth does not fit the images.
    """
    check_frame(truth.source, truth.frame_id, frame_id)
    joints = truth.joints.points(result.intrinsics) if isinstance(truth.joints, Labels) else truth.joints
    if truth.stamps_ns is not None:
        joints = _match(truth.stamps_ns, joints, result, truth.source)
    elif len(joints) != len(result.predictions):
        raise InputError(f'{truth.source}: {len(joints)} labels for {len(result.predictions)} images: give one for '
                         'each image, or an .npz file with stamps_ns')
    joints = np.where(joints[..., 2:] > 0, joints, np.nan)  # at or behind the camera means not labelled
    missing = int(np.isnan(joints).all((1, 2)).sum())
    notes = (f'{missing} of {len(joints)} images have no label in {truth.source} and are not scored.',) \
        if missing else ()
    return replace(result, truth=joints, notes=(*result.notes, *notes),
                   info={**result.info, 'ground_truth': truth.source})


def _read(source: str, bag: str | Path, skeleton: Skeleton) -> Truth:
    if not Path(source).is_file():
        if not source.startswith('/') or '.' in source:
            raise InputError(f'{source}: there is no such file, and it is no topic either, which begins with / and has '
                             'no dot')
        return _read_topic(source, bag, skeleton)
    if Path(source).suffix in ('.bag', '.mcap', '.db3'):
        raise InputError(f'{source}: this is a bag: give a topic of the bag with the images, or an .npz or text file')
    if Path(source).suffix != '.npz':
        return Truth(source, read_text(source, skeleton))
    try:
        with np.load(source) as file:
            if 'frame' in file:
                raise InputError(f'{source}: its rows are hands, and not images, as `hand-pose estimate` writes them: '
                                 'give a row for each image')
            stamps, joints = file.get('stamps_ns'), file['joints'].astype(np.float64)
    except (OSError, *DAMAGE):
        raise InputError(f'{source}: not an .npz file with an array joints (frames, joints, 3) in metres') from None
    return Truth(source, joints, stamps)


def _read_topic(topic: str, bag: str | Path, skeleton: Skeleton) -> Truth:
    # If the bag is damaged, the messages before the damage are read, like the images.
    messages = [message for message in read_hands(bag, topic, partly=True) if len(message.joints)]
    if not messages:
        raise InputError(f'{bag}: {topic} has no hand in any message, so there is nothing to compare with')
    for message in messages:
        if len(message.joints) > 1:
            raise InputError(f'{bag}: {topic} has {len(message.joints)} hands at {message.stamp_ns} ns, but one hand '
                             'an image is evaluated: record one topic for each hand')
        if message.skeleton != skeleton.name:
            raise InputError(f'{bag}: {topic} has joints of {message.skeleton}, but the estimator gives those of '
                             f'{skeleton.name}: take weights for {message.skeleton}')
        check_frame(f'{bag}: {topic}', message.frame_id, messages[0].frame_id)
    return Truth(topic, np.stack([message.joints[0] for message in messages]).astype(np.float64),
                 np.array([message.stamp_ns for message in messages]), messages[0].frame_id)


def _match(stamps: NDArray[np.int64], joints: Joints, result: Result, source: str) -> Joints:
    """The label (J, 3) with the nearest stamp, for each image. NaN if it is too far off, or another image is nearer."""
    assert result.stamps_ns is not None
    order = np.argsort(stamps, kind='stable')
    stamps, joints = stamps[order], joints[order]
    if (same := np.diff(stamps) == 0).any():
        raise InputError(f'{source}: several labels have the stamp {stamps[1:][same][0]} ns, so it is unknown which '
                         'images they belong to: give an .npz file with a label for each image, and no stamps')
    right = np.searchsorted(stamps, result.stamps_ns).clip(1, max(1, len(stamps) - 1))
    candidates = np.stack([right - 1, right.clip(max=len(stamps) - 1)])
    distances = np.abs(stamps[candidates] - result.stamps_ns)
    label, distance = np.take_along_axis(candidates, distances.argmin(0)[None], 0)[0], distances.min(0)
    if distance.min() > TOLERANCE_NS:
        raise InputError(f'{source}: no label is within {TOLERANCE_NS / 1e6:.0f} ms of an image: the nearest is '
                         f'{distance.min() / 1e9:.3f} s away; are the stamps of the same clock?')
    # Of the images that have the same nearest label, the nearest image gets it.
    by_label = np.lexsort((distance, label))
    images = by_label[np.unique(label[by_label], return_index=True)[1]]
    images = images[distance[images] <= TOLERANCE_NS]
    truth = np.full((len(distance), *joints.shape[1:]), np.nan)
    truth[images] = joints[label[images]]
    return truth
