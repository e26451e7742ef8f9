"""The numbers by which hand poses are judged, with their definitions and sources. Only numpy is used.

Joints are (N, J, 3) in metres, for N frames and J joints. A joint that is not finite is missing. If it is missing in
the truth, it was not labelled, and is not scored. If it is missing in the prediction, it was missed. In the table that
`joint_errors_mm` returns, NaN = not scored and inf = missed. There are two rules for all other numbers:

- Averages are over the joints that were predicted. The number of missed joints is reported beside them.
- In curves, a missed joint is a failure at every distance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hand_pose_ros.errors import InputError, counted
from hand_pose_ros.skeleton import FINGERS, Skeleton

Floats = NDArray[np.float64]
WITHIN_MM = (20, 30, 40, 50, 80)
GAP = 1.5
"""A step between two stamps is a gap if it is more than this many times the median step: an image is missing."""


def joint_errors_mm(predictions: ArrayLike, truth: ArrayLike) -> Floats:
    """Euclidean distance of each joint, in the camera frame and unaligned (Oberweger et al. 2015, section 4).

    Args:
        predictions, truth: (N, J, 3) in metres.

    Returns:
        (N, J) in millimetres; NaN = not labelled, inf = labelled but missed.

    Raises:
        InputError: the shapes differ.
    """
    predictions, truth = np.asarray(predictions, np.float64), np.asarray(truth, np.float64)
    if predictions.shape != truth.shape or predictions.ndim != 3 or predictions.shape[-1] != 3:
        raise InputError(f'predictions have the shape {predictions.shape} and the truth {truth.shape}: '
                         'both must be (frames, joints, 3)')
    with np.errstate(invalid='ignore'):  # inf - inf
        errors = 1000 * np.linalg.norm(predictions - truth, axis=-1)
    errors[~np.isfinite(predictions).all(-1)] = np.inf
    errors[~np.isfinite(truth).all(-1)] = np.nan
    return errors


def mean_mm(errors_mm: ArrayLike) -> float:
    """Mean over all joints that were predicted and scored; NaN if there is none.

    All joints have the same weight. So without missing joints, this is also the mean of the means of the frames.
    """
    found = _found(errors_mm)
    return float(found.mean()) if found.size else float('nan')


def median_mm(errors_mm: ArrayLike) -> float:
    """Median over all joints (not frames) that were predicted and scored; NaN if there is none."""
    found = _found(errors_mm)
    return float(np.median(found)) if found.size else float('nan')


def max_mm(errors_mm: ArrayLike) -> float:
    """The largest error of any single joint that was predicted and scored; NaN if there is none."""
    found = _found(errors_mm)
    return float(np.max(found)) if found.size else float('nan')


def frame_means_mm(errors_mm: ArrayLike) -> Floats:
    """Mean of each frame (N,) over its predicted joints; NaN = no joint is labelled, inf = all were missed."""
    errors = np.asarray(errors_mm, np.float64)
    found = np.isfinite(errors)
    count = found.sum(-1)
    means = np.where(found, errors, 0).sum(-1) / np.maximum(count, 1)
    means[count == 0] = np.where(np.isinf(errors[count == 0]).any(-1), np.inf, np.nan)
    return means


def worst_joints_mm(errors_mm: ArrayLike) -> Floats:
    """Error of the worst joint of each frame, (N,); inf = a joint was missed, NaN = no joint is labelled."""
    errors = np.asarray(errors_mm, np.float64)
    labelled = ~np.isnan(errors)
    worst = np.where(labelled, errors, -np.inf).max(-1, initial=-np.inf)
    worst[~labelled.any(-1)] = np.nan
    return worst


def success_curve(errors_mm: ArrayLike, distances_mm: ArrayLike) -> Floats:
    """Fraction (D,) of labelled frames with all joints within each distance (Taylor et al. 2012)."""
    return _fraction_within(worst_joints_mm(errors_mm), distances_mm)


def pck(errors_mm: ArrayLike, distances_mm: ArrayLike) -> Floats:
    """Fraction (D,) of labelled joints within each distance (correct keypoints; Yang & Ramanan 2013)."""
    return _fraction_within(np.asarray(errors_mm, np.float64).ravel(), distances_mm)


def auc(errors_mm: ArrayLike, limit_mm: float = 80) -> float:
    """Area under `success_curve` from 0 to `limit_mm`, divided by the limit. 1 is perfect.

    This is the exact integral of the step curve, mean(max(0, 1 - worst / limit)). The code of DeepPrior averages the
    curve at 0, 1, ... 79 mm instead, which gives 0.005 to 0.006 less.
    """
    worst = worst_joints_mm(errors_mm)
    worst = worst[~np.isnan(worst)]
    return float(np.clip(1 - worst / limit_mm, 0, 1).mean()) if worst.size else float('nan')


def per_joint_mm(errors_mm: ArrayLike) -> Floats:
    """`mean_mm` of each joint, (J,)."""
    return np.array([mean_mm(column) for column in np.asarray(errors_mm, np.float64).T])


def per_finger_mm(errors_mm: ArrayLike, skeleton: Skeleton) -> dict[str, float]:
    """`mean_mm` of the joints of each finger, and of the 'palm', which has all other joints."""
    errors, owner = np.asarray(errors_mm, np.float64), np.array(skeleton.fingers)
    return {name: mean_mm(errors[:, owner == name]) for name in (*FINGERS, 'palm')}


def missed_frames(errors_mm: ArrayLike) -> NDArray[np.bool_]:
    """Labelled frames without a single predicted joint, (N,) bool. The curves count them as failures."""
    return np.isinf(frame_means_mm(errors_mm))


def align_translation(predictions: ArrayLike, truth: ArrayLike) -> Floats:
    """Predictions (N, J, 3), moved in each frame so that the mean of their joints is that of the truth."""
    predictions, truth = np.asarray(predictions, np.float64), np.asarray(truth, np.float64)
    weights = _common(predictions, truth)
    return predictions - _center(predictions, weights) + _center(truth, weights)


def align_rigid(predictions: ArrayLike, truth: ArrayLike) -> Floats:
    """Predictions (N, J, 3), rotated and moved in each frame so that their squared distance to the truth is least.

    They are neither scaled nor mirrored (Kabsch 1976, with the sign of Umeyama 1991). A frame with fewer than three
    joints in common has no unique rotation, and becomes NaN.
    """
    predictions, truth = np.asarray(predictions, np.float64), np.asarray(truth, np.float64)
    weights = _common(predictions, truth)
    center_p, center_t = _center(predictions, weights), _center(truth, weights)
    p = np.where(weights, predictions - center_p, 0)
    t = np.where(weights, truth - center_t, 0)
    u, _, vt = np.linalg.svd(np.swapaxes(p, 1, 2) @ t)
    vt[:, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]  # no reflection
    aligned = (predictions - center_p) @ (u @ vt) + center_t
    aligned[weights.sum((1, 2)) < 3] = np.nan
    return aligned


def jitter_mm(joints: ArrayLike, hands: ArrayLike | None = None, stamps_ns: ArrayLike | None = None) -> float:
    """How much joints shake around a smooth path. It is the RMS length of the second difference over frames, / sqrt(6).

    Uniform motion gives 0. Independent noise with an RMS distance of r gives r, because its second difference has six
    times the variance. Real acceleration counts, too. So if the truth is known, pass predictions - truth. NaN if no
    joint is there in three frames in a row.

    Args:
        joints: (N, J, 3) in metres, consecutive frames.
        hands: (N,) name or number of the hand. Only frames of the same hand are compared. None = it is always the same.
        stamps_ns: (N,) of the frames. No frames are compared across a gap. None = there is no gap.
    """
    joints = np.asarray(joints, np.float64)
    lengths = 1000 * np.linalg.norm(np.diff(joints, n=2, axis=0), axis=-1)
    follows = np.ones(max(0, len(joints) - 1), bool)  # whether a frame can be compared with the one before it
    if hands is not None:
        hands = np.asarray(hands)
        follows &= hands[1:] == hands[:-1]
    if stamps_ns is not None and follows.size:
        steps = np.abs(np.diff(np.asarray(stamps_ns)))
        follows &= steps <= GAP * np.median(steps)
    lengths = lengths[follows[1:] & follows[:-1]]
    lengths = lengths[np.isfinite(lengths)]
    return float(np.sqrt((lengths ** 2).mean() / 6)) if lengths.size else float('nan')


def bone_lengths_mm(joints: ArrayLike, skeleton: Skeleton) -> Floats:
    """Length of each bone in each frame, (N, bones)."""
    joints = np.asarray(joints, np.float64)
    parents, children = np.array(skeleton.bones).T
    return 1000 * np.linalg.norm(joints[:, children] - joints[:, parents], axis=-1)


def bone_drift_mm(joints: ArrayLike, skeleton: Skeleton, hands: ArrayLike | None = None) -> Floats:
    """Standard deviation (bones,) of the length of each bone over time. It is 0 for a real hand.

    With several hands, it is the deviation from the mean of each hand. A bone that no hand has twice has none (NaN).

    Args:
        joints: (N, J, 3) in metres.
        hands: (N,) name or number of the hand. None = it is always the same.
    """
    lengths = bone_lengths_mm(joints, skeleton)
    owners = np.unique(np.zeros(len(lengths)) if hands is None else np.asarray(hands), return_inverse=True)[1]
    drifts = []
    for bone in lengths.T:
        found = np.isfinite(bone)
        values, owner = bone[found], owners[found]
        number = np.bincount(owner)
        means = np.bincount(owner, values) / np.maximum(number, 1)
        off = (values - means[owner])[number[owner] > 1]
        drifts.append(np.sqrt(np.mean(off ** 2)) if off.size else np.nan)
    return np.array(drifts)


def percentiles(values: ArrayLike) -> dict[str, float]:
    """{'mean', 'p50', 'p90', 'p99', 'max'} of the finite values, in their unit. Empty if there is none."""
    found = _found(values)
    if not found.size:
        return {}
    p50, p90, p99 = np.percentile(found, [50, 90, 99])
    return {'mean': float(found.mean()), 'p50': float(p50), 'p90': float(p90), 'p99': float(p99),
            'max': float(np.max(found))}


def paired_bootstrap(a_mm: ArrayLike, b_mm: ArrayLike, *, block: int = 30, resamples: int = 10_000,
                     seed: int = 0) -> tuple[float, float, float]:
    """The difference mean(a) - mean(b) over the same frames, with its 95 % confidence interval.

    This is a circular block bootstrap (Politis & Romano 1992). Neighbouring frames of a video have similar errors. So
    `block` frames in a row are drawn together. With single frames (block = 1), the interval would be too narrow. Frames
    that are missing on either side are left out.

    Args:
        a_mm, b_mm: (N,) error of each frame; NaN or inf = missing.

    Returns:
        (difference, low, high)

    Raises:
        InputError: the lengths differ, or fewer than two frames are common.
    """
    a, b = np.asarray(a_mm, np.float64), np.asarray(b_mm, np.float64)
    if a.shape != b.shape or a.ndim != 1:
        raise InputError(f'results of {a.shape} and {b.shape} frames cannot be compared frame by frame')
    both = np.isfinite(a) & np.isfinite(b)
    difference = a[both] - b[both]
    n = len(difference)
    if n < 2:
        raise InputError(f'both predicted {counted(n, "frames")}: at least 2 are needed to compare them')
    block = max(1, min(block, n // 2))
    sums = np.concatenate([[0], np.cumsum(np.concatenate([difference, difference[:block]]))])
    block_means = (sums[block:block + n] - sums[:n]) / block
    starts = np.random.default_rng(seed).integers(0, n, (resamples, -(-n // block)))
    low, high = np.quantile(block_means[starts].mean(1), [0.025, 0.975])
    return float(difference.mean()), float(low), float(high)


def summarise(predictions: ArrayLike, truth: ArrayLike, skeleton: Skeleton, hands: ArrayLike | None = None,
              stamps_ns: ArrayLike | None = None) -> dict[str, Any]:
    """All numbers of accuracy, by their names in JSON files. NaN becomes None.

    Fractions are of labelled frames (`within_mm`, `auc_0_80`) or of labelled joints (`pck_mm`).

    Args:
        predictions, truth: (N, J, 3) in metres, for the J joints of the skeleton.
        hands, stamps_ns: see `jitter_mm`.

    Raises:
        InputError: the shapes differ, or are those of another skeleton.
    """
    errors = joint_errors_mm(predictions, truth)
    if errors.shape[1] != len(skeleton):
        raise InputError(f'there are {errors.shape[1]} joints, but {skeleton.name} has {len(skeleton)}')
    labelled = ~np.isnan(errors)
    return finite_or_none({
        'frames': int(labelled.any(-1).sum()),
        'missed_frames': int(missed_frames(errors).sum()),
        'missed_joints': int(np.isinf(errors).sum()),
        'mean_mm': mean_mm(errors),
        'median_mm': median_mm(errors),
        'max_mm': max_mm(errors),
        'mean_worst_mm': mean_mm(worst_joints_mm(errors)),
        'per_joint_mm': dict(zip(skeleton.joint_names, per_joint_mm(errors).tolist(), strict=True)),
        'per_finger_mm': per_finger_mm(errors, skeleton),
        'within_mm': dict(zip(map(str, WITHIN_MM), success_curve(errors, WITHIN_MM).tolist(), strict=True)),
        'pck_mm': dict(zip(map(str, WITHIN_MM), pck(errors, WITHIN_MM).tolist(), strict=True)),
        'auc_0_80': auc(errors, 80),
        'mean_translation_aligned_mm': mean_mm(joint_errors_mm(align_translation(predictions, truth), truth)),
        'mean_rigid_aligned_mm': mean_mm(joint_errors_mm(align_rigid(predictions, truth), truth)),
        'error_jitter_mm': jitter_mm(np.asarray(predictions, np.float64) - np.asarray(truth, np.float64), hands,
                                     stamps_ns),
        **smoothness(predictions, skeleton, hands, stamps_ns),
    })


def smoothness(predictions: ArrayLike, skeleton: Skeleton, hands: ArrayLike | None = None,
               stamps_ns: ArrayLike | None = None) -> dict[str, Any]:
    """The numbers that need no truth. They are `jitter_mm`, and the mean of `bone_drift_mm` over the bones."""
    return finite_or_none({'jitter_mm': jitter_mm(predictions, hands, stamps_ns),
                           'bone_drift_mm': mean_mm(bone_drift_mm(predictions, skeleton, hands))})


SMOOTHNESS = ('error_jitter_mm', 'jitter_mm', 'bone_drift_mm')
"""The numbers of `summarise` for which the frames must follow each other in time."""


def finite_or_none(value: Any) -> Any:
    """The value, with None for every NaN or inf in it, because JSON has neither."""
    if isinstance(value, dict):
        return {key: finite_or_none(item) for key, item in value.items()}
    return value if not isinstance(value, float) or np.isfinite(value) else None


def _found(values: ArrayLike) -> Floats:
    array = np.asarray(values, np.float64)
    return array[np.isfinite(array)]


def _fraction_within(errors_mm: Floats, distances_mm: ArrayLike) -> Floats:
    scored = np.sort(errors_mm[~np.isnan(errors_mm)])
    distances = np.asarray(distances_mm, np.float64)
    if not scored.size:
        return np.full(distances.shape, np.nan)
    return np.searchsorted(scored, distances, side='right') / scored.size


def _common(a: Floats, b: Floats) -> NDArray[np.bool_]:
    """Whether both have the joint, (N, J, 1) bool."""
    return np.asarray(np.isfinite(a + b).all(-1, keepdims=True))


def _center(points: Floats, weights: NDArray[np.bool_]) -> Floats:
    """Mean (N, 1, 3) over the joints with weight 1; NaN if there is none."""
    with np.errstate(invalid='ignore'):
        return np.where(weights, points, 0).sum(1, keepdims=True) / weights.sum(1, keepdims=True)
