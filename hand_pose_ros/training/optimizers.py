"""Optimisers and learning-rate schedules, by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.training.recipes import Recipe


class FlooredRMSProp(Optimizer):
    """RMSProp of the original code: decay 0.9, and the root mean square floored at 0.01, with nothing added."""

    def __init__(self, params: Any, lr: float) -> None:
        super().__init__(params, {'lr': lr})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            for parameter in group['params']:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state['square'] = torch.zeros_like(parameter)
                state['square'].mul_(0.9).addcmul_(parameter.grad, parameter.grad, value=0.1)
                parameter.addcdiv_(parameter.grad, state['square'].sqrt().clamp_(min=0.01), value=-group['lr'])


class Muon(torch.optim.AdamW):
    """AdamW, but that the weights of convolutions take steps that are orthogonal matrices (Jordan et al. 2024, Muon).

    Such a step moves all directions of a weight equally far, not only those that most gradients share.
    """

    MOMENTUM = 0.95
    STEP = 0.8
    """Root mean square of a step at a learning rate of 1. With 0.2 it is as large as one of AdamW usually is (Liu et
    al. 2025, Muon is Scalable for LLM Training); our small networks want four times that."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            alike: dict[tuple[int, ...], list[Tensor]] = {}  # a GPU does all weights of one shape at once
            for parameter in group['params']:
                if parameter.ndim == 4 and parameter.grad is not None:
                    alike.setdefault(tuple(parameter.flatten(1).shape), []).append(parameter)
            for shape, parameters in alike.items():
                size = self.STEP * group['lr'] * max(shape) ** 0.5  # of an orthogonal matrix every entry is small
                steps = torch.stack([self._nesterov(parameter).flatten(1) for parameter in parameters])
                for parameter, step in zip(parameters, orthogonal(steps), strict=True):
                    parameter.mul_(1 - group['lr'] * group['weight_decay'])
                    parameter.add_(step.view_as(parameter), alpha=-size)
                    parameter.grad = None  # the rest is for AdamW
        super().step()

    def _nesterov(self, parameter: Tensor) -> Tensor:
        state = self.state[parameter]
        if not state:
            # AdamW looks for a step in every state that it reads.
            state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
        assert parameter.grad is not None
        state['momentum'].lerp_(parameter.grad, 1 - self.MOMENTUM)
        return parameter.grad.lerp(state['momentum'], self.MOMENTUM)


def orthogonal(matrices: Tensor) -> Tensor:
    """About the nearest to each of these matrices (N, A, B) whose singular values are all 1: most come out between 0.68
    and 1.14, those that were hundreds of times smaller than the largest below.

    Five Newton-Schulz steps (Jordan et al. 2024). All are polynomials of one small symmetric matrix, so they are
    worked out there and applied once, in a third of the time.
    """
    a, b, c = 3.4445, -4.7750, 2.0315
    wide = matrices.shape[1] <= matrices.shape[2]
    x = matrices if wide else matrices.mT
    x = x / (x.norm(dim=(1, 2), keepdim=True) + 1e-7)
    square = x @ x.mT
    whole = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
    for _ in range(5):
        step = torch.baddbmm(square, square, square, beta=b, alpha=c)
        step.diagonal(dim1=1, dim2=2).add_(a)
        whole, square = step @ whole, step @ square @ step
    x = whole @ x
    return x if wide else x.mT


def make_optimizer(recipe: Recipe, network: nn.Module) -> Optimizer:
    """The optimiser of a recipe for all parameters that want gradients; biases and norms are not decayed.

    Raises:
        HandPoseError: one that cannot do what the recipe says.
    """
    wanted = {name: p for name, p in network.named_parameters() if p.requires_grad}
    decayed = {name for name, p in wanted.items() if p.ndim > 1 and 'bias' not in name}
    groups = [{'params': [p for name, p in wanted.items() if name in decayed], 'weight_decay': recipe.weight_decay},
              {'params': [p for name, p in wanted.items() if name not in decayed], 'weight_decay': 0.0}]
    if recipe.optimizer == 'sgd':
        return torch.optim.SGD(groups, lr=recipe.learning_rate, momentum=recipe.momentum)
    if recipe.optimizer == 'rmsprop':
        if recipe.momentum or recipe.weight_decay:
            raise HandPoseError('rmsprop is that of the original code, without momentum and weight decay: '
                                '--set momentum=0 --set weight_decay=0')
        return FlooredRMSProp(list(wanted.values()), lr=recipe.learning_rate)
    if recipe.optimizer == 'adamw':
        return torch.optim.AdamW(groups, lr=recipe.learning_rate)
    return Muon(groups, lr=recipe.learning_rate)


def learning_rate(recipe: Recipe, progress: float) -> float:
    """The learning rate after this share of the budget, in [0, 1].

    'constant'; 'hyperbolic', in steps by epoch, rate / (1 + 0.2 epoch) with the first epoch 1 (original code);
    'cosine', down to 0.
    """
    rate = recipe.learning_rate * (min(1.0, progress / recipe.warmup) if recipe.warmup else 1.0)
    if recipe.schedule == 'constant':
        return rate
    if recipe.schedule == 'hyperbolic':
        return rate / (1 + 0.2 * (1 + int(progress * recipe.epochs + 1e-6)))
    return rate * 0.5 * (1 + math.cos(math.pi * progress))
