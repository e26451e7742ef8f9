"""DeepPrior++ (Oberweger and Lepetit 2017): a pre-activation bottleneck residual network with the prior."""

from __future__ import annotations

from torch import Tensor, nn

from hand_pose_ros.models.prior_net import PoseNetwork, relu_conv


class ResNet(PoseNetwork):
    """Stem, four stages of `blocks` blocks, and the head of Deep-Prior (original code).

    `last_stride` 1 is the network that the authors' code builds (its last stage asks for stride 2, which an
    identity ignores): 18.7 M parameters at 14 joints. 2 is the network that was meant: 6.2 M, and faster.
    """

    def __init__(self, joints: int = 21, bottleneck: int | None = 30, dropout: float = 0.3,
                 channels: tuple[int, ...] = (32, 64, 128, 256, 256), blocks: int = 5,
                 last_stride: int = 1) -> None:
        stem, *stages = channels
        layers: list[nn.Module] = [relu_conv(1, stem, 5, padding=2), nn.MaxPool2d(2)]
        for inputs, outputs in zip(channels, stages, strict=False):
            # Without a change of channels the original keeps the identity, and with it the resolution.
            stride = 2 if inputs != outputs else last_stride
            layers.append(_Block(inputs, outputs, stride))
            layers += [_Block(outputs, outputs, 1) for _ in range(blocks - 1)]
        layers += [_norm(stages[-1]), nn.ReLU(), nn.Flatten()]
        super().__init__(nn.Sequential(*layers), joints, bottleneck, dropout=dropout)


class _Block(nn.Module):
    """norm-ReLU-1x1-norm-ReLU-3x3-norm-ReLU-1x1 plus the identity, or a 1x1 projection of the first ReLU."""

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
