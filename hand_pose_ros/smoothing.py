"""The 1 euro filter: steady while the hand rests, quick while it moves (Casiez, Roussel, Vogel 2012)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

DERIVATIVE_CUTOFF_HZ = 1.0
"""Cutoff of the low-pass filter on the speed, as in the paper."""


class OneEuroFilter:
    """A low-pass filter. Its cutoff grows with the speed of the points.

    Args:
        cutoff_hz: cutoff at rest; lower is steadier.
        gain: the cutoff grows by this many Hz per metre per second; higher lags less.
    """

    def __init__(self, cutoff_hz: float, gain: float = 30.0) -> None:
        self.cutoff_hz, self.gain = cutoff_hz, gain
        self._value: NDArray[np.float64] | None = None
        self._speed: NDArray[np.float64] = np.zeros(())

    def __call__(self, value: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Filter points (..., 3) in metres, `dt` seconds after the last ones. Each point has its own speed.

        If no time has passed, or time went back, the filter starts again with these points.
        """
        last = self._value
        if last is None or dt <= 0:
            self._value, self._speed = value, np.zeros((*value.shape[:-1], 1))
            return value
        speed = np.linalg.norm(value - last, axis=-1, keepdims=True) / dt
        self._speed = self._speed + _share(DERIVATIVE_CUTOFF_HZ, dt) * (speed - self._speed)
        filtered: NDArray[np.float64] = last + _share(self.cutoff_hz + self.gain * self._speed, dt) * (value - last)
        self._value = filtered
        return filtered


def _share(cutoff_hz: NDArray[np.float64] | float, dt: float) -> NDArray[np.float64] | float:
    """The weight of the new value in a first-order low-pass filter."""
    rate = 2 * math.pi * cutoff_hz * dt
    return rate / (rate + 1)
