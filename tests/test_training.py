"""Training learns, can be stopped and continued anywhere, and gives the same result on any number of processes."""

import copy
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from hand_pose_ros.bags import BagWriter
from hand_pose_ros.cli import main
from hand_pose_ros.cli.experiment import NAMES
from hand_pose_ros.datasets import Batch, Dataset, icvl, joints_in_metres, open_dataset
from hand_pose_ros.datasets.shards import MemoryShards
from hand_pose_ros.errors import CheckpointError, HandPoseError, TrainingError
from hand_pose_ros.geometry import Cube, Intrinsics, crop
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import load_checkpoint, save_checkpoint
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.models.two_looks import ZOOM
from hand_pose_ros.skeleton import HAND21, SKELETONS, Skeleton, get_skeleton
from hand_pose_ros.training import experiments
from hand_pose_ros.training.augmentation import PRESETS, Augmentation, augment
from hand_pose_ros.training.folder import RunFolder
from hand_pose_ros.training.gradients import Gradients
from hand_pose_ros.training.loop import Machine, Run
from hand_pose_ros.training.losses import joint_loss
from hand_pose_ros.training.objectives import objective_for
from hand_pose_ros.training.optimizers import learning_rate, make_optimizer, orthogonal
from hand_pose_ros.training.recipes import RECIPES, get_recipe, recipe_from_dict, recipe_to_dict
from hand_pose_ros.training.state import load_progress, save_tensors
from hand_pose_ros.training.stream import SampleStream
from hand_pose_ros.training.validation import some_samples

TINY = ('dataset=icvl', 'network=shallow', 'options.bottleneck=8', 'batch_size=4', 'shard_size=4', 'val_every=40',
        'samples=96')


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """A small dataset in ICVL's format, whose joints are discs in space."""
    root = tmp_path_factory.mktemp('icvl')
    rng = np.random.default_rng(0)
    lines = []
    for i in range(26):
        sequence = '201403121135' if i < 16 else '201405151126' if i < 20 else 'test_seq_1' if i < 23 else 'test_seq_2'
        name = f'{sequence}/image_{i:04d}.png'
        joints = np.array([0, 0, 0.4]) + rng.uniform(-0.06, 0.06, (16, 3))
        v, u = np.mgrid[:240, :320]
        depth = np.zeros((240, 320))
        for x, y, z in sorted(joints.tolist(), key=lambda joint: -joint[2]):
            inside = (u - 160 - 241.42 * x / z) ** 2 + (v - 120 - 241.42 * y / z) ** 2 < 36
            depth[inside] = 1000 * z
        (root / 'Depth' / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / 'Depth' / name), depth.round().astype(np.uint16))
        uv = icvl.INTRINSICS.project(joints)
        lines.append(name + ''.join(f' {a:.4f} {b:.4f} {1000 * z:.4f}' for (a, b), z in
                                    zip(uv, joints[:, 2], strict=True)))
    for file, part in (('labels', slice(20)), ('test_seq_1', slice(20, 23)), ('test_seq_2', slice(23, 26))):
        (root / f'{file}.txt').write_text('\n'.join(lines[part]))
    return root


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def tiny(folder: Path, *overrides: str, recipe: str = 'paper', out: Path, **machine) -> Run:
    recipe_ = get_recipe(recipe, [*TINY, f'root={folder}', *overrides])
    return Run(out, recipe_, Machine(folder / 'cache', workers=0, **machine))


# What a step sees

class Numbered(Dataset):
    """Samples that hold their own number."""

    name, skeleton, fingerprint = 'numbered', HAND21, 'numbered'

    def __init__(self, size: int | None) -> None:
        self.size = size

    def batch(self, indices: torch.Tensor) -> Batch:
        return {'patch': torch.zeros(len(indices), 1), 'joints': indices.float()}


@pytest.mark.parametrize('size', [None, 37])
def test_every_sample_is_used_equally_often_and_a_step_is_a_function_of_its_number(size):
    def stream(**options):
        return SampleStream(MemoryShards(Numbered(size), 8), 8, seed=3, reuse=4, **options)
    whole = stream()
    steps = [whole.batch(step)[0]['joints'].int().tolist() for step in range(37)]
    counts = np.bincount(np.concatenate(steps))
    if size is None:  # but for the last shards, which later stages go on with
        assert (counts[:6 * 8] == 4).all() and counts.max() == 4
    else:
        assert (counts == 8).all() and len(counts) == size  # 8 epochs
    for step in (20, 3, 36):  # on its own, in any order
        assert stream().batch(step)[0]['joints'].int().tolist() == steps[step]

    def numbered(rank: int, world: int) -> dict[int, int]:
        batch, numbers = stream(part=(rank, world)).batch(5)
        return dict(zip(numbers.tolist(), batch['joints'].int().tolist(), strict=True))
    assert numbered(0, 2) | numbered(1, 2) == numbered(0, 1)  # which augments them alike
    later = stream(first=2)
    assert min(later.batch(0)[0]['joints']) >= 16


@pytest.mark.parametrize(('size', 'count', 'expected'), [
    (None, 10, range(10)), (37, 5, (0, 9, 18, 27, 36)), (37, 37, range(37)), (37, 99, range(37)), (37, 1, (0,))])
def test_validation_is_on_samples_from_all_of_a_recording(size, count, expected):
    batches = some_samples(MemoryShards(Numbered(size), 8), count)
    assert torch.cat([batch['joints'] for batch in batches]).tolist() == list(expected)


# Augmentation

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


# Losses and recipes

def test_original_code_regresses_the_coefficients_of_the_prior():
    """Squared error of the joints behind a fixed prior = squared error of its coefficients, up to a constant."""
    poses = np.random.default_rng(0).normal(size=(200, 63)) * np.linspace(1, 0.01, 63)
    prior = fit_prior(poses, 8)
    truth = torch.from_numpy(poses[:5]).reshape(5, 21, 3)
    everyone = torch.ones(5, dtype=torch.bool)
    differences = []
    for seed in range(2):
        coefficients = np.random.default_rng(seed + 1).normal(size=(5, 8))
        joints = torch.from_numpy(prior.reconstruct(coefficients)).reshape(5, 21, 3)
        direct = ((coefficients - prior.project(poses[:5])) ** 2).sum(1).mean()
        differences.append(float(joint_loss('squared', 0, joints, truth, everyone)) - direct)
    assert differences[0] == pytest.approx(differences[1])


def test_huber_is_of_the_distance_and_samples_that_do_not_count_add_nothing():
    truth = torch.zeros(2, 21, 3)
    joints = torch.zeros(2, 21, 3, requires_grad=True)
    moved = joints + torch.tensor([0.3, 0.0, 0.4])
    both = joint_loss('huber', 0.1, moved, truth, torch.tensor([True, True]))
    assert both.item() == pytest.approx(21 * 0.1 * (0.5 - 0.05))  # delta (d - delta / 2)
    one = joint_loss('huber', 0.1, moved, truth, torch.tensor([True, False]))
    assert one.item() == pytest.approx(both.item() / 2)
    one.backward()
    assert joints.grad[0].abs().min(0).values.max() > 0 and joints.grad[1].abs().max() == 0
    for apart, loss in ((1.0, (0.25 + 0.35) / 3), (0.1, (0.03 ** 2 + 0.04 ** 2) / 0.2 / 3)):  # beyond the knee, within
        some = joint_loss('smooth_l1', 0.1, apart * moved, truth, torch.tensor([True, False]))
        assert some.item() == pytest.approx(loss / 2)
    exact = torch.zeros(1, 21, 3, requires_grad=True)
    joint_loss('huber', 0.1, exact, truth[:1], torch.tensor([True])).backward()
    assert exact.grad.isfinite().all()


