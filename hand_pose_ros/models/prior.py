"""The pose prior: the principal components of poses, and the heads of networks that start from them (paper, 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from hand_pose_ros.errors import HandPoseError


@dataclass(frozen=True)
class PosePrior:
    """A linear model of poses: pose = coefficients @ components + mean. A pose has x, y, z by joint, in cube units."""

    mean: NDArray[np.float64]
    """(3J,)"""
    components: NDArray[np.float64]
    """(k, 3J), orthonormal rows. The one with the largest variance is first."""
    explained_variance_ratio: NDArray[np.float64]
    """(k,), the share of each component in the total variance."""

    def project(self, poses: ArrayLike) -> NDArray[np.float64]:
        """Poses (..., 3J) -> coefficients (..., k)."""
        return (np.asarray(poses) - self.mean) @ self.components.T

    def reconstruct(self, coefficients: ArrayLike) -> NDArray[np.float64]:
        """Coefficients (..., k) -> poses (..., 3J)."""
        return np.asarray(coefficients) @ self.components + self.mean


def fit_prior(poses: ArrayLike, components: int = 30) -> PosePrior:
    """Principal component analysis of poses. They are centred, but not whitened.

    Args:
        poses: (N, 3J) or (N, J, 3), in cube units.
        components: number of components to keep. The paper finds 30 best.

    Raises:
        HandPoseError: there are fewer poses or coordinates than components, or a pose is not finite.
    """
    poses = np.asarray(poses, np.float64)
    poses = poses.reshape(len(poses), -1)
    if min(poses.shape) < components:
        raise HandPoseError(f'{components} components need at least as many poses and coordinates, '
                            f'but there are {poses.shape[0]} poses of {poses.shape[1]} coordinates: choose fewer '
                            'components (--set options.bottleneck=N), or give more poses')
    if not np.isfinite(poses).all():
        raise HandPoseError('the poses for the prior hold values that are not finite')
    mean = poses.mean(0)
    # The covariance is 3J x 3J, however many poses there are.
    centred = poses - mean
    variance, vectors = np.linalg.eigh(centred.T @ centred)
    variance, vectors = variance[::-1].clip(min=0), vectors[:, ::-1].T
    kept = vectors[:components]
    # An eigenvector has no sign of its own. Its largest entry is made positive, so that all machines agree.
    kept = kept * np.sign(kept[np.arange(components), np.abs(kept).argmax(1)])[:, None]
    return PosePrior(mean, kept, variance[:components] / max(variance.sum(), np.finfo(float).tiny))


class PoseHead(nn.Module):
    """Fully connected layers from features to joints.

    Without a bottleneck, the last layer gives the joints. With one, it gives `bottleneck` coefficients, and the
    reconstruction turns them into joints. The reconstruction is an ordinary linear layer. It starts from the principal
    components (`set_prior`) and is trained like the other layers.

    Args:
        features: number of inputs.
        joints: number of joints, J.
        bottleneck: number of coefficients of the pose prior; None = no prior.
        hidden: widths of the hidden layers. Each is followed by ReLU and dropout.
        dropout: share of hidden units that are dropped while training.
    """

    def __init__(self, features: int, joints: int, bottleneck: int | None, hidden: Sequence[int],
                 dropout: float) -> None:
        super().__init__()
        self.joints = joints
        layers: list[nn.Module] = []
        for width in hidden:
            layers += [relu_linear(features, width), nn.ReLU(), nn.Dropout(dropout)]
            features = width
        self.hidden = nn.Sequential(*layers)
        self.output = plain_linear(features, bottleneck or 3 * joints)
        self.reconstruction = plain_linear(bottleneck, 3 * joints) if bottleneck else None

    def set_prior(self, mean: ArrayLike, components: ArrayLike) -> None:
        """Start the reconstruction from a mean (3J,) and components (bottleneck, 3J)."""
        _set_reconstruction(self.reconstruction, mean, components)

    def forward(self, features: Tensor) -> Tensor:  # (B, F) -> (B, J, 3)
        output = self.output(self.hidden(features))
        if self.reconstruction is not None:
            output = self.reconstruction(output)
        return output.view(-1, self.joints, 3)


class PriorOverVotes(nn.Module):
    """Turns joints that were found one by one into one hand. Joints that are not seen follow from those that are.

    The joints are projected onto the principal components. A hidden layer sees all joints and how sure each is, and
    moves the coefficients. The reconstruction turns them into joints again. At first this is the projection onto the
    prior, and then all layers are trained.
    """

    HIDDEN = 256

    def __init__(self, joints: int, bottleneck: int) -> None:
        super().__init__()
        self.projection = plain_linear(3 * joints, bottleneck)
        self.hidden = plain_linear(4 * joints, self.HIDDEN)
        self.output = nn.Linear(self.HIDDEN, bottleneck)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)
        self.reconstruction = plain_linear(bottleneck, 3 * joints)

    def set_prior(self, mean: ArrayLike, components: ArrayLike) -> None:
        """Start projection and reconstruction from a mean (3J,) and components (bottleneck, 3J)."""
        _set_reconstruction(self.reconstruction, mean, components)
        with torch.no_grad():
            self.projection.weight.copy_(self.reconstruction.weight.T)
            self.projection.bias.copy_(-self.projection.weight @ self.reconstruction.bias)

    def forward(self, joints: Tensor, confidence: Tensor) -> Tensor:
        """Joints (B, J, 3) in cube units, and logits (B, J) of how sure they are -> joints (B, J, 3)."""
        dtype = self.projection.weight.dtype
        joints, confidence = joints.to(dtype), confidence.to(dtype)
        moved = self.output(F.relu(self.hidden(torch.cat([joints.flatten(1), confidence / 4], dim=1))))
        return self.reconstruction(self.projection(joints.flatten(1)) + moved).view_as(joints)


def _set_reconstruction(layer: nn.Linear | None, mean: ArrayLike, components: ArrayLike) -> None:
    if layer is None:
        raise HandPoseError('a network without a bottleneck takes no prior')
    weight, bias = (torch.as_tensor(np.asarray(a), dtype=torch.float32) for a in (components, mean))
    if weight.T.shape != layer.weight.shape or bias.shape != layer.bias.shape:
        raise HandPoseError(
            f'a prior with components {tuple(weight.shape)} and mean {tuple(bias.shape)} does not fit '
            f'a bottleneck of {layer.in_features} and {layer.out_features // 3} joints')
    with torch.no_grad():
        layer.weight.copy_(weight.T)
        layer.bias.copy_(bias)


def relu_linear(inputs: int, outputs: int) -> nn.Linear:
    """A fully connected layer before a ReLU. Weights from N(0, 0.01), zero bias (original code)."""
    layer = nn.Linear(inputs, outputs)
    nn.init.normal_(layer.weight, std=0.01)
    nn.init.zeros_(layer.bias)
    return layer


def plain_linear(inputs: int, outputs: int) -> nn.Linear:
    """A fully connected layer without a ReLU. Uniform weights (Glorot and Bengio 2010), zero bias (original code)."""
    layer = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
