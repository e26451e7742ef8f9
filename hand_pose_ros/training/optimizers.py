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
    """RMSProp of the original code. The decay is 0.9, and the root mean square is at least 0.01."""

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
    """Muon (Jordan et al. 2024) for the weights of convolutions, and AdamW for all other parameters.

    The steps of Muon are orthogonal matrices. Such a step moves all directions of a weight equally far, not only those
    that most gradients share.
    """

    MOMENTUM = 0.95
    STEP = 0.8
    """Root mean square of a step at a learning rate of 1. With 0.2, steps are usually as large as those of AdamW (Liu
    et al. 2025, Muon is Scalable for LLM Training). Our small networks need four times as much."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            alike: dict[tuple[int, ...], list[Tensor]] = {}  # weights of one shape are computed together
            for parameter in group['params']:
                if parameter.ndim == 4 and parameter.grad is not None:
                    alike.setdefault(tuple(parameter.flatten(1).shape), []).append(parameter)
            for shape, parameters in alike.items():
                size = self.STEP * group['lr'] * max(shape) ** 0.5  # the entries of an orthogonal matrix are small
                steps = torch.stack([self._nesterov(parameter).flatten(1) for parameter in parameters])
                for parameter, step in zip(parameters, orthogonal(steps), strict=True):
                    parameter.mul_(1 - group['lr'] * group['weight_decay'])
                    parameter.add_(step.view_as(parameter), alpha=-size)
                    parameter.grad = None  # so that AdamW leaves this parameter alone
        super().step()

    def _nesterov(self, parameter: Tensor) -> Tensor:
        state = self.state[parameter]
        if not state:
            # AdamW expects a step in every state.
            state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
        assert parameter.grad is not None
        state['momentum'].lerp_(parameter.grad, 1 - self.MOMENTUM)
        return parameter.grad.lerp(state['momentum'], self.MOMENTUM)


def orthogonal(matrices: Tensor) -> Tensor:
    """Matrices (N, A, B) -> approximately the nearest matrices whose singular values are all 1.

    Most singular values become 0.68 to 1.14. Those that were hundreds of times smaller than the largest become less.
    There are five Newton-Schulz steps (Jordan et al. 2024). All are polynomials of one small symmetric matrix. So they
    are computed on this matrix and applied once, which takes a third of the time.
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
    """The optimiser of a recipe, for all parameters that require gradients. Biases and norms have no weight decay.

    Raises:
        HandPoseError: the optimiser cannot do what the recipe says.
    """
    wanted = {name: p for name, p in network.named_parameters() if p.requires_grad}
    decayed = {name for name, p in wanted.items() if p.ndim > 1 and 'bias' not in name}
    groups = [{'params': [p for name, p in wanted.items() if name in decayed], 'weight_decay': recipe.weight_decay},
              {'params': [p for name, p in wanted.items() if name not in decayed], 'weight_decay': 0.0}]
    if recipe.optimizer == 'sgd':
        return torch.optim.SGD(groups, lr=recipe.learning_rate, momentum=recipe.momentum)
    if recipe.optimizer == 'rmsprop':
        if recipe.momentum or recipe.weight_decay:
            raise HandPoseError('rmsprop has no momentum and no weight decay, as in the original code: give '
                                '--set momentum=0 --set weight_decay=0')
        return FlooredRMSProp(list(wanted.values()), lr=recipe.learning_rate)
    if recipe.optimizer == 'adamw':
        return torch.optim.AdamW(groups, lr=recipe.learning_rate)
    return Muon(groups, lr=recipe.learning_rate)


def learning_rate(recipe: Recipe, progress: float) -> float:
    """The learning rate after a share of the budget (`progress`, in [0, 1]).

    - 'constant': always the same.
    - 'hyperbolic': rate / (1 + 0.2 * epoch), where the first epoch is 1 (original code).
    - 'cosine': falls to 0.
    """
    rate = recipe.learning_rate * (min(1.0, progress / recipe.warmup) if recipe.warmup else 1.0)
    if recipe.schedule == 'constant':
        return rate
    if recipe.schedule == 'hyperbolic':
        return rate / (1 + 0.2 * (1 + int(progress * recipe.epochs + 1e-6)))
    return rate * 0.5 * (1 + math.cos(math.pi * progress))
