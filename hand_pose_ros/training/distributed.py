"""Training in several processes. torchrun starts them, and DistributedDataParallel averages their gradients."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist

from hand_pose_ros.runtime import check_device


@contextmanager
def process_group(device: str) -> Iterator[str]:
    """Join the processes that torchrun started, if it did. Gives the device of this process: of GPUs, one of its own.

    Raises:
        HandPoseError: there is no GPU for this process.
    """
    if 'RANK' not in os.environ:
        yield device
        return
    if device.startswith('cuda'):
        device = f'cuda:{os.environ["LOCAL_RANK"]}'
        check_device(device)
        torch.cuda.set_device(device)
    # The others wait while the first process validates, or another machine makes samples: by default, 10 minutes.
    dist.init_process_group('nccl' if device.startswith('cuda') else 'gloo', timeout=timedelta(days=7))
    try:
        yield device
        dist.barrier()  # the first process validates alone at the end, and the others must not end the group before
    finally:
        dist.destroy_process_group()