def test_schedules():
    original, modern = RECIPES['original-code'], RECIPES['modern']
    assert learning_rate(original, 0) == pytest.approx(0.01 / 1.2)
    assert learning_rate(original, 0.999) == pytest.approx(0.01 / (1 + 0.2 * 100))
    for epoch in range(100):  # each begins with its first step, however steps / budget is rounded
        assert learning_rate(original, 569 * epoch / 56_900) == pytest.approx(0.01 / (1 + 0.2 * (1 + epoch)))
    assert learning_rate(RECIPES['paper'], 0.7) == 0.01
    rates = [learning_rate(modern, progress) for progress in (0, modern.warmup, 0.5, 1)]
    assert rates[0] == 0 and rates[1] > 0.99 * modern.learning_rate and rates[3] < 1e-9
    assert rates[2] == pytest.approx(modern.learning_rate / 2)


def steps(optimizer: str, *gradients: torch.Tensor, **values: float) -> torch.Tensor:
    """How far each of these gradients moves a weight, at a learning rate of 1."""
    network = nn.ParameterList([torch.zeros_like(gradients[0])])
    recipe = replace(get_recipe('paper'), optimizer=optimizer, learning_rate=1.0, weight_decay=0.0, **values)
    stepper, places = make_optimizer(recipe, network), [network[0].detach().clone()]
    for gradient in gradients:
        network[0].grad = gradient.clone()
        stepper.step()
        places.append(network[0].detach().clone())
    return torch.stack(places).diff(dim=0)


def test_rmsprop_is_that_of_the_original_code():
    gradient = torch.tensor([[1.0, 0.001]])  # the second of which is below the floor
    torch.testing.assert_close(steps('rmsprop', gradient, gradient, momentum=0.0), -torch.tensor([
        [[0.1 ** -0.5, 0.1]], [[0.19 ** -0.5, 0.1]]]))


def test_momentum_goes_on():
    gradient = torch.ones(1, 2)
    moved = steps('sgd', gradient, gradient, momentum=0.5)
    torch.testing.assert_close(moved, -torch.tensor([[[1.0, 1.0]], [[1.5, 1.5]]]))
    gradient = torch.randn(4, 9, 1, 1, generator=torch.Generator().manual_seed(0))
    # Nesterov's looks ahead: it turns before the momentum does.
    for last, sign in ((0.0, 1), (-0.45, 1), (-0.48, -1)):
        first, second = steps('muon', gradient, last * gradient)
        torch.testing.assert_close(second, sign * first, atol=0.02, rtol=0)
        assert first.square().mean().sqrt() == pytest.approx(0.8, rel=0.2)


@pytest.mark.parametrize('optimizer', ['sgd', 'adamw', 'muon'])
def test_weights_are_decayed_and_biases_and_norms_are_not(optimizer):
    network = build('hand_dense', width=4, refined=True)
    for parameter in network.parameters():
        nn.init.ones_(parameter)
        parameter.grad = torch.zeros_like(parameter)
    recipe = replace(get_recipe('paper'), optimizer=optimizer, learning_rate=0.1, weight_decay=0.5)
    make_optimizer(recipe, network).step()
    kept = {name for name, parameter in network.named_parameters() if (parameter == 1).all()}
    norms = {f'{name}.weight' for name, part in network.named_modules()
             if isinstance(part, nn.BatchNorm1d | nn.BatchNorm2d)}
    assert kept == norms | {name for name, _ in network.named_parameters() if name.endswith('bias')}
    assert all(parameter.mean().item() == pytest.approx(0.95) for name, parameter in network.named_parameters()
               if name not in kept)


def test_rmsprop_refuses_what_it_would_ignore():
    with pytest.raises(HandPoseError, match='--set momentum=0 --set weight_decay=0'):
        make_optimizer(get_recipe('paper', ['optimizer=rmsprop']), build('shallow', joints=16))


def test_steps_of_muon_move_all_directions_equally_far():
    """Even where nearly all of a gradient is one direction; and the matrix keeps its rows and columns apart."""
    random = torch.Generator().manual_seed(0)
    for rows, columns in ((4, 36), (36, 4), (16, 16)):
        left, _, right = torch.linalg.svd(torch.randn(rows, columns, generator=random), full_matrices=False)
        strengths = torch.logspace(0, -2, min(rows, columns))
        weights = torch.stack([left * strengths @ right, torch.randn(rows, columns, generator=random)])
        made = left.T @ orthogonal(weights)[0] @ right.T
        assert ((made.diagonal() > 0.6) & (made.diagonal() < 1.2)).all()
        torch.testing.assert_close(made, made.diagonal().diag(), atol=1e-4, rtol=0)
    assert (orthogonal(torch.zeros(2, 4, 9)) == 0).all()


def test_muon_descends_convolutions_its_way_and_the_rest_as_adamw_does():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Flatten(), nn.Linear(4 * 36, 2))
    twin = copy.deepcopy(network)
    patch, recipe = torch.randn(32, 1, 8, 8), get_recipe('modern', ['learning_rate=0.003'])
    aim = patch.mean((2, 3)) * torch.tensor([1.0, -2.0])
    losses = []
    for net, name in ((network, 'muon'), (twin, 'adamw')):
        optimizer = make_optimizer(replace(recipe, optimizer=name), net)
        before = copy.deepcopy(net.state_dict())
        for step in range(60):
            loss = (net(patch) - aim).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if step == 0:
                first, moved = loss.item(), {key: net.state_dict()[key] - before[key] for key in before}
        losses.append((first, loss.item(), moved))
    (start, end, muon), (_, _, adamw) = losses
    assert end < start / 5
    assert all(torch.equal(muon[key], adamw[key]) for key in ('0.bias', '3.weight', '3.bias'))
    assert not torch.allclose(muon['0.weight'], adamw['0.weight'], rtol=0.1, atol=0)


def test_any_value_of_a_recipe_can_be_replaced():
    recipe = get_recipe('paper', ['samples=2e6', 'options.bottleneck=none', 'augmentation=modern',
                                  'augmentation.jitter=0.01', 'learning_rate=1', 'base=a/b.safetensors',
                                  'train_prior=false'])
    assert (recipe.samples, recipe.options['bottleneck'], recipe.augmentation.jitter) == (2_000_000, None, 0.01)
    assert recipe.augmentation.erase == PRESETS['modern'].erase
    assert (recipe.learning_rate, recipe.base, recipe.train_prior) == (1.0, 'a/b.safetensors', False)
    assert recipe_from_dict(json.loads(json.dumps(recipe_to_dict(recipe)))) == recipe
    assert get_recipe('paper') == RECIPES['paper']


@pytest.mark.parametrize(('override', 'message'), [
    ('lr=1', "no 'lr'"), ('samples=many', 'not of type'), ('samples=1.5', 'not of type'), ('seed', 'key=value'),
    ('samples=-5', '--set samples=-5: must be at least 1'), ('batch_size=0', 'at least 1'), ('seed=-1', 'at least 0'),
    ('seed=20261126', 'at most 4194303'), ('learning_rate=-1', r'learning_rate=-1: must be at least 1e-09'),
    ('knee=0', 'at least 1e-06'), ('weight_decay=-1', 'at least 0'), ('warmup=2', 'at most 1'),
    ('augmentation.scale=0', r'--set augmentation\.scale=0: must be at least 1'),
    ('augmentation.dropout=2', 'at most 1'), ('augmentation.jitter=8', r'at most 0\.1'),
    ('augmentation=strong', 'choose one of'), ('augmentation.strong=1', "no 'strong'"), ('seed.x=1', 'is one value'),
    ('options.bottleneck.x=8', 'is one value'), ('loss=l1', "unknown loss 'l1': choose huber, smooth_l1 or squared"),
    ('optimizer=adam', "unknown optimizer 'adam'"), ('schedule=step', "unknown schedule 'step'"),
    ('precision=float16', "unknown precision 'float16': choose float32 or bfloat16")])
