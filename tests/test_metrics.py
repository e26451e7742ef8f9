"""Metrics against cases worked out by hand, and against what must hold for any data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hand_pose_ros.errors import InputError
from hand_pose_ros.evaluation import metrics
from hand_pose_ros.skeleton import HAND21, SKELETONS

NAN, INF = np.nan, np.inf


def test_errors_of_a_hand_worked_case():
    truth = np.zeros((2, 2, 3))
    predictions = np.array([[[0.003, 0.004, 0], [0, 0, 0.01]], [[0, 0, 0.02], [0.09, 0, 0]]])
    errors = metrics.joint_errors_mm(predictions, truth)
    assert errors == pytest.approx(np.array([[5, 10], [20, 90]]))
    assert metrics.mean_mm(errors) == pytest.approx(31.25)
    assert metrics.median_mm(errors) == pytest.approx(15)
    assert metrics.max_mm(errors) == pytest.approx(90)
    assert metrics.frame_means_mm(errors) == pytest.approx([7.5, 55])
    assert metrics.worst_joints_mm(errors) == pytest.approx([10, 90])
    assert metrics.per_joint_mm(errors) == pytest.approx([12.5, 50])


def test_curves_of_a_hand_worked_case():
    errors = np.array([[5.0, 10], [20, 90]])
    assert metrics.success_curve(errors, [9.9, 10, 89, 90]).tolist() == [0, 0.5, 0.5, 1]
    assert metrics.pck(errors, [5, 10, 20, 90]).tolist() == [0.25, 0.5, 0.75, 1]
    # One frame succeeds from 10 mm on, the other never: (70 / 80 + 0) / 2.
    assert metrics.auc(errors, 80) == pytest.approx(0.4375)


def test_missing_predictions_fail_and_unlabelled_joints_do_not_count():
    truth = np.zeros((4, 2, 3))
    truth[2, 1] = NAN  # one joint not labelled
    truth[3] = NAN  # a frame not labelled
    predictions = np.full((4, 2, 3), [0.003, 0.004, 0])
    predictions[0, 1] = NAN  # one joint missed
    predictions[1, 0] = INF  # a frame missed
    predictions[1, 1, 2] = NAN
    errors = metrics.joint_errors_mm(predictions, truth)
    assert np.array_equal(errors, [[5, INF], [INF, INF], [5, NAN], [NAN, NAN]], equal_nan=True)
    assert metrics.mean_mm(errors) == pytest.approx(5)
    assert metrics.missed_frames(errors).tolist() == [False, True, False, False]
    assert metrics.success_curve(errors, [1e9]).tolist() == pytest.approx([1 / 3])
    assert metrics.pck(errors, [1e9]).tolist() == pytest.approx([2 / 5])
    assert metrics.auc(errors, 80) == pytest.approx((0 + 0 + 75 / 80) / 3)


def test_the_summary_of_a_hand_worked_case():
    truth = np.random.default_rng(5).normal(0, 0.1, (4, 21, 3))
    truth[3, 20] = NAN
    predictions = truth @ Rotation.from_euler('z', 90, degrees=True).as_matrix()
    predictions[:2] = truth[:2] + np.array([0.027, 0, 0.036])  # 45 mm
    predictions[1, 4], predictions[2] = truth[1, 4], NAN
    summary = metrics.summarise(predictions, truth, HAND21)
    assert (summary['frames'], summary['missed_frames'], summary['missed_joints']) == (4, 1, 21)
    assert summary['pck_mm']['20'] == pytest.approx(1 / 83) and summary['within_mm']['20'] == 0
    assert summary['within_mm']['50'] == pytest.approx(2 / 4)
    assert summary['mean_rigid_aligned_mm'] < 5 < 20 < summary['mean_translation_aligned_mm']
    assert summary['error_jitter_mm'] is None, 'no three frames in a row have a hand'
    constant = metrics.summarise(truth[:3] + 0.01, truth[:3], HAND21)
    assert constant['error_jitter_mm'] == pytest.approx(0, abs=1e-9) and constant['jitter_mm'] > 10
    assert metrics.finite_or_none({'a': [1.5], 'b': INF, 'c': {'d': NAN}}) == {'a': [1.5], 'b': None, 'c': {'d': None}}
    assert metrics.percentiles([*range(101), INF]) == {'mean': 50, 'p50': 50, 'p90': 90, 'p99': 99, 'max': 100}


def test_nothing_labelled_gives_nan_and_none_not_a_number():
    empty = np.full((2, 21, 3), NAN)
    summary = metrics.summarise(np.zeros((2, 21, 3)), empty, HAND21)
    assert summary['frames'] == 0 and summary['mean_mm'] is None and summary['auc_0_80'] is None
    assert summary['within_mm'] == dict.fromkeys(('20', '30', '40', '50', '80'))


def test_wrong_shapes_are_refused():
    with pytest.raises(InputError, match=r'\(2, 14, 3\).*\(2, 16, 3\)'):
        metrics.joint_errors_mm(np.zeros((2, 14, 3)), np.zeros((2, 16, 3)))
    with pytest.raises(InputError, match='there are 14 joints, but hand21 has 21'):
        metrics.summarise(np.zeros((2, 14, 3)), np.zeros((2, 14, 3)), HAND21)
    with pytest.raises(InputError, match='there are 22 joints, but hand21 has 21'):
        metrics.summarise(np.zeros((2, 22, 3)), np.zeros((2, 22, 3)), HAND21)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_alignment_removes_exactly_what_it_says(seed):
    rng = np.random.default_rng(seed)
    truth = rng.normal(0, 0.1, (3, 14, 3)) + np.array([0, 0, 0.6])
    rotation = Rotation.random(3, random_state=seed % 2**31).as_matrix()
    shift = rng.normal(0, 0.2, (3, 1, 3))
    turned = truth @ rotation + shift
    assert metrics.align_translation(truth + shift, truth) == pytest.approx(truth)
    assert metrics.align_rigid(turned, truth) == pytest.approx(truth)
    mirrored = truth * [-1, 1, 1]
    assert metrics.mean_mm(metrics.joint_errors_mm(metrics.align_rigid(mirrored, truth), truth)) > 10
    noisy = turned + rng.normal(0, 0.01, truth.shape)
    raw, moved, rigid = (metrics.joint_errors_mm(p, truth) for p in (
        noisy, metrics.align_translation(noisy, truth), metrics.align_rigid(noisy, truth)))
    assert (raw**2).sum() >= (moved**2).sum() >= (rigid**2).sum()


def test_alignment_ignores_missing_joints():
    truth = np.random.default_rng(0).normal(0, 0.1, (2, 6, 3))
    predictions = truth + np.array([0.01, 0, 0.02])
    predictions[0, 2] = NAN
    predictions[1, 2:] = NAN
    truth[0, 5] = NAN
    moved = metrics.joint_errors_mm(metrics.align_translation(predictions, truth), truth)
    assert np.isinf(moved[0, 2]) and moved[np.isfinite(moved)] == pytest.approx(0, abs=1e-9)
    rigid = metrics.joint_errors_mm(metrics.align_rigid(predictions, truth), truth)
    assert rigid[0, [0, 1, 3, 4]] == pytest.approx(0, abs=1e-9)
    assert np.isinf(rigid[1]).all(), 'two points do not fix a rotation'
    predictions[1, 2] = truth[1, 2] + np.array([0.01, 0, 0.02])
    rigid = metrics.joint_errors_mm(metrics.align_rigid(predictions, truth), truth)
    assert rigid[1, :3] == pytest.approx(0, abs=1e-9), 'three do'


def test_jitter_is_the_size_of_noise_and_zero_for_smooth_motion():
    time = np.arange(4000)[:, None, None]
    moving = time * np.array([0.001, 0.002, -0.0005]) + np.zeros((1, 21, 1))
    assert metrics.jitter_mm(moving) == pytest.approx(0, abs=1e-6)
    noise = np.random.default_rng(1).normal(0, 0.002, moving.shape)  # RMS distance 2 mm x sqrt(3)
    assert metrics.jitter_mm(moving + noise) == pytest.approx(2 * np.sqrt(3), rel=0.02)
    gap = moving + noise
    gap[::2] = NAN
    assert np.isnan(metrics.jitter_mm(gap)), 'no three consecutive frames'


def test_jitter_compares_frames_of_one_hand():
    joints = np.zeros((8, 21, 3))
    joints[4:] += 0.5  # another hand
    assert metrics.jitter_mm(joints) > 100
    assert metrics.jitter_mm(joints, ['a'] * 4 + ['b'] * 4) == 0
    assert np.isnan(metrics.jitter_mm(joints, list('aabbccdd'))), 'no three frames of one hand'
    assert np.isnan(metrics.jitter_mm(joints[:1], ['a']))


def test_jitter_does_not_cross_a_gap():
    """Of a hand that moves at one speed, images are missing: it is far away after the gap, and has not shaken."""
    moving = np.arange(60)[:, None, None] * np.array([0.02, 0, 0]) + np.zeros((1, 21, 1))
    stamps = np.arange(60) * 33_000_000 + np.random.default_rng(0).integers(-4_000_000, 4_000_000, 60)
    for missing in ([20], [20, 40], range(20, 40)):
        joints, left = (np.delete(values, missing, axis=0) for values in (moving, stamps))
        assert metrics.jitter_mm(joints) > 1
        assert metrics.jitter_mm(joints, stamps_ns=left) == pytest.approx(0, abs=1e-6)
        summary = metrics.summarise(joints, np.zeros_like(joints), HAND21, stamps_ns=left)
        assert summary['jitter_mm'] == summary['error_jitter_mm'] == pytest.approx(0, abs=1e-6)
    shaken = np.delete(moving, 20, axis=0) + np.random.default_rng(1).normal(0, 0.002, (59, 21, 3))
    assert metrics.jitter_mm(shaken, stamps_ns=np.delete(stamps, 20)) == pytest.approx(2 * np.sqrt(3), rel=0.1)
    for same in np.zeros(60, int), np.arange(60):  # no stamps, or another unit: there is no gap
        assert metrics.jitter_mm(moving + 1, stamps_ns=same) == pytest.approx(0, abs=1e-6)
    for few in range(3):
        assert np.isnan(metrics.jitter_mm(moving[:few], stamps_ns=stamps[:few]))


def test_bone_drift_of_a_hand_worked_case():
    skeleton = SKELETONS['icvl16']
    joints = np.zeros((2, 16, 3))
    joints[:, 3, 0] = 0.03, 0.05  # thumb tip: its bone is 30, then 50 mm long
    drift = metrics.bone_drift_mm(joints, skeleton)
    assert drift[2] == pytest.approx(10) and np.delete(drift, 2) == pytest.approx(0)
    assert metrics.smoothness(joints, skeleton)['bone_drift_mm'] == pytest.approx(10 / 15)


def test_bones_of_different_hands_do_not_drift():
    skeleton = SKELETONS['icvl16']
    joints = np.zeros((7, 16, 3))
    joints[:, 3, 0] = 0.03, 0.05, 0.08, 0.08, NAN, 0.05, 0.2  # thumb tip
    hands = ['a', 'a', 'b', 'b', 'b', 'a', 'c']  # the third is seen once, which tells no change
    drift = metrics.bone_drift_mm(joints, skeleton, hands)
    off = np.array([30, 50, 50]) - 130 / 3
    assert drift[2] == pytest.approx(np.sqrt((off ** 2).sum() / 5)) and np.delete(drift, 2) == pytest.approx(0)
    assert metrics.smoothness(joints, skeleton, list('abcdefg'))['bone_drift_mm'] is None, 'no hand is seen twice'


def test_fingers_are_averaged_over_their_own_joints():
    errors = np.tile(np.arange(21.0), (3, 1))
    fingers = metrics.per_finger_mm(errors, HAND21)
    assert fingers == pytest.approx(
        {'thumb': 2.5, 'index': 6.5, 'middle': 10.5, 'ring': 14.5, 'pinky': 18.5, 'palm': 0})


def test_bootstrap_interval_covers_the_true_difference_as_often_as_it_says():
    rng, hits = np.random.default_rng(2), 0
    for trial in range(200):
        common = rng.normal(20, 8, 300)  # hard frames are hard for both: pairing must remove this
        a, b = common + rng.normal(1, 2, 300), common + rng.normal(0, 2, 300)
        difference, low, high = metrics.paired_bootstrap(a, b, block=1, resamples=400, seed=trial)
        assert low < difference < high and high - low < 1.2
        hits += low <= 1 <= high
    assert 180 <= hits <= 199


def test_bootstrap_in_blocks_is_wider_where_neighbours_err_alike():
    slow = np.repeat(np.random.default_rng(3).normal(0, 5, 50), 30)
    single = metrics.paired_bootstrap(slow, np.zeros(1500), block=1)
    blocks = metrics.paired_bootstrap(slow, np.zeros(1500), block=30)
    assert single[0] == blocks[0] == pytest.approx(slow.mean())
    assert blocks[2] - blocks[1] > 3 * (single[2] - single[1])
    _, low, high = metrics.paired_bootstrap(slow[:40], np.zeros(40), block=10**6)
    assert high - low > 1, 'of a few frames, too, there are several blocks'


def test_bootstrap_leaves_out_frames_that_one_side_lacks():
    a, b = np.array([1.0, NAN, 3, 5, 2]), np.array([0.0, 9, 1, INF, 1])
    assert metrics.paired_bootstrap(a, b)[0] == pytest.approx((1 + 2 + 1) / 3)
    with pytest.raises(InputError, match='both predicted 1 frame: at least 2'):
        metrics.paired_bootstrap(a[:2], b[:2])
