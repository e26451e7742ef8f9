"""A convolution and a linear layer, each with what follows it."""

# Functions that Triton compiles take pointers and numbers of Triton's types.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

HANDS = 16
"""With more hands at a time, PyTorch is faster for most layers."""
FEW = 8
"""With so few filters, tensor cores would idle in PyTorch's convolutions."""


@triton.jit
def _convolve(x, weight, bias, added, y, groups, height, width, rows, columns,
              x_hand, x_channel, x_row, x_column, w_filter, w_channel, w_row, w_column,
              a_hand, a_channel, a_row, a_column, y_hand, y_channel, y_row, y_column,
              INPUTS: tl.constexpr, FILTERS: tl.constexpr, SIZE: tl.constexpr, STRIDE: tl.constexpr,
              PADDING: tl.constexpr, POOL: tl.constexpr, RELU: tl.constexpr, ENLARGED: tl.constexpr,
              PLACES: tl.constexpr, TILE: tl.constexpr, PARTS: tl.constexpr, STEP: tl.constexpr):
    """TILE filters of one group at PLACES of one image: a matrix product over channels and taps, in PARTS at a time.

    Places that are pooled are neighbours. What is added is enlarged by ENLARGED; 0 = nothing is added.
    """
    hand, group = (tl.program_id(0) // groups).to(tl.int64), tl.program_id(0) % groups
    place = tl.program_id(1) * PLACES + tl.arange(0, PLACES)
    cell, pooled = place // (POOL * POOL), place % (POOL * POOL)
    inside = (cell < rows * columns)[None, :, None]
    top = ((cell // columns * POOL + pooled // POOL) * STRIDE - PADDING)[None, :, None]
    left = ((cell % columns * POOL + pooled % POOL) * STRIDE - PADDING)[None, :, None]
    number = tl.program_id(2) * TILE + tl.arange(0, TILE)
    wanted = number < FILTERS
    x += hand * x_hand + group * INPUTS * x_channel
    weight += (group * FILTERS + number)[None, None, :] * w_filter
    total = tl.zeros((PARTS, PLACES, TILE), tl.float32)
    for start in range(0, INPUTS * SIZE * SIZE, PARTS * STEP):
        k = start + tl.arange(0, PARTS)[:, None] * STEP + tl.arange(0, STEP)[None, :]
        used = k < INPUTS * SIZE * SIZE
        channel, i, j = k % INPUTS, k // INPUTS // SIZE, k // INPUTS % SIZE
        row, column = top + i[:, None, :], left + j[:, None, :]
        there = inside & used[:, None, :] & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        pixels = tl.load(x + row * x_row + column * x_column + channel[:, None, :] * x_channel, mask=there, other=0)
        taps = tl.load(weight + (channel * w_channel + i * w_row + j * w_column)[:, :, None],
                       mask=used[:, :, None] & wanted[None, None, :], other=0)
        # Tensor cores compute float32 from three products, to nearly all of its digits.
        total = tl.dot(pixels.to(taps.dtype), taps, total, input_precision='tf32x3')
    total = tl.sum(total, axis=0)
    WINDOWS: tl.constexpr = PLACES // (POOL * POOL)
    if POOL > 1:
        total = tl.max(tl.reshape(total, (WINDOWS, POOL * POOL, TILE)), axis=1)
    cell = tl.program_id(1) * WINDOWS + tl.arange(0, WINDOWS)
    kept = (cell < rows * columns)[:, None] & wanted[None, :]
    row, column, filters = (cell // columns)[:, None], (cell % columns)[:, None], (group * FILTERS + number)[None, :]
    total += tl.load(bias + filters, mask=wanted[None, :], other=0).to(tl.float32)
    if ENLARGED > 0:
        total += tl.load(added + hand * a_hand + filters * a_channel + row // ENLARGED * a_row
                         + column // ENLARGED * a_column, mask=kept, other=0).to(tl.float32)
    if RELU:
        total = tl.maximum(total, 0)
    tl.store(y + hand * y_hand + filters * y_channel + row * y_row + column * y_column,
             total.to(y.dtype.element_ty), mask=kept)


def fits(layer: nn.Conv2d, pool: int) -> bool:
    """Whether `convolve` can compute this layer."""
    return (layer.kernel_size[0] == layer.kernel_size[1] and layer.stride[0] == layer.stride[1]
            and isinstance(layer.padding, tuple) and layer.padding[0] == layer.padding[1]
            and layer.padding_mode == 'zeros' and layer.dilation == (1, 1) and layer.bias is not None
            and pool in (1, 2, 4))


def gains(layer: nn.Conv2d, hands: int) -> bool:
    """Whether `convolve` is faster than PyTorch: for few hands, and for few filters."""
    return hands <= HANDS or layer.out_channels // layer.groups <= FEW


def convolve(x: Tensor, layer: nn.Conv2d, pool: int = 1, relu: bool = True, added: Tensor | None = None,
             planes: bool = False) -> Tensor:
    """A convolution, an addition, max-pooling and ReLU: (N, C, H, W) -> (N, F, H', W').

    Args:
        added: (N, F, H', W'), or smaller: it is enlarged then. Not with pooling.
        planes: the answer is float32, and its pixels lie side by side. Otherwise it has the precision of the weights,
            and its channels lie side by side if there are more than FEW.
    """
    hands, _, height, width = x.shape
    filters, inputs, size, _ = layer.weight.shape
    stride, padding, each, taps = layer.stride[0], int(layer.padding[0]), filters // layer.groups, inputs * size * size
    rows, columns = (((side + 2 * padding - size) // stride + 1) // pool for side in (height, width))
    planar = planes or each <= FEW
    y = torch.empty((hands, filters, rows, columns), device=x.device,
                    dtype=torch.float32 if planes else layer.weight.dtype,
                    memory_format=torch.contiguous_format if planar else torch.channels_last)
    added_or_none = y if added is None else added
    # The fastest of some twenty ways, for the layers of our networks on an H100: many small programs, of which each
    # sums long sums in four parts at a time. Many hands need no further division.
    places, parts = (64, 1) if hands > HANDS else (16, 4 if taps > 64 else 1)
    step = 32 if taps > 64 else max(16, triton.next_power_of_2(taps))
    tile = min(16, max(8, triton.next_power_of_2(each)))
    _convolve[hands * layer.groups, triton.cdiv(rows * columns * pool * pool, places), triton.cdiv(each, tile)](
        x, layer.weight, layer.bias, added_or_none, y, layer.groups, height, width, rows, columns,
        *x.stride(), *layer.weight.stride(), *added_or_none.stride(), *y.stride(),
        INPUTS=inputs, FILTERS=each, SIZE=size, STRIDE=stride, PADDING=padding, POOL=pool, RELU=relu,
        ENLARGED=0 if added is None else rows // added.shape[2], PLACES=places, TILE=tile, PARTS=parts, STEP=step,
        num_warps=2 if hands > HANDS or taps <= 32 else 4)
    return y


@triton.jit
def _linear(x, weight, bias, added, y, inputs, outputs, slope,
            ADDED: tl.constexpr, OUTPUTS: tl.constexpr, BLOCK: tl.constexpr):
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
    answer = tl.where(answer < 0, answer * slope, answer)
    if ADDED:
        answer += tl.load(added + hand * outputs + number, mask=within, other=0).to(tl.float32)
    tl.store(y + hand * outputs + number, answer.to(y.dtype.element_ty), mask=within)


def linear(x: Tensor, weight: Tensor, bias: Tensor, slope: float = 1.0, added: Tensor | None = None) -> Tensor:
    """x (N, I), weight (O, I) and bias (O,) -> (N, O) float32. `added` (N, O) is added at the end.

    Args:
        slope: negative values are multiplied by it. 0 is ReLU.
    """
    outputs, inputs = weight.shape
    y, each = torch.empty(len(x), outputs, device=x.device), 4
    _linear[(len(x), triton.cdiv(outputs, each))](
        x.contiguous(), weight, bias, y if added is None else added.contiguous(), y, inputs, outputs, slope,
        ADDED=added is not None, OUTPUTS=each, BLOCK=min(512, triton.next_power_of_2(inputs)))
    return y