def test_a_wrong_override_is_one_sentence(override, message):
    with pytest.raises(HandPoseError, match=message):
        get_recipe('paper', [override])


# Runs

def test_training_learns_and_leaves_a_folder_that_tells_all(folder, tmp_path, monkeypatch):
    run = tiny(folder, 'network=deep', 'optimizer=adamw', 'learning_rate=0.002', 'samples=960', 'batch_size=16',
               'val_every=480', 'options.dropout=0.0', recipe='paper', out=tmp_path)
    monkeypatch.setattr('hand_pose_ros.training.loop.time', SimpleNamespace(monotonic=lambda: 2 * run.step))
    first = run.train()
    # Twelve frames do not tell where scattered balls are in a new one, but those it was shown it knows.
    shown = load_checkpoint(tmp_path / 'last.safetensors')
    batch = run.shards.read(0)
    with torch.no_grad():
        error = (shown.network(batch['patch'].float()) - batch['joints']).norm(dim=-1).mean() * 125
    assert error < 25 < first['val_mm'] / 1.5
    assert {key: shown.metadata[key] for key in ('skeleton', 'cube_side', 'training_data')} == {
        'skeleton': 'icvl16', 'cube_side': 0.25, 'training_data': 'icvl-train'}
    lines = [json.loads(line) for line in (tmp_path / 'metrics.jsonl').read_text().splitlines()]
    assert [line['samples'] for line in lines if 'val_mm' in line] == [480, 960]
    assert [(line['step'], line['rate']) for line in lines if 'joints' in line] == [(50, 8), (60, 8)]
    config = json.loads((tmp_path / 'config.json').read_text())
    assert recipe_from_dict(config['recipe']) == run.recipe and 'git' in config
    assert (tmp_path / 'best.safetensors').exists()
    told = (tmp_path / 'log.txt').read_text().count(' of 960 samples, ')  # how it goes, where no terminal shows a bar
    assert told == 1, 'a line a minute'
    with pytest.raises(TrainingError, match='holds a run already'):
        tiny(folder, out=tmp_path).train()


def test_a_run_that_is_there_is_not_trained_over(tmp_path, capsys):
    (tmp_path / 'state.safetensors').touch()
    assert main(['train', 'paper', '--out', str(tmp_path), '--cache', str(tmp_path / 'cache')]) == 1
    assert f'{tmp_path} holds a run already' in capsys.readouterr().err
    assert not (tmp_path / 'cache').exists(), 'samples were made for nothing'


def test_the_prior_comes_from_the_training_poses_and_is_trained_on_unless_the_recipe_says_no(folder, tmp_path):
    for recipe, trained_on in (('paper', True), ('original-code', False)):
        run = tiny(folder, 'samples=16', 'augmentation=none', recipe=recipe, out=tmp_path / recipe)
        # Of all training samples: the first ones of a recording may be one gesture of one person.
        prior = fit_prior(torch.cat([run.shards.read(shard)['joints'] for shard in range(4)]), 8)
        head = run.objective.network.head
        start = head.reconstruction.weight.detach().clone()
        torch.testing.assert_close(start.T.double(), torch.from_numpy(prior.components.copy()), atol=1e-5, rtol=0)
        mean = torch.from_numpy(prior.mean)
        torch.testing.assert_close(head.reconstruction.bias.detach().double(), mean, atol=1e-6, rtol=0)
        run.train()
        assert torch.equal(head.reconstruction.weight.detach(), start) != trained_on
    # And where the network has a bottleneck of its own, of 30, that nobody asked for.
    run = tiny(folder, 'network=deep_prior', 'options={}', 'samples=16', out=tmp_path / 'unasked')
    components = run.objective.network.head.reconstruction.weight.T
    torch.testing.assert_close(components @ components.T, torch.eye(30), atol=1e-5, rtol=0)


def same_state(a: Path, b: Path) -> bool:
    one, two = load_file(a / 'state.safetensors'), load_file(b / 'state.safetensors')
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)


MODERN = ('network=hand_dense', 'options={}', 'options.width=8')


@pytest.mark.parametrize('recipe', ['paper', 'original-code', 'modern'])
def test_a_stopped_run_continues_bit_for_bit(folder, tmp_path, recipe):
    overrides = ('samples=40', *(MODERN if recipe == 'modern' else ()))
    tiny(folder, *overrides, recipe=recipe, out=tmp_path / 'whole').train()
    run = tiny(folder, *overrides, recipe=recipe, out=tmp_path / 'stopped')
    step, train_step = [], run._train_step

    def stopping(module):
        step.append(1)
        if len(step) == 7:  # in the middle of an epoch
            os.kill(os.getpid(), signal.SIGTERM)
        return train_step(module)
    run._train_step = stopping
    with pytest.raises(TrainingError, match=r'after 28 samples, with .*last.safetensors; .* --resume goes on'):
        run.train()
    facts = load_checkpoint(tmp_path / 'stopped' / 'last.safetensors').metadata  # weights to use
    assert (facts['samples'], facts['validation']) == (28, {})
    metrics = tmp_path / 'stopped' / 'metrics.jsonl'  # as a process that was killed long after its last state leaves it
    metrics.write_bytes(b'{"step": 3, "samples": 12}\n{"step": 4, "sam\xab": 16\nnull\n{"step": 8, "samples": 32}\n'
                        b'{"step": 9, "sam')
    again = tiny(folder, *overrides, recipe=recipe, out=tmp_path / 'stopped')
    again.train(resume=True)
    assert same_state(tmp_path / 'whole', tmp_path / 'stopped')
    *rows, last, _ = map(json.loads, metrics.read_text().splitlines())
    assert [row['step'] for row in rows] == [3] and last['step'] == 10
    assert last['learning_rate'] == learning_rate(run.recipe, 9 / 10)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_what_is_validated_and_shipped_is_the_average_of_the_weights_and_of_what_norms_have_seen(folder, tmp_path):
    run = tiny(folder, *MODERN, 'samples=11', 'learning_rate=0.1', 'warmup=0', 'average=0.15', recipe='modern',
               out=tmp_path)
    expected, train_step = copy.deepcopy(run.objective.network.state_dict()), run._train_step

    def watched(gradients):
        terms, decay = train_step(gradients), (0.1, 0.15, 0.15)[run.step - 1]  # the random start is forgotten soon
        for name, value in run.objective.network.state_dict().items():
            last = expected[name]
            expected[name] = decay * last + (1 - decay) * value if value.is_floating_point() else value.clone()
            torch.testing.assert_close(run.averaged.network.state_dict()[name], expected[name], atol=1e-6, rtol=1e-6)
        return terms
    run._train_step = watched
    run.train()
    assert run.step == 3, 'samples are asked for, at least so many'
    shipped = load_checkpoint(tmp_path / 'last.safetensors').network.state_dict()
    last = run.objective.network.state_dict()
    for name, value in expected.items():
        torch.testing.assert_close(shipped[name], value, atol=1e-3, rtol=1e-3)
    assert (last['maps.weight'] - expected['maps.weight']).abs().max() > 0.005


