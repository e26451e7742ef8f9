"""Reads a closed mesh off a signed distance that is sampled on a lattice (surface nets, Gibson 1998)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def surface_nets(grid: Array, value: Array) -> tuple[Array, NDArray[np.int64]]:
    """Zero set of `value` (nx, ny, nz) on lattice `grid` -> vertices (V, 3) and quads (Q, 4) that face outwards."""
    shape = tuple(n - 1 for n in value.shape)
    total, count = np.zeros((*shape, 3)), np.zeros(shape)
    crossings = []
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        a, b = value[tuple(low)], value[tuple(high)]
        cross = (a < 0) != (b < 0)
        t = np.where(cross, a / np.where(cross, a - b, 1), 0)[..., None]
        point = np.where(cross[..., None], grid[tuple(low)] * (1 - t) + grid[tuple(high)] * t, 0)
        others = [i for i in range(3) if i != axis]
        for da in (0, 1):
            for db in (0, 1):  # the four edges of each cell along this axis
                part = [slice(None)] * 3
                for other, shift in zip(others, (da, db), strict=True):
                    part[other] = slice(shift, shift + shape[other])
                total += point[tuple(part)]
                count += cross[tuple(part)]
        crossings.append((axis, cross, a < 0))
    active = count > 0
    index = np.full(shape, -1, np.int64)
    index[active] = np.arange(active.sum())
    vertices = total[active] / count[active][:, None]

    quads = []
    for axis, cross, inside in crossings:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        at = np.argwhere(cross)
        at = at[(at[:, u] > 0) & (at[:, v] > 0)]
        corners = []
        for du, dv in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
            cell = at.copy()
            cell[:, u] += du
            cell[:, v] += dv
            corners.append(index[tuple(cell.T)])
        quad = np.stack(corners, 1)
        flip = ~inside[tuple(at.T)]
        quad[flip] = quad[flip][:, ::-1]
        quads.append(quad)
    return vertices, np.concatenate(quads)


def neighbour_mean(values: Array, quads: NDArray[np.int64]) -> Array:
    """For each vertex, the mean of `values` (V, ...) over its neighbours."""
    total = np.zeros_like(values)
    for i in range(4):
        np.add.at(total, quads[:, i], values[quads[:, (i + 1) % 4]])
    return total / np.bincount(quads.reshape(-1), minlength=len(values))[:, None]


def fair(distance: Callable[[Array], Array], vertices: Array, quads: NDArray[np.int64]) -> Array:
    """Vertices evened out along the zero set of a `distance` (N, 3) -> (N,), and put exactly on it."""
    steps = np.eye(3) * 2e-4
    for relax in (0.6, 0.6, 0.0):
        vertices = vertices + relax * (neighbour_mean(vertices, quads) - vertices)
        for _ in range(2):
            slope = np.stack([distance(vertices + e) - distance(vertices - e) for e in steps], -1) / 4e-4
            step = distance(vertices) / np.maximum((slope * slope).sum(1), 0.05)
            vertices = vertices - np.clip(step, -0.003, 0.003)[:, None] * slope
    return vertices


def triangles(vertices: Array, quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Split each quad along its shorter diagonal."""
    p = vertices[quads]
    short = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) <= np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
    split = np.where(short[:, None, None], np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 3], [1, 2, 3]]))
    return np.take_along_axis(quads[:, None], split.reshape(-1, 1, 6), 2).reshape(-1, 3)
