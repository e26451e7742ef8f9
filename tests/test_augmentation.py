"""What augmentation promises: patch and joints change alike, as much as is said, and each sample in its own way."""

import numpy as np
import pytest
import torch

from hand_pose_ros.datasets import Batch, joints_in_metres
from hand_pose_ros.geometry import Cube, Intrinsics, crop
from hand_pose_ros.training.augmentation import PRESETS, Augmentation, augment

CAMERA = Intrinsics(475, 475, 320, 240, 640, 480)


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depth of a wavy surface along the rays (x, y, 1); nothing beside it."""
    z = 0.5 + 0.04 * np.sin(25 * x) + 0.03 * np.cos(30 * y)
    return np.where((np.abs(x) < 0.25) & (np.abs(y - 0.05) < 0.2), z, 0).astype(np.float32)


def sample(center: tuple[float, float, float] = (0.06, -0.04, 0.5), side: float = 0.3) -> Batch:
    """Four copies of a crop of the scene, with joints on its surface."""
    v, u = np.mgrid[:480, :640]
    cube = Cube(center, side)
    patch = crop(scene((u - 320) / 475, (v - 240) / 475), cube, CAMERA)
    rays = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 2)) + np.array(center[:2]) / center[2]
    rays = rays[np.abs(rays[:, 1] - 0.05) < 0.18]
    z = scene(rays[:, 0], rays[:, 1])
    joints = cube.to_cube(np.stack([rays[:, 0] * z, rays[:, 1] * z, z], axis=1))
    n = 4
    return {'patch': torch.from_numpy(patch).expand(n, 1, 128, 128),
            'joints': torch.from_numpy(joints).float().expand(n, -1, 3),
            'cube_center': torch.tensor(center).expand(n, 3), 'cube_side': torch.full((n,), side),
            'hand_present': torch.ones(n, dtype=torch.bool)}


def test_augmentation_moves_patch_and_joints_alike_and_keeps_the_hand_rigid():
    before = sample()
    strong = Augmentation(rotation_deg=180, jitter=0.008, scale=1.2, mirror=0.5)
    after = augment(before, strong, torch.arange(4), seed=1)
    assert after['mirrored'].any() and not after['mirrored'].all()
    columns, rows = ((after['joints'][..., :2] + 1) * 64 - 0.5).round().long().unbind(-1)
    inside = (columns >= 0) & (columns < 128) & (rows >= 0) & (rows < 128)
    assert inside.float().mean() > 0.8
    seen = after['patch'][torch.arange(4)[:, None], 0, rows.clamp(0, 127), columns.clamp(0, 127)]
    apart = (seen - after['joints'][..., 2]).abs()[inside]
    assert apart.median() < 0.02  # the surface is where the joints on it are, up to a pixel of its slope
    assert apart.max() < 0.1

    metres = [joints_in_metres(b['joints'], b['cube_center'], b['cube_side']) for b in (before, after)]
    torch.testing.assert_close(torch.cdist(metres[1], metres[1]), torch.cdist(metres[0], metres[0]), atol=2e-5, rtol=0)


def test_a_moved_and_scaled_patch_is_the_crop_of_the_moved_and_scaled_cube():
    after = augment(sample(), Augmentation(jitter=0.01, scale=1.2), torch.arange(4), seed=1)
    v, u = np.mgrid[:480, :640]
    depth = scene((u - 320) / 475, (v - 240) / 475)
    for i in range(4):
        cube = Cube(tuple(after['cube_center'][i].tolist()), float(after['cube_side'][i]))
        patch = torch.from_numpy(crop(depth, cube, CAMERA))[0]
        known = torch.ones(128, 128, dtype=torch.bool)
        if cube.side > 0.3:  # what the old cube did not see stays unknown
            border = int(64 * (1 - 0.3 / cube.side)) + 8
            known[:border] = known[-border:] = known[:, :border] = known[:, -border:] = False
        assert ((after['patch'][i, 0] - patch).abs() < 0.1)[known].float().mean() > 0.97
        assert ((after['patch'][i, 0] == 1) == (patch == 1))[known].float().mean() > 0.97


def test_turns_are_to_both_sides_by_degrees():
    batch = {key: value[:1].expand(2000, *value.shape[1:]) for key, value in sample().items() if key != 'patch'}
    x, y, _ = augment(batch, Augmentation(rotation_deg=30), torch.arange(2000), seed=1)['cube_center'].T
    turned = torch.rad2deg(torch.atan2(y, x) - np.arctan2(-0.04, 0.06))
    assert turned.min().item() == pytest.approx(-30, abs=0.2) and turned.max().item() == pytest.approx(30, abs=0.2)


def test_readings_are_disturbed_and_lost_as_much_as_is_said():
    batch = {key: value[:1].expand(400, *value.shape[1:]) for key, value in sample().items()}
    batch['patch'] = torch.zeros(400, 1, 64, 64)
    noisy = augment(batch, Augmentation(noise=0.01, dropout=0.3), torch.arange(400), seed=1)['patch']
    metres = 0.15 * noisy[noisy < 1]
    assert metres.std() == pytest.approx(0.01 / 3 ** 0.5, rel=0.1)  # of deviations from 0 to 0.01
    assert abs(metres.mean()) < 1e-4  # what is lost has been no nearer than the rest
    assert (noisy == 1).float().mean() == pytest.approx(0.15, rel=0.1)
    erased = (augment(batch, Augmentation(erase=0.5), torch.arange(400), seed=1)['patch'] == 1).float().mean((1, 2, 3))
    assert (erased > 0).float().mean() == pytest.approx(0.5, abs=0.1)
    assert 0.015 < erased[erased > 0].min() < 0.03 and 0.17 < erased.max() < 0.21


def test_a_mirrored_patch_is_the_patch_in_the_mirror():
    before = sample()
    after = augment(before, Augmentation(mirror=1.0), torch.arange(4), seed=1)
    torch.testing.assert_close(after['patch'], before['patch'].flip(-1), atol=1e-6, rtol=0)
    torch.testing.assert_close(after['joints'], before['joints'] * torch.tensor([-1.0, 1.0, 1.0]))


def test_a_shift_is_in_metres_and_three_times_as_far_in_the_tail():
    batch = {key: value[:1].expand(2000, *value.shape[1:]) for key, value in sample().items() if key != 'patch'}
    near, far = (augment(batch, Augmentation(jitter=0.01, jitter_tail=tail), torch.arange(2000), seed=1)['cube_center']
                 - batch['cube_center'] for tail in (0.0, 1.0))
    assert near[:, 2].std() == pytest.approx(0.01, rel=0.1)
    torch.testing.assert_close(far, 3 * near, atol=1e-6, rtol=0)


def test_augmentation_depends_on_the_sample_and_not_on_its_neighbours():
    batch, numbers = sample(), torch.tensor([7, 8, 9, 10])
    together = augment(batch, PRESETS['modern'], numbers, seed=5)
    alone = augment({key: value[2:3] for key, value in batch.items()}, PRESETS['modern'], numbers[2:3], seed=5)
    for key, value in alone.items():
        torch.testing.assert_close(value[0], together[key][2], atol=1e-6, rtol=0)
    other = augment(batch, PRESETS['modern'], numbers, seed=6)
    assert not torch.equal(other['joints'], together['joints'])
    later = augment(batch, PRESETS['modern'], numbers + (1 << 20), seed=5)
    assert not torch.equal(other['joints'], later['joints'])


def test_degraded_patches_stay_in_range_and_keep_the_background():
    batch = sample()
    after = augment(batch, Augmentation(noise=0.01, dropout=0.3, erase=1.0), torch.arange(4), seed=1)['patch']
    assert after.min() >= -1 and after.max() <= 1
    assert (after[batch['patch'] == 1] == 1).all()
    lost = ((after == 1) & (batch['patch'] < 1)).float().sum() / (batch['patch'] < 1).sum()
    assert 0.05 < lost < 0.5
    assert torch.equal(augment(batch, Augmentation(), torch.arange(4), seed=1)['patch'], batch['patch'])


def test_deep_prior_pp_changes_one_thing_at_a_time():
    batch = {key: value[:1].expand(300, *value.shape[1:]) for key, value in sample().items() if key != 'patch'}
    after = augment(batch, PRESETS['deep_prior_pp'], torch.arange(300), seed=1)
    moved = (after['cube_center'][:, 2] != batch['cube_center'][:, 2])
    turned = ~moved & (after['joints'] != batch['joints']).any(2).any(1)
    assert 70 < moved.sum() < 130 and 70 < turned.sum() < 130 and (~moved & ~turned).sum() > 70
