"""The 1 euro filter: what it promises at rest and in motion."""

import numpy as np
import pytest

from hand_pose_ros.smoothing import OneEuroFilter

DT = 1 / 30


def test_noise_at_rest_is_quietened():
    noise = np.random.default_rng(0).normal(0, 0.001, (300, 21, 3))
    smooth = OneEuroFilter(1.0)
    filtered = np.stack([smooth(points, DT) for points in noise])
    assert filtered[60:].std() < 0.48 * noise.std()


def test_a_fast_hand_is_followed_closely():
    """At 1 m/s the lag is below half of one frame's movement, and soon below a fifth."""
    smooth, lags = OneEuroFilter(1.0), []
    for i in range(60):
        truth = np.array([[i * DT, 0, 0.5]])
        lags.append(np.abs(smooth(truth, DT) - truth).max())
    assert max(lags) < 0.5 * DT and lags[-1] < 0.2 * DT


def test_at_rest_the_cutoff_is_a_frequency_in_hertz():
    """What moves as often is quietened to 71 %, as a filter of first order does."""
    smooth = OneEuroFilter(1.0, gain=0)
    filtered = [smooth(np.array([[np.sin(2 * np.pi * i / 300), 0, 0]]), 1 / 300)[0, 0] for i in range(600)]
    assert max(filtered[300:]) == pytest.approx(0.5 ** 0.5, abs=0.01)


def test_the_first_value_and_a_jump_back_in_time_are_taken_as_they_are():
    smooth = OneEuroFilter(1.0)
    assert smooth(np.ones((2, 3)), DT) == pytest.approx(np.ones((2, 3)))
    smooth(2 * np.ones((2, 3)), DT)
    assert smooth(np.zeros((2, 3)), -5.0) == pytest.approx(np.zeros((2, 3)))
    fresh = OneEuroFilter(1.0)  # of the speed before nothing is left either
    fresh(np.zeros((2, 3)), DT)
    np.testing.assert_array_equal(smooth(np.full((2, 3), 0.01), DT), fresh(np.full((2, 3), 0.01), DT))


def test_each_joint_is_filtered_by_its_own_speed():
    smooth = OneEuroFilter(1.0)
    for i in range(30):
        filtered = smooth(np.array([[i * DT, 0, 0.5], [0, 0, 0.5]]), DT)
    assert filtered[1] == pytest.approx([0, 0, 0.5], abs=1e-12)
