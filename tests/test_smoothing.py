"""The 1 euro filter: what it promises at rest and in motion."""

import numpy as np
import pytest

from hand_pose_ros.smoothing import OneEuroFilter

DT = 1 / 30


def test_noise_at_rest_is_quietened():
    noise = np.random.default_rng(0).normal(0, 0.001, (300, 21, 3))
    smooth = OneEuroFilter(1.0)
    filtered = np.stack([smooth(points, DT) for points in noise])
    assert filtered[60:].std() < 0.5 * noise.std()


def test_a_fast_hand_is_followed_closely():
    """At 1 m/s the lag is below one frame's movement and a half."""
    smooth = OneEuroFilter(1.0)
    for i in range(60):
        truth = np.array([[i * DT, 0, 0.5]])
        filtered = smooth(truth, DT)
    assert np.abs(filtered - truth).max() < 1.5 * DT


def test_the_first_value_and_a_jump_back_in_time_are_taken_as_they_are():
    smooth = OneEuroFilter(1.0)
    assert smooth(np.ones((2, 3)), DT) == pytest.approx(np.ones((2, 3)))
    assert smooth(np.zeros((2, 3)), -5.0) == pytest.approx(np.zeros((2, 3)))


def test_each_joint_is_filtered_by_its_own_speed():
    smooth = OneEuroFilter(1.0)
    for i in range(30):
        filtered = smooth(np.array([[i * DT, 0, 0.5], [0, 0, 0.5]]), DT)
    assert filtered[1] == pytest.approx([0, 0, 0.5], abs=1e-12)
