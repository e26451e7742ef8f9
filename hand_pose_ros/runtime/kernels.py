"""GPU kernels of our own (in Triton). Each does in one kernel what PyTorch does for small layers in three to thirty.

For one hand, the number of kernels decides the time, at two to three microseconds each; what they compute does not.
There are three kernels: a convolution of few channels with its pooling and ReLU, a linear layer with its ReLU, and the
cut around a joint of the refiner. All read and write the precision of their input, and compute in float32.
"""

# Functions that Triton compiles take pointers and numbers of Triton's types.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor, nn

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.refiner import Region

HANDS = 16
"""With more hands at a time, PyTorch is faster. These kernels read the weights again for each hand, and the pixels
again for each filter."""
_PROGRAMS, _LARGE, _SMALL = 128, 512, 128
"""About the number of processors of a GPU; the number of values per program if there are enough programs for all
processors; and the same if there are not."""


@triton.jit
def _convolve(x, weight, bias, y, groups, height, width, rows, columns, s_filter, s_channel, s_row, s_column,
              INPUTS: tl.constexpr, FILTERS: tl.constexpr, SIZE: tl.constexpr, POOL: tl.constexpr,
              CELLS: tl.constexpr):
    """One group of one image: FILTERS at CELLS places of the answer, with all positions that are pooled for them."""
    plane = tl.program_id(0)
    group = plane % groups
    plane = plane.to(tl.int64)
    cell = tl.program_id(1) * CELLS + tl.arange(0, CELLS)
    inside = cell < rows * columns
    pooled = tl.arange(0, POOL * POOL)
    row = (cell // columns)[:, None] * POOL + (pooled // POOL)[None, :]
    column = (cell % columns)[:, None] * POOL + (pooled % POOL)[None, :]
    x += plane * INPUTS * height * width + row * width + column  # (CELLS, POOL * POOL)
    number = tl.arange(0, FILTERS)
    weight += (group * FILTERS + number) * s_filter
    total = tl.zeros((CELLS, POOL * POOL, FILTERS), tl.float32)
    for channel in range(INPUTS):
        for i in tl.static_range(SIZE):
            for j in tl.static_range(SIZE):
                pixels = tl.load(x + (channel * height + i) * width + j, mask=inside[:, None], other=0)
                taps = tl.load(weight + channel * s_channel + i * s_row + j * s_column)
                total += pixels.to(tl.float32)[:, :, None] * taps.to(tl.float32)[None, None, :]
    answer = tl.max(total, axis=1) + tl.load(bias + group * FILTERS + number).to(tl.float32)[None, :]
    y += (plane * FILTERS + number)[None, :] * (rows * columns) + cell[:, None]
    tl.store(y, tl.maximum(answer, 0).to(y.dtype.element_ty), mask=inside[:, None])


@triton.jit
def _linear(x, weight, bias, y, inputs, outputs, RELU: tl.constexpr, OUTPUTS: tl.constexpr, BLOCK: tl.constexpr):
    """OUTPUTS values for one hand."""
    hand = tl.program_id(0)
    number = tl.program_id(1) * OUTPUTS + tl.arange(0, OUTPUTS)
    within = number < outputs
    total = tl.zeros((OUTPUTS, BLOCK), tl.float32)
    for start in range(0, inputs, BLOCK):
        at = start + tl.arange(0, BLOCK)
        values = tl.load(x + hand * inputs + at, mask=at < inputs, other=0)
        factors = tl.load(weight + number[:, None] * inputs + at[None, :],
                          mask=within[:, None] & (at < inputs)[None, :], other=0)
        total += values.to(tl.float32)[None, :] * factors.to(tl.float32)
    answer = tl.sum(total, axis=1) + tl.load(bias + number, mask=within, other=0).to(tl.float32)
    if RELU:
        answer = tl.maximum(answer, 0)
    tl.store(y + hand * outputs + number, answer.to(y.dtype.element_ty), mask=within)


@triton.jit
def _cut(image, joints, window, count, size, stride, reach, CELLS: tl.constexpr, LINES: tl.constexpr):
    """LINES rows of the window around one joint, as in `models.refiner.cut`, which explains it."""
    which = tl.program_id(0)
    hand = (which // count).to(tl.int64)
    x, y, z = tl.load(joints + which * 3), tl.load(joints + which * 3 + 1), tl.load(joints + which * 3 + 2)
    furthest = 1 + reach
    x = (tl.minimum(tl.maximum(x, -furthest), furthest) + 1) * (size / 2) + CELLS / 2
    y = (tl.minimum(tl.maximum(y, -furthest), furthest) + 1) * (size / 2) + CELLS / 2
    left, top = tl.floor(x), tl.floor(y)
    x, y = x - left, y - top
    line, column = tl.program_id(1) * LINES + tl.arange(0, LINES), tl.arange(0, CELLS)
    image += hand * stride * stride + (top.to(tl.int32) + line)[:, None] * stride
    image += (left.to(tl.int32) + column)[None, :]
    above = _between(_relative(image, z, reach), _relative(image + 1, z, reach), x)
    below = _between(_relative(image + stride, z, reach), _relative(image + stride + 1, z, reach), x)
    window += which.to(tl.int64) * CELLS * CELLS + line[:, None] * CELLS + column[None, :]
    tl.store(window, _between(above, below, y).to(window.dtype.element_ty))


@triton.jit
def _relative(image, z, reach):
    """Depth from the front (-1) to the back (1) of the cube around a joint."""
    return tl.minimum(tl.maximum((tl.load(image).to(tl.float32) - z) / reach, -1), 1)


@triton.jit
def _between(first, second, fraction):
    return first + (second - first) * fraction


COMPILED = isinstance(_cut, triton.JITFunction)
"""Whether kernels are compiled. With TRITON_INTERPRET=1 they are interpreted on the CPU."""


def fits(layer: nn.Conv2d, pool: int) -> bool:
    """Whether `convolve` can compute this layer, and is worth using: few filters in a group. Tensor cores need many.
    """
    each = layer.out_channels // layer.groups
    return (layer.padding == (0, 0) and layer.stride == (1, 1) and layer.dilation == (1, 1) and layer.bias is not None
            and layer.kernel_size[0] == layer.kernel_size[1] and each in (4, 8, 16) and pool in (1, 2, 4))


def convolve(x: Tensor, layer: nn.Conv2d, pool: int) -> Tensor:
    """Convolution, max-pooling and ReLU: (N, C, H, W) -> (N, F, (H - K + 1) // pool, (W - K + 1) // pool)."""
    x = x.contiguous()
    hands, _, height, width = x.shape
    filters, inputs, size, _ = layer.weight.shape
    rows, columns = ((side - size + 1) // pool for side in (height, width))
    y = x.new_empty(hands, filters, rows, columns)
    each = filters // layer.groups
    values = _LARGE if y.numel() * pool * pool >= _LARGE * _PROGRAMS else _SMALL
    cells = max(1, values // (each * pool * pool))
    _convolve[(hands * layer.groups, triton.cdiv(rows * columns, cells))](
        x, layer.weight, layer.bias, y, layer.groups, height, width, rows, columns, *layer.weight.stride(),
        INPUTS=inputs, FILTERS=each, SIZE=size, POOL=pool, CELLS=cells)
    return y


def linear(x: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
    """x (N, I), weight (O, I) and bias (O,) -> (N, O), with ReLU if `relu`."""
    x = x.contiguous()
    outputs, inputs = weight.shape
    y, each = x.new_empty(len(x), outputs), 4
    _linear[(len(x), triton.cdiv(outputs, each))](x, weight, bias, y, inputs, outputs, RELU=relu, OUTPUTS=each,
                                                  BLOCK=min(512, triton.next_power_of_2(inputs)))
    return y


def cut(image: Tensor, joints: Tensor, region: Region) -> Tensor:
    """As `models.refiner.cut`, for regions whose window width is a power of two."""
    cells, lines, (hands, count, _) = region.width // region.shrink, 8, joints.shape
    windows = image.new_empty(hands, count, cells, cells)
    _cut[(hands * count, cells // lines)](
        image.contiguous(), joints.float().contiguous(), windows, count, PATCH_SIZE // region.shrink, image.shape[-1],
        region.width / PATCH_SIZE, CELLS=cells, LINES=lines)
    return windows