@pytest.mark.parametrize(('whole', 'damaged'), [
    (rb'\"step\"', rb'\"stop\"'), (b'optimizer.0', b'optimizer.x'), (b'"trained.network.', b'"trained.netwerk.')])
def test_a_damaged_state_is_named_in_one_line(folder, tmp_path, whole, damaged):
    tiny(folder, 'samples=8', out=tmp_path).train()
    state = tmp_path / 'state.safetensors'
    data = state.read_bytes()
    assert whole in data
    state.write_bytes(data.replace(whole, damaged, 1))
    with pytest.raises(CheckpointError, match=r'state.safetensors cannot be resumed from: .') as caught:
        tiny(folder, 'samples=8', out=tmp_path).train(resume=True)
    assert '\n' not in str(caught.value)


def command(folder: Path, out: Path, *overrides: str) -> list[str]:
    sets = [part for item in (*TINY, f'root={folder}', *overrides) for part in ('--set', item)]
    return ['train', 'paper', '--out', str(out), '--cache', str(folder / 'cache'), '--threads', '1', *sets]


@pytest.mark.timeout(600)
def test_a_killed_run_continues_bit_for_bit(folder, tmp_path):
    """SIGKILL at any moment, with samples made by another process, which must not outlive the run."""
    script = ('import sys, hand_pose_ros.training.loop as loop; from functools import partial;'
              'loop.Machine = partial(loop.Machine, save_every_s=0);'
              'from hand_pose_ros.cli import main; sys.exit(main(sys.argv[1:]))')
    long = ('samples=40_000', 'val_every=100_000')
    arguments = command(folder, tmp_path, *long)
    process = subprocess.Popen([sys.executable, '-c', script, *arguments], stderr=subprocess.DEVNULL)
    state = tmp_path / 'state.safetensors'
    while not state.exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(0.5)
    process.kill()
    process.wait()
    stopped_at = int(load_progress(state)['step'])
    assert 0 < stopped_at < 10_000
    again = Run(tmp_path, get_recipe('paper', [*TINY, f'root={folder}', *long]), Machine(folder / 'cache', workers=0))
    whole = tiny(folder, *long, out=tmp_path / 'whole')
    for run, resume in ((again, True), (whole, False)):
        stop_after(run, stopped_at + 5)
        with pytest.raises(TrainingError, match='--resume goes on'):
            run.train(resume)
    assert same_state(tmp_path, tmp_path / 'whole')


@pytest.mark.parametrize('width', ['8', 'none'])  # waits for the poses of its prior, or for the samples of a step
def test_ctrl_c_before_the_first_step_ends_a_run_at_once(tmp_path, width):
    """As in a terminal, where every process gets it; once more while it ends. The samples would take an hour."""
    sets = [part for item in ('shard_size=200_000', f'options.bottleneck={width}') for part in ('--set', item)]
    process = subprocess.Popen([sys.executable, '-m', 'hand_pose_ros.cli', 'train', 'paper', '--threads', '1', '--out',
                                str(tmp_path / 'run'), '--cache', str(tmp_path / 'cache'), *sets],
                               stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        for awaited in ('making samples of synthetic-train', 'hand-pose train: interrupted'):
            while awaited not in (line := process.stderr.readline()):
                assert line and 'Traceback' not in line
            os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=60)  # which ends when no child holds its end of the pipe any more
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode != 0 and not list((tmp_path / 'cache').rglob('*.*'))


def test_a_signal_does_not_wait_for_samples_and_the_run_continues_bit_for_bit(folder, tmp_path):
    overrides = ('samples=40', 'val_every=28')
    tiny(folder, *overrides, out=tmp_path / 'whole').train()
    run = tiny(folder, *overrides, out=tmp_path / 'stopped')
    batch = run.stream.batch

    def endless(step):
        if step == 7:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(600)
        return batch(step)
    run.stream.batch = endless
    with pytest.raises(TrainingError, match=r'after 28 samples, with .*last.safetensors; .* --resume goes on'):
        run.train()
    assert 'val_mm' in load_checkpoint(tmp_path / 'stopped' / 'last.safetensors').metadata['validation']
    tiny(folder, *overrides, out=tmp_path / 'stopped').train(resume=True)
    assert same_state(tmp_path / 'whole', tmp_path / 'stopped')
    assert validations(tmp_path / 'stopped') == validations(tmp_path / 'whole')
    logs = [(tmp_path / name / 'log.txt').read_text() for name in ('whole', 'stopped')]
    assert [log.count('the recipe is in') for log in logs] == [1, 2], 'each has a log of its own'


def test_the_state_is_saved_now_and_then_and_around_a_validation(folder, tmp_path, monkeypatch):
    run, saved = None, []
    monkeypatch.setattr('hand_pose_ros.training.loop.time', SimpleNamespace(monotonic=lambda: run.step if run else 0))
    monkeypatch.setattr('hand_pose_ros.training.loop.save_state', lambda *_: saved.append(run.step))
    run = tiny(folder, 'samples=40', out=tmp_path, save_every_s=3)
    run.train()
    assert saved == [4, 8, 10, 10]


def test_what_a_killed_run_left_half_written_goes_with_the_next(tmp_path):
    left = tmp_path / '.state.safetensors.1234567.part'
    left.write_bytes(b'half of it')
    run = RunFolder(tmp_path)
    run.lock()
    run.close()
    assert not left.exists()


def test_one_folder_is_trained_in_by_one_process_at_a_time(folder, tmp_path):
    first = tiny(folder, 'samples=8', out=tmp_path / 'run')
    first.folder.lock()
    for resume in (False, True):
        with pytest.raises(TrainingError, match=r'run: another process trains in this folder'):
            tiny(folder, 'samples=8', 'seed=5', out=tmp_path / 'run').train(resume)
    first.train()  # in which it may lock once more
    assert json.loads((tmp_path / 'run' / 'config.json').read_text())['recipe']['seed'] == first.recipe.seed


def test_a_run_goes_on_from_another_folder(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder.parent)
    recipe = get_recipe('paper', [f'root={folder.name}', 'base=hand_dense', 'first=nothing/here'])
    assert (recipe.root, recipe.base, recipe.first) == (str(folder.resolve()), 'hand_dense', 'nothing/here')


