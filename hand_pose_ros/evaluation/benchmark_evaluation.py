"""Evaluates weights on the crops of synthetic-test-v1: their errors, and how far their confidence can be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.datasets import joints_in_metres
from hand_pose_ros.datasets.synthetic import seen_centers
from hand_pose_ros.errors import InputError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.evaluation.progress import Progress, silent
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.models.checkpoints import DEFAULT, load_checkpoint
from hand_pose_ros.runtime import make_engine
from hand_pose_ros.scoring import learned
from hand_pose_ros.skeleton import HAND21, get_skeleton
from hand_pose_ros.synthetic import benchmark

NEAR_MM = 20.0
"""A joint is right within this distance. A confidence is the probability of this."""
BINS = np.linspace(0, 1, 11)
"""Limits of the bins of confidence."""
THIRDS = 3
"""Number of groups of frames, by the number of visible joints."""
NOMINAL = Intrinsics(475.0, 475.0, 320.0, 240.0, 640, 480)
"""Intrinsics of results whose frames are from many cameras."""


def evaluate_benchmark(model: str | None = None, device: str = 'auto', frames: int = benchmark.FRAMES,
                       progress: Progress = silent) -> Result:
    """The joints of the frames of synthetic-test-v1 that show a hand. Left hands are mirrored, so the side is given.

    `info` has the errors of joints that the camera sees, those of joints that it does not see, and the errors of frames
    by how many of their joints it sees. For networks with a confidence, it also has:

    - the calibration of the confidence of joints
    - the share of hands whose side is found, from each patch and its mirror image
    - the share of frames with a hand, and of frames without one, that the estimator would report

    Args:
        model: name of weights that ship, or path of a checkpoint; None = the default.
        frames: number of frames, from the first on.

    Raises:
        InputError: the weights are for other joints.
    """
    checkpoint = load_checkpoint(model)
    skeleton = get_skeleton(checkpoint.metadata['skeleton'])
    if skeleton is not HAND21:
        raise InputError(f'{model}: the joints of synthetic-test-v1 are those of hand21, not of {skeleton.name}')
    engine = make_engine(checkpoint.network, device=device, refiner=checkpoint.refiner)
    joints, truth, visible, judged = [], [], [], []
    batch_size = 50
    for batch in progress(benchmark.frames(frames, batch=batch_size), -(-frames // batch_size)):
        answer = engine.run_full(batch['patch'].numpy())
        present = batch['hand_present'].numpy()
        # For a left hand, truth and estimate are those of the mirrored scene.
        cube = seen_centers(batch), batch['cube_side']
        predicted = joints_in_metres(batch['joints'].new_tensor(answer['joints']), *cube).double().numpy()
        expected = joints_in_metres(batch['joints'], *cube).double().numpy()
        joints.append(predicted[present])
        truth.append(expected[present])
        visible.append(batch['visible'].numpy()[present])
        if 'confidence' in answer:
            mirrored = engine.run_full(np.ascontiguousarray(batch['patch'].numpy()[..., ::-1]))
            right = np.linalg.norm(predicted - expected, axis=-1) * 1000 <= NEAR_MM
            judged.append((answer['confidence'], right, answer['hand'], answer['side'] > mirrored['side'], present))
    info = {'model': model or DEFAULT, 'engine': engine.name,
            **_by_visibility(np.concatenate(joints), np.concatenate(truth), np.concatenate(visible))}
    if judged:
        info |= _self_knowledge(*(np.concatenate(parts) for parts in zip(*judged, strict=True)))
    note = 'crops and sides are those of the benchmark; cameras are mixed, the intrinsics are nominal'
    return Result(str(model or DEFAULT), skeleton, NOMINAL,
                  np.concatenate(joints), np.concatenate(truth), notes=(note,), info=info, in_time=False)


def _by_visibility(joints: NDArray[np.float64], truth: NDArray[np.float64],
                   visible: NDArray[np.bool_]) -> dict[str, Any]:
    errors_mm = 1000 * np.linalg.norm(joints - truth, axis=-1)
    seen, count = visible.sum(axis=1), visible.shape[1]

    def errors(of: NDArray[np.bool_]) -> dict[str, float]:
        return {'mean_mm': float(errors_mm[of].mean()), 'median_mm': float(np.median(errors_mm[of]))}

    rows = [([least, most], (seen >= least) & (seen <= most))
            for least, most in ((i * count // THIRDS + min(i, 1), (i + 1) * count // THIRDS) for i in range(THIRDS))]
    return {**{name: {'joints': int(of.sum()), **errors(of)}
               for name, of in (('visible_joints', visible), ('hidden_joints', ~visible)) if of.any()},
            'frames_by_visible_joints': [{'visible': span, 'frames': int(of.sum()), **errors(of)}
                                         for span, of in rows if of.any()]}


def _self_knowledge(confidence: NDArray[np.float32], right: NDArray[np.bool_], hand: NDArray[np.float32],
                    side_found: NDArray[np.bool_], present: NDArray[np.bool_]) -> dict[str, Any]:
    probability, score = learned(confidence, hand)
    probability, right = probability[present], right[present]
    where = np.clip(np.digitize(probability, BINS) - 1, 0, len(BINS) - 2)
    calibration = [{'confidence': [round(float(BINS[i]), 1), round(float(BINS[i + 1]), 1)],
                    'joints': int((where == i).sum()), 'right': round(float(right[where == i].mean()), 3)}
                   for i in range(len(BINS) - 1) if (where == i).any()]

    def share(of: NDArray[np.bool_]) -> float | None:
        return round(float(of.mean()), 4) if of.size else None

    return {'calibration_20_mm': calibration, 'side_found': share(side_found[present]),
            'hands_reported': share(score[present] >= HandPoseEstimator.min_score),
            'no_hands_reported': share(score[~present] >= HandPoseEstimator.min_score)}
