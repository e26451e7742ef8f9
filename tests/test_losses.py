"""What is learned: losses are those of their formulas, and each head of a network is trained for what it says."""

import numpy as np
import pytest
import torch
from test_augmentation import sample

from hand_pose_ros.models import build
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.training.losses import joint_loss
from hand_pose_ros.training.objectives import objective_for
from hand_pose_ros.training.recipes import get_recipe

pytestmark = pytest.mark.usefixtures('one_thread')


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
