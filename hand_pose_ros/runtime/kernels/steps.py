"""Steps of `models.refiner`, `models.dense` and `models.two_looks`, and a copy."""

# Functions that Triton compiles take pointers and numbers of Triton's types.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.models.dense import CELLS, LEAK, REACH, SHARPNESS
from hand_pose_ros.models.refiner import Region
from hand_pose_ros.models.two_looks import MAX_SIZE, STEPS, ZOOM, TwoLooks, View


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


def cut(image: Tensor, joints: Tensor, region: Region) -> Tensor:
    """As `models.refiner.cut`, for regions whose window width is a power of two."""
    cells, lines, (hands, count, _) = region.width // region.shrink, 8, joints.shape
    windows = image.new_empty(hands, count, cells, cells)
    _cut[(hands * count, cells // lines)](
        image.contiguous(), joints.float().contiguous(), windows, count, PATCH_SIZE // region.shrink, image.shape[-1],
        region.width / PATCH_SIZE, CELLS=cells, LINES=lines)
    return windows


@triton.jit
def _cells(patch, positions, seen, WIDTH: tl.constexpr, SIZE: tl.constexpr):
    """One row of the cells of one hand, as in `models.dense.cells`."""
    hand, row, column = tl.program_id(0), tl.program_id(1), tl.arange(0, WIDTH)
    at = (row * SIZE * WIDTH * SIZE + column * SIZE)[:, None] + tl.arange(0, SIZE)[None, :]
    patch += hand * WIDTH * SIZE * WIDTH * SIZE
    total, count = tl.zeros((WIDTH,), tl.float32), tl.zeros((WIDTH,), tl.float32)
    for line in tl.static_range(SIZE):
        pixels = tl.load(patch + at + line * WIDTH * SIZE).to(tl.float32)
        total += tl.sum(tl.where(pixels < 1, pixels, 0), axis=1)
        count += tl.sum((pixels < 1).to(tl.float32), axis=1)
    cell = row * WIDTH + column
    positions += hand * 3 * WIDTH * WIDTH + cell
    tl.store(positions, (column + 0.5) * (2 / WIDTH) - 1)
    tl.store(positions + WIDTH * WIDTH, tl.zeros((WIDTH,), tl.float32) + ((row + 0.5) * (2 / WIDTH) - 1))
    tl.store(positions + 2 * WIDTH * WIDTH, tl.where(count > 0, total / tl.maximum(count, 1), 1))
    tl.store(seen + hand * WIDTH * WIDTH + cell, (count > 0).to(tl.float32))


def cells(patch: Tensor) -> tuple[Tensor, Tensor]:
    """As `models.dense.cells`. The answer is float32."""
    hands = len(patch)
    positions, seen = (patch.new_empty(hands, n, CELLS, CELLS, dtype=torch.float32) for n in (3, 1))
    _cells[(hands, CELLS)](patch.contiguous(), positions, seen, WIDTH=CELLS, SIZE=PATCH_SIZE // CELLS)
    return positions, seen


@triton.jit
def _decode(positions, seen, directions, closeness, joints, agreement, count, d_hand, c_hand,
            ALL: tl.constexpr, SHARPNESS: tl.constexpr, REACH: tl.constexpr):
    """One joint of one hand from the votes of ALL cells, as in `models.dense.decode`."""
    hand, joint, cell = tl.program_id(0), tl.program_id(1), tl.arange(0, ALL)
    close = tl.load(closeness + hand * c_hand + joint * ALL + cell)
    votes = SHARPNESS * close - 1e4 * (1 - tl.load(seen + hand * ALL + cell))
    weight = tl.exp(votes - tl.max(votes, axis=0))
    weight /= tl.sum(weight, axis=0)
    distance = REACH * (1 - close)
    joints += (hand * count + joint) * 3
    for axis in tl.static_range(3):
        place = tl.load(positions + (hand * 3 + axis) * ALL + cell)
        direction = tl.load(directions + hand * d_hand + (joint * 3 + axis) * ALL + cell)
        tl.store(joints + axis, tl.sum(weight * (place + direction * distance), axis=0))
    tl.store(agreement + hand * count + joint, tl.sum(weight * close, axis=0))


def decode(positions: Tensor, seen: Tensor, directions: Tensor, closeness: Tensor) -> tuple[Tensor, Tensor]:
    """As `models.dense.decode`. The maps of one hand must lie side by side."""
    hands, count = closeness.shape[:2]
    joints, agreement = positions.new_empty(hands, count, 3), positions.new_empty(hands, count)
    _decode[(hands, count)](positions, seen, directions, closeness, joints, agreement, count,
                            directions.stride(0), closeness.stride(0), ALL=CELLS * CELLS, SHARPNESS=SHARPNESS,
                            REACH=REACH)
    return joints, agreement


@triton.jit
def _look(patch, joints, size, middle, turn, scale, seen, count, root,
          KNUCKLES: tl.constexpr, ONE: tl.constexpr, MOST: tl.constexpr, WIDTH: tl.constexpr, LINES: tl.constexpr,
          ZOOM: tl.constexpr, MAX_SIZE: tl.constexpr, STEPS: tl.constexpr):
    """LINES rows of one patch as the second look sees it: `TwoLooks.upright` and `View.patch`, which explain it.

    KNUCKLES has a bit for each joint. ONE is the share of one knuckle in their mean.
    """
    hand, number = tl.program_id(0), tl.arange(0, MOST)
    joints += hand * count * 3
    there = number < count
    all_x = tl.load(joints + number * 3, mask=there, other=0)
    all_y = tl.load(joints + number * 3 + 1, mask=there, other=0)
    all_z = tl.load(joints + number * 3 + 2, mask=there, other=0)
    x = _rounded(tl.sum(all_x, axis=0) / count, STEPS)
    y = _rounded(tl.sum(all_y, axis=0) / count, STEPS)
    z = _rounded(tl.sum(all_z, axis=0) / count, STEPS)
    share = tl.where(number == root, -1.0, 0.0)  # of each joint in the direction of the hand
    for knuckle in tl.static_range(MOST):
        if (KNUCKLES >> knuckle) & 1:
            share += tl.where(number == knuckle, ONE, 0.0)
    sin = -tl.sum(all_x * share, axis=0)
    cos = 1e-6 - tl.sum(all_y * share, axis=0)
    length = tl.sqrt(sin * sin + cos * cos)
    sin, cos = _rounded(sin / length, STEPS), _rounded(cos / length, STEPS)
    length = tl.sqrt(sin * sin + cos * cos)
    sin, cos = sin / length, cos / length
    larger = tl.minimum(tl.maximum(tl.load(size + hand).to(tl.float32), -MAX_SIZE), MAX_SIZE)
    larger = ZOOM * tl.exp(_rounded(larger, STEPS))
    if tl.program_id(1) == 0:
        tl.store(middle + hand * 3, x)
        tl.store(middle + hand * 3 + 1, y)
        tl.store(middle + hand * 3 + 2, z)
        tl.store(turn + hand * 4, cos)
        tl.store(turn + hand * 4 + 1, -sin)
        tl.store(turn + hand * 4 + 2, sin)
        tl.store(turn + hand * 4 + 3, cos)
        tl.store(scale + hand, larger)
    line = tl.program_id(1) * LINES + tl.arange(0, LINES)[:, None]
    across, down = tl.arange(0, WIDTH)[None, :] + (0.5 - WIDTH / 2), line + (0.5 - WIDTH / 2)
    sin, cos = _rounded(sin * larger, 1024), _rounded(cos * larger, 1024)
    column = tl.floor(across * cos + down * sin + (x + 1) * (WIDTH / 2)).to(tl.int32)
    row = tl.floor(down * cos - across * sin + (y + 1) * (WIDTH / 2)).to(tl.int32)
    inside = (row >= 0) & (row < WIDTH) & (column >= 0) & (column < WIDTH)
    pixels = tl.load(patch + hand * WIDTH * WIDTH + row * WIDTH + column, mask=inside, other=1).to(tl.float32)
    depth = tl.minimum(tl.maximum((pixels - z) / larger, -1), 1)
    seen += hand * WIDTH * WIDTH + line * WIDTH + tl.arange(0, WIDTH)[None, :]
    tl.store(seen, tl.where(pixels < 1, depth, 1).to(seen.dtype.element_ty))


@triton.jit
def _rounded(x, steps):
    return tl.floor(x * steps + 0.5) / steps


def seen(network: TwoLooks, patch: Tensor, joints: Tensor, size: Tensor) -> tuple[View, Tensor]:
    """As `TwoLooks.seen`."""
    hands, count, _ = joints.shape
    middle, turn, scale = (torch.empty(hands, *shape, device=patch.device) for shape in ((3,), (2, 2), ()))
    patches, lines = torch.empty_like(patch), 8
    _look[(hands, PATCH_SIZE // lines)](
        patch.contiguous(), joints.float().contiguous(), size.float().contiguous(), middle, turn, scale, patches,
        count, network.root, KNUCKLES=sum(1 << k for k in network.knuckles),
        ONE=1 / len(network.knuckles), MOST=triton.next_power_of_2(count), WIDTH=PATCH_SIZE,
        LINES=lines, ZOOM=ZOOM, MAX_SIZE=MAX_SIZE, STEPS=STEPS)
    return View(middle, turn, scale), patches


@triton.jit
def _read(joints, votes, confidence, fused, finest, weight, bias, y, count, width,
          f_hand, f_channel, f_row, f_column, s_hand, s_channel, s_row, s_column,
          FUSED: tl.constexpr, FINEST: tl.constexpr, BLOCK: tl.constexpr, OUTPUTS: tl.constexpr, LEAK: tl.constexpr):
    """The first layer of `models.dense.JointRefinement` for one joint: what two maps show there, and what is known."""
    which, joint = tl.program_id(0) * count + tl.program_id(1), tl.program_id(1)
    output = tl.arange(0, OUTPUTS)
    weight += joint * (FUSED + FINEST + 7) * OUTPUTS + output
    total = tl.load(bias + joint * OUTPUTS + output).to(tl.float32)
    x_at = (tl.minimum(tl.maximum(tl.load(joints + which * 3), -1), 1) + 1) * width / 2 - 0.5
    y_at = (tl.minimum(tl.maximum(tl.load(joints + which * 3 + 1), -1), 1) + 1) * width / 2 - 0.5
    channel = tl.arange(0, BLOCK)
    local = _sample(fused + tl.program_id(0) * f_hand + tl.minimum(channel, FUSED - 1) * f_channel, x_at, y_at, width,
                    f_row, f_column)
    factors = tl.load(weight[None, :] + (channel * OUTPUTS)[:, None], mask=(channel < FUSED)[:, None], other=0)
    total += tl.sum(local[:, None] * factors.to(tl.float32), axis=0)
    weight += FUSED * OUTPUTS
    local = _sample(finest + tl.program_id(0) * s_hand + tl.minimum(channel, FINEST - 1) * s_channel, x_at, y_at, width,
                    s_row, s_column)
    factors = tl.load(weight[None, :] + (channel * OUTPUTS)[:, None], mask=(channel < FINEST)[:, None], other=0)
    total += tl.sum(local[:, None] * factors.to(tl.float32), axis=0)
    weight += FINEST * OUTPUTS
    for axis in tl.static_range(3):
        total += tl.load(joints + which * 3 + axis) * tl.load(weight + axis * OUTPUTS).to(tl.float32)
        total += tl.load(votes + which * 3 + axis) * tl.load(weight + (3 + axis) * OUTPUTS).to(tl.float32)
    total += tl.load(confidence + which) * tl.load(weight + 6 * OUTPUTS).to(tl.float32)
    tl.store(y + which * OUTPUTS + output, tl.where(total < 0, total * LEAK, total))


@triton.jit
def _sample(at, x, y, width, s_row, s_column):
    """Bilinear, as `grid_sample` does it, with zeros outside."""
    left, top = tl.floor(x), tl.floor(y)
    right, low = x - left, y - top
    column, row = left.to(tl.int32), top.to(tl.int32)
    above = _between(_pixel(at, row, column, width, s_row, s_column),
                     _pixel(at, row, column + 1, width, s_row, s_column), right)
    below = _between(_pixel(at, row + 1, column, width, s_row, s_column),
                     _pixel(at, row + 1, column + 1, width, s_row, s_column), right)
    return _between(above, below, low)


@triton.jit
def _pixel(at, row, column, width, s_row, s_column):
    there = (row >= 0) & (row < width) & (column >= 0) & (column < width)
    at += tl.minimum(tl.maximum(row, 0), width - 1) * s_row + tl.minimum(tl.maximum(column, 0), width - 1) * s_column
    return tl.where(there, tl.load(at).to(tl.float32), 0)


def read(joints: Tensor, votes: Tensor, confidence: Tensor, local: Sequence[Tensor], weight: Tensor,
         bias: Tensor) -> Tensor:
    """What is seen at joints and known of them, times a weight for each joint: the first layer of `JointRefinement`.

    Args:
        joints, votes, confidence, local: see `JointRefinement.forward`. Two maps of the same size.
        weight: (J, I, O), with the norm merged.
        bias: (J, 1, O)

    Returns:
        (B, J, O) float32.
    """
    (hands, count, _), (fused, finest), outputs = joints.shape, local, weight.shape[2]
    y = joints.new_empty(hands, count, outputs, dtype=torch.float32)
    _read[(hands, count)](
        *(part.float().contiguous() for part in (joints, votes, confidence)), fused, finest, weight, bias, y, count,
        fused.shape[3], *fused.stride(), *finest.stride(), FUSED=fused.shape[1], FINEST=finest.shape[1],
        BLOCK=triton.next_power_of_2(max(fused.shape[1], finest.shape[1])), OUTPUTS=outputs, LEAK=LEAK)
    return y


@triton.jit
def _copy(x, y, count, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(y + at, tl.load(x + at, mask=at < count), mask=at < count)


def copy(source: Tensor, target: Tensor) -> None:
    """Copy between pinned memory and the GPU, for little data: PyTorch's copies take longer to start."""
    _copy[(triton.cdiv(source.numel(), 1024),)](source.contiguous(), target, source.numel(), BLOCK=1024)
