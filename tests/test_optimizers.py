"""What optimizers promise: steps as large as their formulas and schedules say, in the directions that they say."""

import copy
from dataclasses import replace

import pytest
import torch
from torch import nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models import build
from hand_pose_ros.training.optimizers import learning_rate, make_optimizer, orthogonal
from hand_pose_ros.training.recipes import RECIPES, get_recipe


def test_learning_rates_follow_their_schedules():
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
