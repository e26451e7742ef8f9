"""What confidence and score promise: joints are held against the surface that was seen, and it against them."""

import numpy as np
import pytest

from hand_pose_ros.scoring import explain, learned
from hand_pose_ros.skeleton import Skeleton

STICK = Skeleton('stick', ('wrist', 'middle_mcp', 'middle_tip'), (-1, 0, 1))
MM = 1 / 150
"""In units of a cube of 0.30 m."""


@pytest.fixture
def patch():
    """A finger of 30 x 120 mm, and an arm as wide from there to the lower edge."""
    surface = np.ones((1, 128, 128), np.float32)
    surface[0, 32:, 58:70] = 0
    return surface


@pytest.fixture
def joints():
    """In the middle of the finger, 9 mm below its surface."""
    return np.array([[0, 0.3, 9 * MM], [0, 0, 9 * MM], [0, -0.45, 9 * MM]])


def judged(patch, joints):
    confidence, score = explain(patch, joints, 0.3, STICK)
    assert confidence.dtype == np.float32 and ((confidence >= 0) & (confidence <= 1)).all() and 0 <= score <= 1
    return confidence, score


def test_joints_inside_what_is_seen_explain_it_but_for_the_arm(patch, joints):
    confidence, score = judged(patch, joints)
    assert confidence == pytest.approx(1) and score == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(('tip', 'expected'), [
    ((15 * MM + 8 * MM, -0.45, 0), 0.61), ((15 * MM + 24 * MM, -0.45, 0), 0.01),  # beside it
    ((0, -0.45, -8 * MM), 0.61), ((0, -0.45, -24 * MM), 0.01),  # before it
    ((0, -0.45, 24 * MM), 1), ((0, -0.45, 30 * MM), 0.5),  # inside, and behind it
    ((0, 1 + 8 * MM, 0), 0.61)])  # where the patch ends and the arm does not
def test_a_joint_that_is_not_below_the_surface_is_less_sure(patch, joints, tip, expected):
    joints[2] = tip
    confidence, _ = judged(patch, joints)
    assert confidence == pytest.approx([1, 1, expected], abs=0.1 if tip[0] else 0.01)


def test_what_no_bone_is_near_lowers_the_score(patch, joints):
    patch[0, 32:83, 96:108] = 0  # another finger, beyond the wrist like the first
    assert judged(patch, joints)[1] == pytest.approx(0.5, abs=0.02)
    patch[0, 32:83, 96:108] = -1  # something before the cube, which is not of the hand
    assert judged(patch, joints)[1] == pytest.approx(1, abs=0.01)


def test_a_bone_explains_nothing_beyond_its_end(patch, joints):
    joints[2] = 0, -0.1, 9 * MM
    assert 0.5 < judged(patch, joints)[1] < 0.8
    joints[2] = joints[1]  # nor does one without length
    assert 0.3 < judged(patch, joints)[1] < 0.6


def test_where_nothing_is_explained_the_score_is_zero(patch, joints):
    assert judged(np.ones_like(patch), joints)[1] == 0
    assert judged(-np.ones_like(patch), joints)[1] == 0
    assert explain(-np.ones_like(patch), joints, 0.3, Skeleton('palm', ('palm', 'root', 'tip'), (-1, 0, 1)))[1] == 0
    assert judged(patch, joints - (0, 1, 0))[1] == 0  # all of it lies behind the wrist


def test_learned_logits_are_probabilities_of_joints_and_of_a_hand():
    confidence, score = learned(np.log([[3, 1 / 3], [1, 1]]), np.log([3, 1e30]))
    assert confidence == pytest.approx(np.array([[0.75, 0.25], [0.5, 0.5]])) and score == pytest.approx([0.375, 0.5])
