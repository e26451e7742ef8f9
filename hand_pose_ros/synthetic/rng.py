"""Random numbers that depend on the sample and on nothing else.

A generator of `torch` gives sample 7 of a batch of 8 other numbers than sample 7 of a batch of 64. Here every number is
a hash of (seed of the sample, number of the call, index of the element), so a sample is the same in any batch, on CPU
and on GPU.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def _signed32(value: int) -> int:
    value &= 0xFFFFFFFF
    return value - (1 << 32) if value >= 1 << 31 else value


def _mix(x: Tensor) -> Tensor:
    """A good 32-bit integer hash (the finaliser 'lowbias32' of C. Wellons), on int32 with wrap-around."""
    x = x ^ ((x >> 16) & 0xFFFF)
    x = x * 0x7FEB352D
    x = x ^ ((x >> 15) & 0x1FFFF)
    x = x * _signed32(0x846CA68B)
    return x ^ ((x >> 16) & 0xFFFF)


class Random:
    """One independent stream of random numbers for each sample of a batch.

    Args:
        seeds: (B,) integer tensor; equal seeds give equal numbers, wherever they stand in a batch.
    """

    def __init__(self, seeds: Tensor) -> None:
        low, high = seeds.to(torch.int64) & 0xFFFFFFFF, (seeds.to(torch.int64) >> 32) & 0xFFFFFFFF
        to32 = lambda t: torch.where(t >= 1 << 31, t - (1 << 32), t).to(torch.int32)  # noqa: E731
        self._key = _mix(to32(low) ^ _mix(to32(high) + 0x3C6EF372))
        self._calls = 0

    def __len__(self) -> int:
        return len(self._key)

    @property
    def device(self) -> torch.device:
        return self._key.device

    def fork(self, stream: int) -> Random:
        """Independent streams for another purpose, so that draws of one part do not shift those of another part."""
        child = object.__new__(Random)
        child._key = _mix(self._key ^ _signed32(0x9E3779B9 * (stream + 1)))
        child._calls = 0
        return child

    def _bits(self, shape: tuple[int, ...]) -> Tensor:
        self._calls += 1
        key = _mix(self._key + _signed32(self._calls * 0x632BE5AB))
        index = torch.arange(math.prod(shape), dtype=torch.int32, device=self.device)
        # Two rounds: one alone leaves the sequences of neighbouring keys correlated.
        return _mix(_mix(index[None] + key[:, None]) ^ key[:, None]).reshape(len(self), *shape)

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """(B, *shape) float32, uniform in [low, high)."""
        return (((self._bits(shape) >> 8) & 0xFFFFFF).to(torch.float32) * (2.0 ** -24)) * (high - low) + low

    def normal(self, *shape: int, std: float = 1.0) -> Tensor:
        """(B, *shape) float32, normal with mean 0 (Box-Muller)."""
        radius = torch.sqrt(-2 * torch.log(self.uniform(*shape) + 2.0 ** -25))
        return radius * torch.cos(2 * math.pi * self.uniform(*shape)) * std

    def chance(self, probability: float, *shape: int) -> Tensor:
        """(B, *shape) bool, true with this probability."""
        return self.uniform(*shape) < probability

    def choice(self, weights: Tensor) -> Tensor:
        """(B,) int64 index drawn with probabilities proportional to `weights` (K,)."""
        edges = torch.cumsum(weights.to(self.device, torch.float32) / weights.sum(), 0)[:-1]
        return torch.bucketize(self.uniform(), edges, right=True)
