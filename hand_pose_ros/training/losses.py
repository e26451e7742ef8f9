"""What training minimises.

Every loss is a mean over the whole batch. Samples that do not count add zero. So the mean over several processes is the
loss of one process with all their samples.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

Terms = dict[str, Tensor]
"""Scalars by name. Their sum is minimised."""


def joint_loss(kind: str, knee: float, joints: Tensor, truth: Tensor, counts: Tensor) -> Tensor:
    """Loss of the joints of a batch.

    Args:
        kind: one of these.

            - 'huber': Huber loss of the distance of each joint, summed over the joints (paper). The sum is our reading:
              with the mean, the paper's learning rate hardly moves a network.
            - 'squared': squared error, summed over all coordinates (original code). The original regresses the
              coefficients of the prior instead. The two differ by a constant, because the components are orthonormal
              and stay fixed.
            - 'smooth_l1': mean over all coordinates.
        knee: error in cube units from which huber and smooth_l1 grow linearly.
        joints, truth: (B, J, 3) in cube units.
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