def test_tensorboard_forgets_what_a_killed_run_showed_after_its_state(tmp_path):
    pytest.importorskip('tensorboard')
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    for step, shown in ((0, (4, 8, 12)), (2, (12, 16))):  # killed after 12 samples, with the state of 8
        run = RunFolder(tmp_path)
        run.open(step, 4 * step)
        for samples in shown:
            run.write({'step': samples // 4, 'samples': samples, 'loss': float(step)})
        run.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert [(one.step, one.value) for one in events.Scalars('loss')] == [(4, 0), (8, 0), (12, 2), (16, 2)]


def test_a_full_disk_is_told_of_with_the_file(tmp_path, monkeypatch):
    def full(*_, **__):
        raise SafetensorError('Error while serializing: I/O error: No space left on device (os error 28)')

    monkeypatch.setattr('hand_pose_ros.training.state.save_file', full)
    with pytest.raises(HandPoseError, match=r'x\.safetensors: cannot be written, for the disk is full: make room'):
        save_tensors(tmp_path / 'x.safetensors', {'a': torch.zeros(1)}, {})
    assert not list(tmp_path.iterdir())


def test_a_run_that_was_stopped_in_its_last_validation_does_it_when_resumed(folder, tmp_path):
    whole = tiny(folder, 'samples=40', out=tmp_path / 'whole')
    stop_after(whole, 10)  # in its last step: nothing is left to stop
    expected = whole.train()
    run = tiny(folder, 'samples=40', out=tmp_path / 'stopped')

    def stopped():
        raise KeyboardInterrupt
    run._validate = stopped
    with pytest.raises(TrainingError, match='after 40 samples'):
        run.train()
    assert not (tmp_path / 'stopped' / 'best.safetensors').exists()
    assert tiny(folder, 'samples=40', out=tmp_path / 'stopped').train(resume=True) == expected
    assert (tmp_path / 'stopped' / 'best.safetensors').exists()
    assert tiny(folder, 'samples=40', out=tmp_path / 'stopped').train(resume=True) == expected  # finished already
    assert len(validations(tmp_path / 'stopped')) == 1


def test_a_validation_that_fails_costs_no_training_and_is_made_up_for(folder, tmp_path):
    tiny(folder, out=tmp_path / 'whole').train()
    run = tiny(folder, out=tmp_path / 'failed')

    def full(*_):
        raise HandPoseError('the disk is full')
    run._save_checkpoint = full
    with pytest.raises(HandPoseError, match='disk is full'):
        run.train()
    assert load_progress(run.folder.state)['step'] == 10
    tiny(folder, out=tmp_path / 'failed').train(resume=True)
    assert same_state(tmp_path / 'whole', tmp_path / 'failed')
    assert validations(tmp_path / 'failed') == validations(tmp_path / 'whole')


def test_a_run_that_goes_on_keeps_its_best_weights_and_tells_of_other_data(folder, tmp_path, monkeypatch, caplog):
    errors = iter((0.009, 0.019))

    def validate(*_) -> tuple[torch.Tensor, torch.Tensor]:
        error = next(errors)  # and of one joint more, as of the worst
        return torch.tensor([[[error, 0, 0]] * 15 + [[error + 0.016, 0, 0]]]), torch.zeros(1, 16, 3)
    monkeypatch.setattr('hand_pose_ros.training.loop.estimate', validate)
    first, again = (tiny(folder, 'samples=80', out=tmp_path) for _ in range(2))
    stop_after(first, 15)
    with pytest.raises(TrainingError, match='after 60 samples'):
        first.train()
    again.shards.dataset.fingerprint = 'another'
    again.train(resume=True)
    assert 'the training data, or the code that makes them, have changed since step 15' in caplog.text
    for name, samples, *told in (('best', 40, 10, 0, 1, 1), ('last', 80, 20, 0, 0, 1)):
        facts = load_checkpoint(tmp_path / f'{name}.safetensors').metadata
        assert facts['samples'] == samples
        assert facts['validation'] == dict(zip(('val_mm', 'val_within_20', 'val_within_30', 'val_within_40'), told,
                                               strict=True))
    caplog.clear()
    tiny(folder, 'samples=80', out=tmp_path).train(resume=True)
    assert f'the run in {tmp_path} is finished already' in caplog.text


def validations(run: Path) -> list[dict]:
    return [row for row in map(json.loads, (run / 'metrics.jsonl').open()) if 'val_mm' in row]


def record_hand(folder: Path, skeleton: Skeleton = HAND21) -> None:
    joints = np.array([0, 0, 0.5]) + np.random.default_rng(0).uniform(-0.05, 0.05, (len(skeleton), 3))
    hand = SimpleNamespace(id='0', side='right', score=1.0, joints=joints, confidence=np.ones(len(skeleton)),
                           cube=Cube((0.0, 0.0, 0.5), 0.3))
    with BagWriter(folder / 'hand.mcap') as file:
        file.write_depth(0, 'camera', np.full((480, 640), 0.5, np.float32), CAMERA)
        file.write_hands(0, 'camera', [hand], skeleton)


def test_validation_data_that_cannot_be_used_are_told_before_the_training(tmp_path):
    def run() -> Run:
        recipe = get_recipe('paper', ['dataset=bags', f'root={tmp_path}', 'options.bottleneck=none'])
        return Run(tmp_path / 'run', recipe, Machine(tmp_path / 'cache', workers=0))
    record_hand(tmp_path / 'train')
    with pytest.raises(HandPoseError, match='val holds no bags'):
        run()
    record_hand(tmp_path / 'val', get_skeleton('icvl16'))
    with pytest.raises(TrainingError, match='bags-val has joints of icvl16, but bags-train those of hand21'):
        run()
    record_hand(tmp_path / 'val')
    run()


def stop_after(run: Run, step: int) -> None:
    train_step = run._train_step

    def stopping(module):
        run._stop = run.step + 1 >= step
        return train_step(module)
    run._train_step = stopping


@pytest.mark.timeout(600)
def test_two_processes_give_the_result_of_one(folder, tmp_path):
    overrides = ('samples=40', 'network=multi_scale', 'options.dropout=0.0', 'augmentation=modern')
    script = 'import sys; from hand_pose_ros.cli import main; sys.exit(main(sys.argv[1:]))'
    torchrun = [sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', '2']
    arguments = [*command(folder, tmp_path / 'two', *overrides), '--workers', '0']
    result = subprocess.run([*torchrun, '--no-python', sys.executable, '-c', script, *arguments], timeout=550,
                            text=True, capture_output=True, env={**os.environ, 'OMP_NUM_THREADS': '1'})
    assert result.returncode == 0, result.stderr
    assert result.stdout.count('best.safetensors') == 1  # told by one of them
    assert main([*command(folder, tmp_path / 'one', *overrides), '--workers', '0']) == 0
    one, two = (load_file(tmp_path / name / 'state.safetensors') for name in ('one', 'two'))
    for key, value in one.items():
        torch.testing.assert_close(two[key], value, atol=1e-5, rtol=1e-4)


def test_a_batch_that_cannot_be_shared_is_refused(folder, tmp_path, monkeypatch):
    monkeypatch.setenv('WORLD_SIZE', '3')
    with pytest.raises(TrainingError, match='a batch of 4 cannot be shared equally by 3 processes'):
        tiny(folder, out=tmp_path)


def test_epochs_are_of_the_samples_and_threads_as_many_as_asked(folder, tmp_path):
    run = tiny(folder, 'samples=none', 'epochs=3', out=tmp_path, threads=2)
    assert run.budget == 3 * 16 and torch.get_num_threads() == 2


def test_a_device_that_is_not_there_is_told_before_the_work(folder, tmp_path):
    with pytest.raises(HandPoseError, match="device 'quantum' cannot be used here"):
        tiny(folder, out=tmp_path, device='quantum')


@pytest.mark.parametrize('device', ['cuda', 'cuda:0'])
def test_a_process_of_torchrun_without_a_gpu_says_so(folder, tmp_path, device, monkeypatch, capsys):
    for name, value in {'RANK': 0, 'WORLD_SIZE': 99, 'LOCAL_RANK': 98}.items():
        monkeypatch.setenv(name, str(value))
    assert main([*command(folder, tmp_path / 'run'), '--device', device]) == 1
    assert "device 'cuda:98' " in capsys.readouterr().err


def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_batch(folder, tmp_path):
    run = tiny(folder, 'learning_rate=1e30', out=tmp_path)
    with pytest.raises(TrainingError, match=r'step \d+ is not finite .* learning_rate below 1e\+30'):
        run.train()
    assert not list(tmp_path.glob('state*')) and not list(tmp_path.glob('last*'))  # spoilt
    (saved,) = tmp_path.glob('failed_batch_*.safetensors')
    assert load_file(saved)['patch'].shape == (4, 1, 128, 128)


@pytest.mark.skipif(not torch.cuda.is_available(), reason='needs a CUDA GPU')
@pytest.mark.parametrize('network', [MODERN, ('network=deep', 'options.dropout=0.0')])
def test_a_cuda_graph_trains_as_its_kernels_do(folder, tmp_path, network, monkeypatch):
    def weights(run):
        return torch.cat([parameter.detach().flatten() for parameter in run.objective.parameters()])

    def trained(out, captured):
        monkeypatch.setattr('hand_pose_ros.training.loop.Gradients',
                            lambda module, precision, **_: Gradients(module, precision, captured))
        run = tiny(folder, *network, 'samples=40', 'precision=float32', recipe='modern', out=out, device='cuda')
        start = weights(run).clone()
        run.train()
        return start, weights(run)

    start, graph = trained(tmp_path / 'graph', captured=True)
    _, kernels = trained(tmp_path / 'kernels', captured=False)
    assert (graph - kernels).norm() < 0.1 * (kernels - start).norm()


def test_bags_of_another_folder_were_not_seen_by_the_base(tmp_path):
    def run(folder: str, *overrides: str) -> Run:
        recipe = get_recipe('paper', [*TINY, 'dataset=bags', 'options.bottleneck=none', f'root={tmp_path / folder}',
                                      *overrides])
        return Run(tmp_path / 'run', recipe, Machine(tmp_path / 'cache', workers=0))
    for name in ('first', 'second'):
        record_hand(tmp_path / name / 'train')
        record_hand(tmp_path / name / 'val')
    first = run('first', 'batch_size=1', 'samples=1')
    first.train()
    base = f'base={first.folder.checkpoint("last")}'
    with pytest.raises(TrainingError, match='trained on all of bags-train'):
        run('first', 'refiner=or_ref', base)
    assert list(run('second', 'refiner=or_ref', base).stream.window(0)) == [0]


def test_a_refiner_learns_from_what_its_base_has_not_seen(folder, tmp_path):
    tiny(folder, out=tmp_path / 'greedy', ).train()
    with pytest.raises(TrainingError, match=r'trained on all of icvl-train.*last_shard=N'):
        tiny(folder, 'refiner=or_ref', f'base={tmp_path / "greedy" / "last.safetensors"}', out=tmp_path / 'never')
    tiny(folder, 'last_shard=2', out=tmp_path / 'base').train()
    base = tmp_path / 'base' / 'last.safetensors'
    with pytest.raises(TrainingError, match='choose one of std_ref, or_ref'):
        tiny(folder, 'refiner=deep', f'base={base}', out=tmp_path / 'never')
    with pytest.raises(TrainingError, match=r'or_ref corrects .* --set refiner=or_ref'):
        tiny(folder, 'network=or_ref', 'options={}', out=tmp_path / 'never')
    with pytest.raises(TrainingError, match=r'gives joints of hand21, but icvl has those of icvl16'):
        tiny(folder, 'refiner=or_ref', 'base=deep_prior', out=tmp_path / 'never')
    with pytest.raises(HandPoseError, match='does not take width'):
        tiny(folder, 'refiner=or_ref', f'base={base}', 'options.width=8', out=tmp_path / 'never')
    run = tiny(folder, 'refiner=or_ref', f'base={base}', 'optimizer=adamw', 'learning_rate=0.001', 'samples=160',
               'options.dropout=0.2', out=tmp_path / 'refined')
    assert list(run.stream.window(0)) == [2, 3]
    other = tiny(folder, 'refiner=or_ref', f'base={base}', 'shard_size=3', out=tmp_path / 'never')
    assert list(other.stream.window(0)) == [3, 4, 5]  # of 16 samples, of which the base has seen 8
    tiny(folder, 'last_shard=1', 'samples=4', f'base={base}', out=tmp_path / 'on').train()  # what its base saw, it saw
    behind = tiny(folder, 'refiner=or_ref', f'base={tmp_path / "on" / "last.safetensors"}', out=tmp_path / 'never')
    assert list(behind.stream.window(0)) == [2, 3]
    run.train()
    assert 'or_ref on icvl-train' in (tmp_path / 'refined' / 'log.txt').read_text()
    refined, before = load_checkpoint(tmp_path / 'refined' / 'last.safetensors'), load_checkpoint(base)
    assert refined.refiner.config['dropout'] == 0.2
    kept = refined.network.state_dict()
    assert all(torch.equal(kept[key], value) for key, value in before.network.state_dict().items())
    batch = run.shards.read(3)
    with torch.no_grad():
        estimate = refined.network(batch['patch'].float())
        better = refined.refiner(batch['patch'].float(), estimate)
    assert (better - batch['joints']).norm(dim=-1).mean() < (estimate - batch['joints']).norm(dim=-1).mean()
    with pytest.raises(TrainingError, match='--set base=FILE'):
        tiny(folder, 'refiner=or_ref', out=tmp_path / 'never')


def test_a_base_without_joints_is_refused_as_that_of_a_refiner(folder, tmp_path):
    tiny(folder, 'network=center_refiner', 'options={}', 'last_shard=2', 'samples=4', out=tmp_path / 'palm').train()
    with pytest.raises(TrainingError, match='is a center_refiner, which gives no joints to correct'):
        tiny(folder, 'refiner=or_ref', f'base={tmp_path / "palm" / "last.safetensors"}', out=tmp_path / 'never')


def test_the_center_refiner_learns_where_the_palm_is(folder, tmp_path):
    run = tiny(folder, 'network=center_refiner', 'options={}', 'options.dropout=0.0', 'optimizer=adamw',
               'learning_rate=0.001', 'samples=600', out=tmp_path)
    run.train()
    network = load_checkpoint(tmp_path / 'last.safetensors').network
    batch = run.shards.read(0)
    palm = batch['joints'][:, 0]  # of icvl16
    with torch.no_grad():
        error = (network(batch['patch'].float()) - palm).norm(dim=-1).mean()
    assert error < 0.5 * (palm - palm.mean(0)).norm(dim=-1).mean()


def test_the_finder_of_hands_learns_from_whole_scenes(folder, tmp_path):
    recipe = get_recipe('finder', ['samples=1920', 'batch_size=16', 'shard_size=32', 'reuse=60', 'val_samples=32',
                                   'precision=float32', 'options.width=8', 'learning_rate=0.01', 'average=0.9'])
    run = Run(tmp_path / 'run', recipe, Machine(tmp_path / 'cache', workers=0))
    run.train()
    terms = [row for row in map(json.loads, (tmp_path / 'run' / 'metrics.jsonl').open()) if 'score' in row]
    network = load_checkpoint(tmp_path / 'run' / 'last.safetensors').network
    shown = run.shards.read(0)
    with torch.no_grad():
        logits, middles = network(shown['patch'].float())
    best = logits.flatten(1).argmax(1)
    found = middles.flatten(2)[torch.arange(len(best)), :, best]
    off = (found - shown['joints'][:, 0])[shown['hand_present']].norm(dim=1)
    assert terms and off.median() < 0.15  # of scenes that reach half a metre to each side
    with pytest.raises(TrainingError, match='dataset=scenes'):
        tiny(folder, 'network=hand_finder', 'options={}', out=tmp_path / 'never')


def test_a_network_starts_from_another_and_gets_a_prior_if_that_had_none(folder, tmp_path, monkeypatch):
    plain = tmp_path / 'plain.safetensors'
    facts = {'skeleton': 'icvl16', 'cube_side': 0.3}
    save_checkpoint(plain, build('hand_dense', joints=16, width=8), facts)
    wanted = ('network=hand_dense', 'options.width=8')
    run = tiny(folder, *wanted, f'base={plain}', out=tmp_path / 'first')
    first = run.objective.network
    patch = run.shards.read(0)['patch'].float()
    with torch.no_grad():
        answer = first.eval().forward_full(patch)
        same = load_checkpoint(plain).network.forward_full(patch)
    torch.testing.assert_close(answer['votes'], same['joints'], atol=1e-5, rtol=0)
    gram = first.head.projection.weight @ first.head.reconstruction.weight
    torch.testing.assert_close(gram, torch.eye(8), atol=1e-5, rtol=0)  # of principal components
    first.head.output.bias.data.fill_(0.1)
    path = tmp_path / 'with.safetensors'
    save_checkpoint(path, first, facts)
    second = tiny(folder, *wanted, f'base={path}', out=tmp_path / 'second').objective.network
    pairs = zip(load_checkpoint(path).network.state_dict().values(), second.state_dict().values(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
    with pytest.raises(TrainingError, match='holds another network than the recipe names'):
        tiny(folder, f'base={path}', out=tmp_path / 'third')
    # As many joints, but others: neither they nor their prior would be those of the dataset.
    save_checkpoint(path, first, {**facts, 'skeleton': 'other16'})
    monkeypatch.setitem(SKELETONS, 'other16', replace(get_skeleton('icvl16'), name='other16'))
    with pytest.raises(TrainingError, match='gives joints of other16, but icvl has those of icvl16'):
        tiny(folder, *wanted, f'base={path}', out=tmp_path / 'fourth')
    with pytest.raises(TrainingError, match='needs a hand_dense with the joints of icvl16'):
        tiny(folder, 'network=two_looks', f'first={path}', out=tmp_path / 'fifth')


def test_a_network_with_further_blocks_and_a_refinement_starts_as_the_one_it_grew_from(folder, tmp_path):
    facts, base = {'skeleton': 'icvl16', 'cube_side': 0.3}, tmp_path / 'base.safetensors'
    network = build('hand_dense', joints=16, width=8, bottleneck=8)
    for norm in (part for part in network.modules() if isinstance(part, nn.BatchNorm2d)):
        nn.init.uniform_(norm.weight, 0.5, 1)  # as after training: none is zero
    save_checkpoint(base, network, facts)
    wanted = ('network=hand_dense', 'options.width=8', f'base={base}')
    run = tiny(folder, *wanted, 'options.blocks=[1,2,1,3]', 'options.refined=true', 'samples=40', recipe='modern',
               out=tmp_path / 'grown')
    patch = run.shards.read(0)['patch'].float()
    with torch.no_grad():
        answers = [each.forward_full(patch) for each in (run.objective.network.eval(), load_checkpoint(base).network)]
    for name in answers[1]:
        torch.testing.assert_close(answers[0][name], answers[1][name], atol=1e-5, rtol=0)
    run.train()
    grown = load_checkpoint(tmp_path / 'grown' / 'last.safetensors').network
    assert grown.config['blocks'] == [1, 2, 1, 3] and grown.stages[3][2].body[2][1].weight.abs().max() > 0
    assert grown.config['refined'] and grown.refinement.output.weight.abs().max() > 0
    for other in ('options.blocks=[2,1,1]', 'options.blocks=[1,0,1,1]'):
        with pytest.raises(HandPoseError, match='give four numbers'):
            tiny(folder, *wanted, other, out=tmp_path / 'never')
    with pytest.raises(TrainingError, match='holds another network'):  # fewer blocks than its base has
        tiny(folder, 'network=hand_dense', 'options.width=8', f'base={tmp_path / "grown" / "last.safetensors"}',
             out=tmp_path / 'fewer')


def test_the_second_look_learns_behind_a_first_which_stays(folder, tmp_path):
    facts = {'skeleton': 'icvl16', 'cube_side': 0.3}
    small, large = tmp_path / 'small.safetensors', tmp_path / 'large.safetensors'
    save_checkpoint(small, build('hand_dense', joints=16, width=4, bottleneck=8), facts)
    save_checkpoint(large, build('hand_dense', joints=16, width=8, bottleneck=8), facts)
    wanted = ('network=two_looks', 'options.width=8', 'options.bottleneck=8')
    for base in ('none', large):
        with pytest.raises(TrainingError, match='--set first=FILE'):
            tiny(folder, *wanted, f'base={base}', out=tmp_path / 'never')
    with pytest.raises(TrainingError, match='hand_dense has one look'):
        tiny(folder, 'network=hand_dense', *wanted[1:], f'first={small}', out=tmp_path / 'never')
    run = tiny(folder, *wanted, f'first={small}', f'base={large}', 'samples=40', recipe='modern', out=tmp_path / 'run')
    network, base = run.objective.network, load_checkpoint(large).network.state_dict()
    assert network.config['knuckles'] == (4, 7, 10, 13) and network.config['first'] == {
        'width': 4, 'bottleneck': 8, 'blocks': [1, 1, 1, 1], 'refined': False}
    second = network.second.state_dict()
    equal = {name for name in base if torch.equal(base[name], second[name])}
    assert all(name.startswith('head.') for name in base.keys() - equal) and len(equal) < len(base)
    # The prior is one of poses as they are seen: upright.
    mean = network.second.head.reconstruction.bias.detach().view(16, 3)
    assert mean[:, :2].mean(0).abs().max() < 0.02
    assert mean[list(network.knuckles), 1].mean() < mean[0, 1] - 0.05
    # The bones of these joints begin at the palm: hands are shown as if all had the usual size.
    batch = augment(run.shards.read(0), Augmentation(), torch.arange(4), seed=0)
    apart, seen = (torch.cdist(poses, poses) for poses in (batch['joints'], run.objective.poses(batch)))
    torch.testing.assert_close(seen * ZOOM, apart, atol=1e-4, rtol=1e-4)
    run.train()
    last = tmp_path / 'run' / 'last.safetensors'
    trained, kept = load_checkpoint(last).network.state_dict(), load_checkpoint(small).network.state_dict()
    assert all(torch.equal(trained[f'first.{name}'], value) for name, value in kept.items())
    assert not torch.equal(trained['second.maps.weight'], base['maps.weight'])
    # What the first has seen, both have: a refiner of them begins behind that.
    save_checkpoint(small, load_checkpoint(small).network, {**facts, 'training_data': 'icvl-train',
                                                            'training_shards': 3, 'recipe': {'shard_size': 4}})
    tiny(folder, *wanted, f'first={small}', 'last_shard=2', 'samples=4', out=tmp_path / 'behind').train()
    assert load_checkpoint(tmp_path / 'behind' / 'last.safetensors').metadata['training_shards'] == 3
    # And on, from two looks; or with another first.
    again = tiny(folder, *wanted, f'base={last}', out=tmp_path / 'again').objective.network.state_dict()
    assert all(torch.equal(value, trained[name]) for name, value in again.items())
    other = tiny(folder, *wanted, f'base={last}', f'first={large}', 'train_prior=false', out=tmp_path / 'other')
    other = other.objective.network
    assert torch.equal(other.first.maps.weight, base['maps.weight'])
    assert torch.equal(other.second.maps.weight, trained['second.maps.weight'])
    assert not other.second.head.reconstruction.weight.requires_grad


@pytest.mark.parametrize('architecture', ['hand_dense', 'two_looks'])
def test_the_heads_of_a_dense_network_are_trained_for_what_they_say(architecture):
    """Each term falls when its head is right, and joints of mirrored or absent hands teach nothing."""
    torch.manual_seed(0)
    recipe = get_recipe('modern')
    network = build(architecture, joints=21, width=8)
    objective = objective_for(network, recipe, HAND21)
    batch = sample()
    batch = {**batch, 'joints': batch['joints'][:, :21], 'mirrored': torch.tensor([False, False, True, False]),
             'hand_present': torch.tensor([True, True, True, False])}
    before = {key: value.item() for key, value in objective(batch).items()}
    optimizer = torch.optim.Adam(objective.parameters(), 0.01)
    for _ in range(40):
        optimizer.zero_grad()
        sum(objective(batch).values()).backward()
        optimizer.step()
    after = {key: value.item() for key, value in objective(batch).items()}
    assert before.keys() == after.keys() == {'joints', 'maps', 'confidence', 'hand', 'side', 'size'}
    assert all(after[key] < before[key] for key in after)
    changed = {**batch, 'joints': torch.where(torch.tensor([0, 0, 1, 1])[:, None, None] > 0, 9.0, batch['joints'])}
    assert {key: value.item() for key, value in objective(changed).items()} == after


@pytest.mark.timeout(600)
def test_experiments_train_what_is_missing_and_write_table_plot_and_json(folder, tmp_path, monkeypatch):
    assert tuple(experiments.EXPERIMENTS) == NAMES
    monkeypatch.setattr(experiments, 'WIDTHS', (None, 8, 30))
    monkeypatch.setattr(experiments, 'ITERATIONS', 2)
    monkeypatch.setattr(experiments, 'ROUNDS', 1)
    monkeypatch.setattr(experiments, 'TEST_SAMPLES', 4)  # fewer than there are recorded ones: those are all taken
    changes = (*TINY, 'options.dropout=0.1', f'root={folder}', 'samples=24', 'last_shard=3')
    sets = [part for item in changes for part in ('--set', item)]
    recipe = get_recipe('paper', changes)
    begun = Run(tmp_path / 'runs' / 'deep-8', replace(
        recipe, network='deep', options={**recipe.options, 'bottleneck': 8}), Machine(folder / 'cache', workers=0))
    stop_after(begun, 3)
    with pytest.raises(TrainingError, match='an experiment goes on by the same command'):
        begun.train()
    monkeypatch.chdir(tmp_path.parent)
    arguments = ['--out', tmp_path.name, '--workers', '0', '--threads', '1', *sets]
    for name in ('bottleneck', 'refinement', 'joints', 'qualitative', 'runtime'):
        assert main(['experiment', name, *arguments]) == 0
        assert json.loads((tmp_path / f'{name}.json').read_text())['recipe']['samples'] == 24
        assert cv2.imread(str(tmp_path / f'{name}.png')).std() > 5
        assert (tmp_path / f'{name}.md').read_text().count('|') > 20
    runs = {path.name: (path / 'state.safetensors').stat().st_mtime_ns for path in (tmp_path / 'runs').iterdir()}
    assert runs.keys() == {'deep-direct', 'deep-8', 'deep-30', 'deep-30-std_ref', 'deep-30-or_ref'}
    assert load_checkpoint(tmp_path / 'runs' / 'deep-8' / 'last.safetensors').network.config == {
        'joints': 16, 'bottleneck': 8, 'dropout': 0.1}
    results = json.loads((tmp_path / 'refinement.json').read_text())['results']
    assert [result['name'] for result in results] == [
        'deep-30', 'deep-30 + std_ref x1', 'deep-30 + std_ref x2', 'deep-30 + or_ref x1', 'deep-30 + or_ref x2']
    assert len({result['mean_mm'] for result in results}) == 5 and all(result['frames'] == 6 for result in results)
    told = {name: json.loads((tmp_path / f'{name}.json').read_text()) for name in ('joints', 'runtime')}
    twice = told['joints']['results'][2]
    assert twice['name'] == 'deep-30 + or_ref x2' and twice['mean_mm'] == pytest.approx(results[4]['mean_mm'])
    within = ''.join(f' {100 * twice["within_mm"][mm]:.1f} % |' for mm in ('20', '30', '40', '80'))
    assert (tmp_path / 'joints.md').read_text().splitlines()[-1] == (
        f'| deep-30 + or_ref x2 | {twice["mean_mm"]:.2f} | {twice["median_mm"]:.2f} |{within}')
    slow, fast = (told['runtime']['rows'][f'deep|{way}']['p50_ms'] for way in ('eager', 'fast'))
    assert f'| deep | 0.1 | 2.08 | {slow:.2f} | {fast:.2f} |' in (tmp_path / 'runtime.md').read_text()

    monkeypatch.chdir(tmp_path)
    arguments[1] = str(tmp_path)
    for name in ('bottleneck', 'joints'):  # again, and from elsewhere: nothing is trained twice
        assert main(['experiment', name, *arguments]) == 0
    assert all((tmp_path / 'runs' / run / 'state.safetensors').stat().st_mtime_ns == at for run, at in runs.items())
    assert main(['experiment', 'bottleneck', *arguments, '--set', 'knee=0.2']) == 1  # but never another recipe


def test_an_experiment_that_leaves_nothing_for_the_refiner_is_refused_at_once(folder, tmp_path, capsys):
    sets = [part for item in (*TINY, f'root={folder}', 'samples=24') for part in ('--set', item)]
    assert main(['experiment', 'joints', '--out', str(tmp_path), '--workers', '0', *sets]) == 1
    assert 'some of the 4 shards of icvl-train to it, for example with --set last_shard=3' in capsys.readouterr().err
    assert main(['experiment', 'ingredients', '--out', str(tmp_path), '--workers', '0', *sets]) == 1
    assert '--set dataset=icvl: only synthetic hands have ingredients to leave out' in capsys.readouterr().err
    assert not (tmp_path / 'runs').exists()


def test_a_network_is_scored_on_the_test_frames_of_its_dataset(folder, tmp_path, capsys):
    weights, json_file = tmp_path / 'own.safetensors', tmp_path / 'result.json'
    network = build('shallow', joints=16).eval()
    save_checkpoint(weights, network, {'skeleton': 'icvl16', 'cube_side': 0.25})
    arguments = ['evaluate', 'icvl', '--root', str(folder), '--device', 'cpu']
    for split, frames in ((['--split', 'test_1'], 3), ([], 6)):
        assert main([*arguments, *split, '--model', str(weights), '--json', str(json_file)]) == 0
        summary = json.loads(json_file.read_text())
        assert summary['frames'] == frames
    batch = open_dataset('icvl', 'test', folder).batch(torch.arange(6))
    cube = batch['cube_center'], batch['cube_side']
    with torch.no_grad():
        joints = load_checkpoint(weights).network(batch['patch'])
    apart = joints_in_metres(joints, *cube) - joints_in_metres(batch['joints'], *cube)
    assert summary['mean_mm'] == pytest.approx(1000 * float(apart.norm(dim=-1).mean()), abs=0.01)

    assert main([*arguments, '--model', 'hand_dense']) == 1
    assert 'its joints are those of hand21, but icvl has those of icvl16' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(['evaluate', 'icvl'])
    assert 'give its folder with --root' in capsys.readouterr().err


def test_command_line(tmp_path, folder, capsys):
    assert main(['train', 'papers', '--out', str(tmp_path)]) == 1
    assert "unknown recipe 'papers'" in capsys.readouterr().err
    assert main(['train', '--resume', '--out', str(tmp_path)]) == 1
    assert 'holds no run to resume' in capsys.readouterr().err
    for wrong in (['train', '--out', str(tmp_path)], ['train', 'paper', '--out', str(tmp_path), '--resume']):
        with pytest.raises(SystemExit) as error:
            main(wrong)
        assert error.value.code == 2
