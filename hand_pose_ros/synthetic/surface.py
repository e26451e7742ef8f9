"""The skin of the average hand at rest, as one seamless mesh that knows which bones carry it.

The hand is modelled as in clay. Tapered rolls and pads around the bones are smoothed into each other, which gives a
signed distance, and a mesh is read off it. Nothing is loaded. The measures come from `shapes`, so the surface is as
free to use as those numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.synthetic.kinematics import DIGIT, METACARPAL
from hand_pose_ros.synthetic.shapes import FINGER_END
from hand_pose_ros.synthetic.surface_nets import fair, neighbour_mean, surface_nets, triangles

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RestHand:
    """The bone frames (see `kinematics.forward`) and measures of the average hand at rest, in metres."""

    rotations: Array  # (K, 3, 3)
    origins: Array    # (K, 3)
    segments: Array   # (5, 3)
    radii: Array      # (5, 3)
    breadth: float
    length: float
    palm_depth: float
    wrist: Array      # (2,)
    forearm: Array    # (2,)

    def local(self, points: Array, bone: int) -> Array:
        """Points (N, 3) in the frame of a bone."""
        return (points - self.origins[bone]) @ self.rotations[bone]


def _blend(a: Array, b: Array, width: float) -> Array:
    """Smooth union of two distances (quadratic polynomial minimum), with a fillet of about `width`."""
    h = np.clip(width - np.abs(a - b), 0, None) / width
    return np.minimum(a, b) - h * h * width / 4


def _roll(p: Array, a: tuple[float, float, float], b: tuple[float, float, float], ra: float, rb: float,
          flat: float = 1.0) -> Array:
    """Distance to a tapered roll of clay from a to b. `flat` < 1 flattens it along z."""
    start, end = np.array(a), np.array(b)
    along = end - start
    offset = p - start
    t = np.clip(offset @ along / (along @ along), 0, 1)
    d = offset - t[:, None] * along
    d[:, 2] /= flat
    return (np.linalg.norm(d, axis=1) - (ra + t * (rb - ra))) * min(1.0, (1 + flat) / 2)


def _pad(p: Array, center: tuple[float, float, float], radii: tuple[float, float, float]) -> Array:
    """Distance to an ellipsoid, exact to first order at the surface."""
    q = (p - np.array(center)) / np.array(radii)
    k = np.linalg.norm(q, axis=1)
    g = np.linalg.norm(q / np.array(radii), axis=1)
    return k * (k - 1) / np.maximum(g, 1e-9)


def _sheet(p: Array, a: Array, b: Array, c: Array, radius: float) -> Array:
    """Distance to a thick triangle."""
    ab, ac = b - a, c - a
    normal = np.cross(ab, ac)
    normal /= np.linalg.norm(normal)
    height = (p - a) @ normal
    inside = np.ones(len(p), bool)
    edge = np.full(len(p), np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        w, d = v - u, p - u
        inside &= np.cross(w, d) @ normal >= 0
        edge = np.minimum(edge, np.linalg.norm(d - np.clip(d @ w / (w @ w), 0, 1)[:, None] * w, axis=1))
    return np.where(inside, np.abs(height), edge) - radius


def _finger(rest: RestHand, p: Array, digit: int) -> Array:
    """Distance to the phalanges of a digit (0 = thumb)."""
    bones = [DIGIT[digit] + i for i in (1, 3, 5)]
    lengths, radii = rest.segments[digit], rest.radii[digit]
    tip = FINGER_END * radii[2]
    first = 1 if digit == 0 else 0
    d: Array = np.full(len(p), np.inf)
    for i in range(first, 3):
        q, length, r = rest.local(p, bones[i]), lengths[i], radii[i]
        if i < 2:
            r0, r1 = (1.06 * r, 0.98 * r) if i == first else (1.0 * r, 0.96 * r)
            part = _roll(q, (0, 0, 0), (0, length, 0), r0, r1, 0.93)
            belly = _pad(q, (0, 0.50 * length, 0.28 * r), (0.92 * r, 0.46 * length, 0.86 * r))
            part = _blend(part, belly, 0.3 * r)
        else:
            part = _roll(q, (0, 0, 0), (0, length, 0.0), 0.97 * r, 0.88 * tip, 0.90)
            pulp = _pad(q, (0, 0.72 * length, 0.16 * r), (1.0 * tip, length * 0.28 + tip, 0.90 * tip))
            part = _blend(part, pulp, 0.5 * r)
        d = _blend(d, part, 0.45 * r) if np.isfinite(d).all() else part
    return d


def _palm(rest: RestHand, p: Array) -> Array:
    """Distance to the palm with its pads, hollow and finger webs, without the thumb."""
    depth, b, length = rest.palm_depth, rest.breadth, rest.length
    roots = [rest.origins[DIGIT[i]] for i in range(5)]
    d: Array = np.full(len(p), np.inf)
    # Metacarpals, close under the skin of the back.
    for i in range(1, 5):
        q = rest.local(p, METACARPAL[i])
        reach = float(np.linalg.norm(roots[i] - rest.origins[METACARPAL[i]]))
        size = (1.0, 1.0, 0.96, 0.88)[i - 1]
        part = _roll(q, (0, -0.004, 0.001), (0, reach, 0.001), 0.78 * depth * size, 0.84 * depth * size)
        flesh = _roll(q, (0, 0, 0.40 * depth), (0, reach - 0.006, 0.24 * depth),
                      0.72 * depth * size, 0.76 * depth * size)
        part = _blend(part, flesh, 0.5 * depth)
        d = _blend(d, part, 0.010) if i > 1 else part
    # Pads at the roots of the fingers, and the webs between them.
    for i in range(1, 5):
        bone = DIGIT[i] + 1
        r = rest.radii[i, 0]
        q = rest.local(p, bone)
        root = _roll(q, (0, -0.008, 0.34 * r), (0, 0.30 * rest.segments[i, 0], 0.20 * r), 0.98 * r, 0.92 * r)
        d = _blend(d, root, 0.008)
    for i in range(1, 4):
        at = [rest.origins[DIGIT[j] + 1] + rest.rotations[DIGIT[j] + 1] @ np.array(
            [0, 0.33 * rest.segments[j, 0], 0.10 * rest.radii[j, 0]]) for j in (i, i + 1)]
        root = (roots[i] + roots[i + 1]) / 2 + np.array([0, 0.002, 0.003])
        d = _blend(d, _sheet(p, at[0], at[1], root, 0.52 * rest.radii[i + 1, 0]), 0.009)
    # Heel of the hand: carpus, hypothenar.
    d = _blend(d, _pad(p, (0.003, 0.014, 0.002), (0.30 * b, 0.030, 1.0 * depth)), 0.010)
    hypothenar = _roll(p, (-0.20 * b, 0.12 * length, 0.09 * b), (-0.335 * b, 0.29 * length, 0.10 * b),
                       0.115 * b, 0.13 * b)
    return _blend(d, hypothenar, 0.012)


def _thumb_root(rest: RestHand, p: Array) -> tuple[Array, Array]:
    """Distances to the thenar eminence and to the web between thumb and index finger."""
    q, length, b = rest.local(p, DIGIT[0] + 1), rest.segments[0, 0], rest.breadth
    r = rest.radii[0, 1]
    bone = _roll(q, (0, 0, 0), (0, length, 0), 1.05 * r, 1.10 * r)
    muscle = _roll(q, (0.002, 0.22 * length, 0.004), (0.0, 0.78 * length, 0.003), 0.165 * b, 0.13 * b)
    ball = _roll(p, (0.10 * b, 0.12 * rest.length, 0.12 * b), tuple(rest.origins[DIGIT[0] + 2] * 0.72),
                 0.12 * b, 0.145 * b)
    thenar = _blend(_blend(bone, muscle, 0.008), ball, 0.012)
    index = rest.origins[DIGIT[1]]
    sheet = _sheet(p, rest.origins[DIGIT[0]],
                   rest.origins[DIGIT[0] + 2] + rest.rotations[DIGIT[0] + 1] @ np.array([0, 0.002, 0]),
                   index + np.array([0.0, -0.006, 0.002]), 0.0065)
    return thenar, sheet


def _forearm(rest: RestHand, p: Array) -> Array:
    """Distance to wrist and forearm, an oval that gets wider and rounder towards the elbow, where it is cut."""
    q = rest.local(p, 0)
    t = np.clip(-q[:, 1] / rest.forearm[0], -0.2, 1)
    grow = np.clip(t / 0.72, 0, 1)
    grow = grow * grow * (3 - 2 * grow)
    flare = 0.03 * np.exp(-((t - 0.02) / 0.09) ** 2)  # the heads of radius and ulna
    rx = rest.wrist[0] * (1 + flare) + (rest.forearm[1] - rest.wrist[0]) * grow
    rz = rest.wrist[1] * (1 + flare) + (0.86 * rest.forearm[1] - rest.wrist[1]) * grow
    x, z = q[:, 0] / rx, (q[:, 2] - 0.002) / rz
    k = np.sqrt(x * x + z * z)
    side = k * (k - 1) / np.maximum(np.sqrt((x / rx) ** 2 + (z / rz) ** 2), 1e-9)
    start, end = q[:, 1] - 0.012, -q[:, 1] - rest.forearm[0]
    return -_blend(_blend(-side, -end, 0.02), -start, 0.02)  # what is inside all three


def distance(rest: RestHand, p: Array) -> Array:
    """Signed distance (approximate, exact in sign) of points (N, 3) to the skin, negative inside."""
    d = _blend(_palm(rest, p), _forearm(rest, p), 0.014)
    thenar, web = _thumb_root(rest, p)
    d = _blend(_blend(d, thenar, 0.012), web, 0.014)
    d = _blend(d, _finger(rest, p, 0), 0.006)
    for digit in range(1, 5):
        d = _blend(d, _finger(rest, p, digit), 0.005)
    return d - 0.0003  # flat triangles lie inside a round surface by about as much


def _lattice(rest: RestHand, step: float) -> Array:
    """Lattice points (nx, ny, nz, 3), about `step` apart across the hand, wider along it and towards the elbow."""
    ys = [rest.length + 0.02]
    while ys[-1] > -rest.forearm[0] - 0.05:
        ys.append(ys[-1] - step * np.interp(-ys[-1], [-0.02, 0.08, 0.2], [1.35, 4.0, 6.0]))
    y = np.array(ys[::-1])
    x = np.arange(-0.095, 0.135, step)
    z = np.arange(-0.034, 0.080, step)
    grow = np.interp(-y, [-0.01, 0.08, 0.20], [1.0, 1.8, 2.6])[None, :, None]
    grid = np.stack(np.meshgrid(x, y, z, indexing='ij'), -1)
    grid[..., 0] *= grow
    grid[..., 2] *= grow
    return grid


def _ramp(x: Array, low: float, high: float) -> Array:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _share(s: Array, reach: float, back: float) -> tuple[Array, Array, Array]:
    """Weights of what is before, at and after a joint, for points at distance s past it along the bone.

    They blend from -back to reach.
    """
    before, after = 1 - _ramp(s, -back, 0), _ramp(s, 0, reach)
    return before, 1 - before - after, after


def _weights(rest: RestHand, p: Array) -> tuple[Array, NDArray[np.int64]]:
    """Weights (V, K) of the bones, with rows that add to 1, and the part of each vertex (V,), see `build`."""
    w = np.zeros((len(p), len(rest.origins)))
    # The finger (with its metacarpal) that a vertex belongs to. This is sharp between fingers, and gradual in the palm.
    near = []
    for digit in range(1, 5):
        q = rest.local(p, METACARPAL[digit])
        length = float(np.linalg.norm(rest.origins[DIGIT[digit]] - rest.origins[METACARPAL[digit]]))
        ray = _roll(q, (0, 0, 0), (0, length, 0), rest.radii[digit, 0], rest.radii[digit, 0])
        near.append(np.minimum(ray, _finger(rest, p, digit)))
    distances = np.stack(near, 1)
    member = np.clip(1 - (distances - distances.min(1, keepdims=True)) / 0.008, 0, 1) ** 2
    member /= member.sum(1, keepdims=True)
    thenar, _ = _thumb_root(rest, p)
    thumb = np.minimum(thenar, _finger(rest, p, 0))
    d_palm = np.minimum(_palm(rest, p), distances.min(1))
    q = rest.local(p, DIGIT[0] + 1)
    thumbness = _ramp(d_palm - thumb, -0.010, 0.014) * _ramp(q[:, 1], -0.020, 0.016)

    wrist = _share(rest.local(p, 0)[:, 1], 0.022, 0.026)
    hand = wrist[2]
    w[:, 0], w[:, 1] = wrist[0], wrist[1]
    for digit in range(5):
        amount = hand * (thumbness if digit == 0 else (1 - thumbness) * member[:, digit - 1])
        bones = [DIGIT[digit] + i for i in range(6)]
        root = METACARPAL[digit]
        if digit:  # the carpus holds the heel of the hand
            s = rest.local(p, root)[:, 1]
            heel = 1 - _ramp(s, -0.002, 0.030)
            w[:, 2] += amount * heel
            amount = amount * (1 - heel)
        left = amount
        for i in range(3):
            s = rest.local(p, bones[2 * i + 1])[:, 1]
            r = rest.radii[digit, max(i - 1, 0)]
            reach = (0.022, 0.026) if digit == 0 and i == 0 else (r, r)
            before, at, after = _share(s, *reach)
            w[:, root if i == 0 else bones[2 * i - 1]] += left * before
            w[:, bones[2 * i]] += left * at
            left = left * after
        w[:, bones[5]] += left
    part = np.full(len(p), 5)
    for digit in range(5):
        mine = w[:, DIGIT[digit] + (2 if digit == 0 else 1):DIGIT[digit] + 6].sum(1)
        part[mine > 0.5] = digit
    part[w[:, 0] + 0.5 * w[:, 1] > 0.5] = 6
    return w / w.sum(1, keepdims=True), part


def build(rest: RestHand, step: float = 0.0047) -> tuple[Array, NDArray[np.int64], Array, NDArray[np.int64]]:
    """The skin of the hand at rest.

    Returns:
        Vertices (V, 3) in metres in the hand frame, faces (F, 3) counter-clockwise from outside, weights (V, K) of the
        bones, and the part of each vertex (V,): 0-4 thumb to little finger, 5 palm, 6 forearm.
    """
    grid = _lattice(rest, step)
    value = distance(rest, grid.reshape(-1, 3)).reshape(grid.shape[:3])
    vertices, quads = surface_nets(grid, value)
    vertices = fair(partial(distance, rest), vertices, quads)
    weights, part = _weights(rest, vertices)
    for _ in range(2):
        weights = 0.5 * (weights + neighbour_mean(weights, quads))
    return vertices, triangles(vertices, quads), weights, part
