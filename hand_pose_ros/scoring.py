"""Confidence of joints and score of hands.

Some networks have learned to judge themselves: their judgement is used (`learned`). The networks of the paper give only
joints, whatever they see. Their joints are compared with the depth image that they came from (`explain`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.skeleton import Skeleton

JOINT_TOLERANCE_M = 0.008
"""Tolerance for a joint beside the silhouette, or in front of the surface: about the radius of a finger."""
FLESH_M = 0.025
"""A joint that is further than this behind the surface is hidden by something other than its own flesh."""
HIDDEN_CONFIDENCE = 0.5
"""Confidence of a joint without evidence for or against it."""
REACH_M = 0.022
"""The skeleton does not explain surface that is further than this from every bone."""


def learned(confidence: NDArray[np.float32], hand: NDArray[np.float32],
            ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Confidence of each joint (N, J) and score (N,), from the logits of a network for N patches.

    The score is the expected share of joints that are right: the probability that this is a hand, times the mean
    confidence of its joints. Each of the two alone would accept objects that the other rejects.
    """
    confidence, hand = _sigmoid(confidence), _sigmoid(hand)
    return confidence, hand * confidence.mean(axis=1)


def _sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    half = np.float32(0.5)
    return half + half * np.tanh(half * logits)


def explain(patch: NDArray[np.float32], joints: NDArray[np.floating], side: float,
            skeleton: Skeleton) -> tuple[NDArray[np.float32], float]:
    """Confidence of each joint (J,) and score of the hand, both in [0, 1].

    A joint should be inside the hand: on the silhouette and behind the visible surface. And the skeleton of a hand
    should explain most of the surface, except that of the forearm beyond the wrist. The score is the mean confidence
    times the share of the surface that is explained.

    Args:
        patch: (1, S, S) in [-1, 1].
        joints: (J, 3) in cube units.
        side: of the cube, metres.
    """
    surface = patch[0]
    size, half = surface.shape[0], side / 2
    seen = surface < 1
    if not seen.any():
        return np.zeros(len(joints), np.float32), 0.0
    column, row = np.clip(((joints[:, :2] + 1) * size / 2 - 0.5).round().astype(int), 0, size - 1).T
    beside = cv2.distanceTransform((~seen).view(np.uint8), cv2.DIST_L2, 3)[row, column] * side / size
    outside = np.maximum(np.abs(joints[:, :2]).max(axis=1) - 1, 0) * half
    behind = np.where(beside > 0, 0, joints[:, 2] - surface[row, column]) * half
    miss = np.hypot(beside + outside, np.maximum(-behind, 0)) / JOINT_TOLERANCE_M
    confidence = np.exp(-0.5 * miss ** 2) * np.where(behind > FLESH_M, HIDDEN_CONFIDENCE, 1)
    score = confidence.mean() * _explained(surface, joints, half, skeleton)
    return confidence.astype(np.float32), float(score)


def _explained(surface: NDArray[np.float32], joints: NDArray[np.floating], half: float, skeleton: Skeleton) -> float:
    """Share of the visible surface within reach of a bone, without the forearm."""
    some = surface[::2, ::2]  # every other row and column is enough
    rows, columns = (2 * index for index in np.nonzero((some < 1) & (some > -1)))
    scale = 2 / surface.shape[0]
    points = np.stack([(columns + 0.5) * scale - 1, (rows + 0.5) * scale - 1, surface[rows, columns]], dtype=np.float32)
    joints = joints.astype(np.float32)
    if {'wrist', 'middle_mcp'} <= set(skeleton.joint_names):
        wrist, knuckle = (joints[skeleton.joint_names.index(name)] for name in ('wrist', 'middle_mcp'))
        points = points[:, (knuckle - wrist) @ points > (knuckle - wrist) @ wrist]
    if points.shape[1] == 0:
        return 0.0
    parents, children = np.array(skeleton.bones).T
    start, bone = joints[parents], joints[children] - joints[parents]
    # |p - (a + t b)|^2 for all bones and points, with t clamped to the bone, computed from dot products only.
    along = bone @ points - (start * bone).sum(1, keepdims=True)
    length2 = np.maximum((bone ** 2).sum(1, keepdims=True), 1e-12)
    t = np.clip(along / length2, 0, 1)
    from_start2 = (points ** 2).sum(0) - 2 * start @ points + (start ** 2).sum(1, keepdims=True)
    distance2 = from_start2 - t * (2 * along - t * length2)
    return float((distance2.min(axis=0) < (REACH_M / half) ** 2).mean())
