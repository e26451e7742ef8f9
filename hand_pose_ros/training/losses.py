"""What training minimises. Every loss is a mean over the *whole* batch: samples that do not count add zero, so the
mean over several processes is the loss of one process with all their samples.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

Terms = dict[str, Tensor]
"""Scalars by name; their sum is minimised."""


def joint_loss(kind: str, knee: float, joints: Tensor, truth: Tensor, counts: Tensor) -> Tensor:
    """Loss of the joints of a batch.

    Args:
        kind: 'huber' of the distance of each joint, summed over the joints (paper; the sum is our reading: with
            their mean the paper's learning rate hardly moves a network);
            'squared', summed over all coordinates (original code: it regresses the coefficients of the prior, and the
            two differ by a constant because the components are orthonormal and stay fixed);
            'smooth_l1', mean over all coordinates.
        knee: where huber and smooth_l1 go over from squared to linear, cube units.
        joints: (B, J, 3); `truth` likewise, cube units.
        counts: (B,) bool, the samples that count.
    """
    if kind == 'huber':
        distance = torch.sqrt((joints - truth).square().sum(-1) + 1e-12)  # the root has no gradient at 0
        loss = F.huber_loss(distance, torch.zeros_like(distance), reduction='none', delta=knee).sum(-1)
    elif kind == 'squared':
        loss = (joints - truth).square().sum((-2, -1))
    else:
        loss = F.smooth_l1_loss(joints, truth, reduction='none', beta=knee).mean((-2, -1))
    return (loss * counts).mean()
