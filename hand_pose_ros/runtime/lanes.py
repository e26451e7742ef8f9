"""Rearranges convolutions with few channels for processors that work on 16 numbers at a time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LANES = 16
"""Number of float32 values in an AVX-512 register, and of channels in a block of ONNX Runtime's convolutions there."""


class PairedConvolution(nn.Module):
    """Valid convolution with at most LANES / 2 channels, ReLU, and max pooling of even width, two pixels at a time.

    With 8 channels, half of the lanes would be idle. So each filter is made one pixel wider and used twice: with its
    weights on the left, and on the right. This gives two neighbouring pixels as 16 channels. The last step of the
    pooling takes their maximum. The arithmetic is the same, except for additional products with zero.
    """

    def __init__(self, convolution: nn.Conv2d, pool: int) -> None:
        super().__init__()
        channels, _, height, width = convolution.weight.shape
        self.channels = channels
        self.pair = nn.Conv2d(convolution.in_channels, 2 * channels, (height, width + 1), stride=(1, 2),
                              bias=convolution.bias is not None)
        self.pool = nn.MaxPool2d((pool, pool // 2))
        with torch.no_grad():
            self.pair.weight.zero_()
            self.pair.weight[:channels, :, :, :width] = convolution.weight
            self.pair.weight[channels:, :, :, 1:] = convolution.weight
            if convolution.bias is not None and self.pair.bias is not None:
                self.pair.bias.copy_(convolution.bias.repeat(2))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> the result of convolution, pooling and ReLU. In this order, ReLU costs nothing."""
        pooled = self.pool(torch.relu(self.pair(x)))
        return torch.maximum(pooled[:, :self.channels], pooled[:, self.channels:])


def fill_lanes(module: nn.Module) -> None:
    """In every Sequential of a small convolution, its pooling and ReLU, replace them by a `PairedConvolution`."""
    for each in module.modules():
        if not isinstance(each, nn.Sequential) or len(each) != 3:
            continue
        convolution, pool, relu = each
        if not (isinstance(convolution, nn.Conv2d) and isinstance(pool, nn.MaxPool2d) and isinstance(relu, nn.ReLU)):
            continue
        size = pool.kernel_size
        if isinstance(size, int) and size % 2 == 0 and _is_plain(convolution, pool):
            each[0], each[1], each[2] = PairedConvolution(convolution, size), nn.Identity(), nn.Identity()


def _is_plain(convolution: nn.Conv2d, pool: nn.MaxPool2d) -> bool:
    return (2 * convolution.out_channels <= LANES and convolution.groups == 1 and convolution.stride == (1, 1)
            and convolution.padding == (0, 0) and convolution.dilation == (1, 1)
            and pool.stride == pool.kernel_size and not pool.padding and not pool.ceil_mode)
