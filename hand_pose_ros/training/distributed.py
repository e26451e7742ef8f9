"""Several processes, GPUs or nodes: torchrun starts them, DistributedDataParallel averages their gradients."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist


@contextmanager
def process_group(device: str) -> Iterator[None]:
    """Join the processes that torchrun started, if it did."""
    if 'RANK' not in os.environ:
        yield
        return
    if device == 'cuda':
        torch.cuda.set_device(int(os.environ['LOCAL_RANK']))
    dist.init_process_group('nccl' if device == 'cuda' else 'gloo')
    try:
        yield
        dist.barrier()  # the first process validates alone at the end: nobody takes the group down under its feet
    finally:
        dist.destroy_process_group()
