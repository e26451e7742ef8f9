"""DeepPrior++ (Oberweger and Lepetit 2017): a residual network with pre-activation, and the pose prior."""

from __future__ import annotations

from torch import Tensor, nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models.prior_net import PoseNetwork, relu_conv


class ResNet(PoseNetwork):
    """A stem, four stages of residual blocks, and the head of Deep-Prior (original code).

    Args:
        joints: number of joints, J.
        bottleneck: number of coefficients of the pose prior; None = no prior.
        dropout: share of hidden units of the head that are dropped while training.
        channels: of the stem and the stages.
        blocks: number of blocks in each stage.
        last_stride: stride of the last stage. 1 is the network that the authors' code builds (18.7 M parameters with 14
            joints), because it asks an identity for a stride of 2, which has none. 2 is the network that was meant
            (6.2 M parameters, and faster).

    Raises:
        HandPoseError: `channels` are not two numbers or more of at least 4.
    """

    def __init__(self, joints: int = 21, bottleneck: int | None = 30, dropout: float = 0.3,
                 channels: tuple[int, ...] = (32, 64, 128, 256, 256), blocks: int = 5,
                 last_stride: int = 1) -> None:
        if len(channels) < 2 or min(channels) < 4:
            raise HandPoseError(f'channels {list(channels)}: give two numbers or more, each at least 4')
        stem, *stages = channels
        layers: list[nn.Module] = [relu_conv(1, stem, 5, padding=2), nn.MaxPool2d(2)]
        for inputs, outputs in zip(channels, stages, strict=False):
            # Where the number of channels stays, the original keeps the identity, and so the resolution.
            stride = 2 if inputs != outputs else last_stride
            layers.append(_Block(inputs, outputs, stride))
            layers += [_Block(outputs, outputs, 1) for _ in range(blocks - 1)]
        layers += [_norm(stages[-1]), nn.ReLU(), nn.Flatten()]
        super().__init__(nn.Sequential(*layers), joints, bottleneck, dropout=dropout)


class _Block(nn.Module):
    """A bottleneck block (norm, ReLU, 1x1, norm, ReLU, 3x3, norm, ReLU, 1x1) plus a shortcut.

    The shortcut is the identity, or a 1x1 projection of what the first ReLU gives where the shape changes.
    """

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        inner = outputs // 4
        self.activation = nn.Sequential(_norm(inputs), nn.ReLU())
        self.body = nn.Sequential(
            relu_conv(inputs, inner, 1, stride=stride), _norm(inner), nn.ReLU(),
            relu_conv(inner, inner, 3, padding=1), _norm(inner), nn.ReLU(),
            relu_conv(inner, outputs, 1))
        same = (inputs, 1) == (outputs, stride)
        self.projection = None if same else relu_conv(inputs, outputs, 1, stride=stride)

    def forward(self, x: Tensor) -> Tensor:
        active = self.activation(x)
        return self.body(active) + (x if self.projection is None else self.projection(active))


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-4, momentum=0.1)
