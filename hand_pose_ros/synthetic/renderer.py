"""Depth images of triangle meshes and of simple solids, in batches, in pure PyTorch (the same code on CPU and GPU).

Everything here works on *nearness*, which is 1/z in 1/m, 0 = nothing. `depth_of` turns it into metres. The reasons:

- Over any plane, it is affine in the image. So a triangle is perspective-correct without a division per pixel.
- Surfaces are composed with a maximum, whose result does not depend on the order.
- "Nothing" needs no special case.

A pixel depends on its own sample only, and all arithmetic is element-wise. So a sample is the same, bit for bit, in any
batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

NEAR = 0.05
"""Triangles with a corner nearer than this (m) are not drawn, because no depth sensor sees them."""

_BLOCKS = (2, 4, 8)  # sides in pixels of the square blocks that triangles are tested in; larger triangles take several
_INSIDE = -1e-4  # barycentric tolerance, so that neighbours overlap by a hair instead of leaving cracks


@dataclass(frozen=True)
class View:
    """One pinhole window of `height` x `width` pixels for each sample. fx, fy, cx and cy are (B,) float32.

    (u, v) = (0, 0) is the first pixel of the window, so the cx of a window that starts at column c of a sensor is
    lower by c.
    """

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    height: int
    width: int

    @cached_property
    def rays(self) -> tuple[Tensor, Tensor]:
        """Slopes x/z (B,1,W) and y/z (B,H,1) of the rays through the pixel centres."""
        columns = torch.arange(self.width, device=self.fx.device, dtype=torch.float32)
        rows = torch.arange(self.height, device=self.fx.device, dtype=torch.float32)
        return (((columns - self.cx[:, None]) / self.fx[:, None])[:, None, :],
                ((rows - self.cy[:, None]) / self.fy[:, None])[:, :, None])

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Points (B, N, 3) -> columns and rows (B, N)."""
        x, y, z = points.unbind(-1)
        return x / z * self.fx[:, None] + self.cx[:, None], y / z * self.fy[:, None] + self.cy[:, None]

    def __getitem__(self, samples: Tensor) -> View:
        return View(self.fx[samples], self.fy[samples], self.cx[samples], self.cy[samples], self.height, self.width)


def depth_of(nearness: Tensor) -> Tensor:
    """1/z -> z in metres, 0 where there is nothing."""
    return torch.where(nearness > 0, 1 / nearness, 0)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product over the last axis of three. (A matrix product rounds differently in another batch size.)"""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def rasterise(vertices: Tensor, faces: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of a closed mesh seen from outside.

    Args:
        vertices: (B, V, 3) float32, metres, optical frame.
        faces: (F, 3) int64, counter-clockwise seen from outside. Faces turned away are not drawn.
    """
    batch, height, width = len(vertices), view.height, view.width
    image = vertices.new_zeros(batch * height * width)
    x, y, z = (vertices[..., i].T.contiguous() for i in range(3))  # (V, B): gathering corners then copies whole rows
    safe = z.clamp(min=NEAR)
    nearness = 1 / safe
    corners = [torch.stack([t[corner] for corner in faces.T]) for t in (
        x * nearness * view.fx + view.cx, y * nearness * view.fy + view.cy, nearness)]
    u, v, w = corners  # each (3, F, B)

    twice_area = (u[1] - u[0]) * (v[2] - v[0]) - (v[1] - v[0]) * (u[2] - u[0])
    left = torch.minimum(torch.minimum(u[0], u[1]), u[2]).ceil_().clamp_(min=0)
    right = torch.maximum(torch.maximum(u[0], u[1]), u[2]).floor_().clamp_(max=width - 1)
    top = torch.minimum(torch.minimum(v[0], v[1]), v[2]).ceil_().clamp_(min=0)
    bottom = torch.maximum(torch.maximum(v[0], v[1]), v[2]).floor_().clamp_(max=height - 1)
    nearest = torch.maximum(torch.maximum(w[0], w[1]), w[2])
    keep = (twice_area < 0) & (right >= left) & (bottom >= top) & (nearest < 1 / NEAR)
    chosen = keep.reshape(-1).nonzero()[:, 0]
    sample = chosen % batch
    u, v, w = (a.reshape(3, -1)[:, chosen] for a in (u, v, w))
    left, right, top, bottom, twice_area = (a.reshape(-1)[chosen] for a in (left, right, top, bottom, twice_area))
    extent = torch.maximum(right - left, bottom - top) + 1

    # Barycentric coordinates of corners 1 and 2, and the nearness, as affine functions of the pixel:
    # slopes along u and v, and the value at corner 0.
    inverse = 1 / twice_area
    b1 = ((v[2] - v[0]) * inverse, (u[0] - u[2]) * inverse)
    b2 = ((v[0] - v[1]) * inverse, (u[1] - u[0]) * inverse)
    slope = tuple(p * (w[1] - w[0]) + q * (w[2] - w[0]) for p, q in zip(b1, b2, strict=True))
    affine = torch.stack([*b1, *b2, *slope, u[0], v[0], w[0]])

    smaller = 0
    for size in _BLOCKS:
        last = size == _BLOCKS[-1]
        members = ((extent > smaller) & ((extent <= size) | last)).nonzero()[:, 0]
        smaller = size
        size_u, size_v = min(size, width), min(size, height)
        begin_u, begin_v = left[members], top[members]
        if last:  # as many blocks as the bounding box needs
            across = ((right[members] - begin_u) / size).floor().long() + 1
            blocks = across * (((bottom[members] - begin_v) / size).floor().long() + 1)
            owner = torch.repeat_interleave(torch.arange(len(members), device=image.device), blocks)
            number = torch.arange(len(owner), device=image.device) - (blocks.cumsum(0) - blocks)[owner]
            begin_u = begin_u[owner] + number % across[owner] * size
            begin_v = begin_v[owner] + torch.div(number, across[owner], rounding_mode='floor') * size
            members = members[owner]
        begin_u, begin_v = begin_u.clamp(max=width - size_u), begin_v.clamp(max=height - size_v)
        p1, q1, p2, q2, pw, qw, u0, v0, w0 = affine[:, members, None].unbind(0)
        across, down = torch.arange(size_u, device=image.device), torch.arange(size_v, device=image.device)
        du, dv = begin_u[:, None] - u0 + across, begin_v[:, None] - v0 + down
        first = (p1 * du)[:, None, :] + (q1 * dv)[:, :, None]
        second = (p2 * du)[:, None, :] + (q2 * dv)[:, :, None]
        nearness = (pw * du)[:, None, :] + (w0 + qw * dv)[:, :, None]
        third = 1 - first
        third -= second
        inside = torch.minimum(torch.minimum(first, second), third) >= _INSIDE
        covered = inside.reshape(-1).nonzero()[:, 0]
        start = (sample[members] * height + begin_v.long()) * width + begin_u.long()
        pixel = start[:, None, None] + (down[:, None] * width + across)
        image.scatter_reduce_(0, pixel.reshape(-1)[covered], nearness.reshape(-1)[covered], 'amax')
    return image.reshape(batch, height, width)


def plane(normal: Tensor, distance: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of the plane normal . p = distance; `normal` (B, 3), `distance` (B,) in metres."""
    x, y = view.rays
    n = (normal / distance[:, None])[..., None, None]
    return (n[:, 0] * x + (n[:, 1] * y + n[:, 2])).clamp(min=0)


def ellipsoid(center: Tensor, axes: Tensor, radii: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of an ellipsoid.

    Args:
        center: (B, 3) in metres.
        axes: (B, 3, 3), whose columns are the directions of the three axes.
        radii: (B, 3) along them, in metres.
    """
    x, y = view.rays
    scaled = (axes / radii[:, None, :]).transpose(1, 2)  # rows: what maps a point onto the unit sphere
    c = [dot(row, center)[:, None, None] for row in scaled.unbind(1)]
    d = [(row[:, 0, None, None] * x + (row[:, 1, None, None] * y + row[:, 2, None, None])) for row in scaled.unbind(1)]
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = d[0] * c[0] + d[1] * c[1] + d[2] * c[2]
    excess = c[0] * c[0] + c[1] * c[1] + c[2] * c[2] - 1
    # z is the smaller root of a z^2 - 2 b z + excess = 0; its inverse is the larger root of the reversed polynomial.
    discriminant = b * b - a * excess
    return torch.where((discriminant > 0) & (b > 0) & (excess > 0), (b + discriminant.clamp(min=0).sqrt()) / excess, 0)


def round_cone(start: Tensor, end: Tensor, start_radius: Tensor, end_radius: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of all spheres between two spheres. Where the radii are equal, this is a capsule.

    Args:
        start, end: (B, 3) centres in metres.
        start_radius, end_radius: (B,) in metres; neither sphere lies inside the other.
    """
    x, y = view.rays
    along = end - start
    narrowing = start_radius - end_radius
    wide = lambda t: t[:, None, None]  # noqa: E731

    def ray_dot(p: Tensor) -> Tensor:
        return wide(p[:, 0]) * x + (wide(p[:, 1]) * y + wide(p[:, 2]))

    ray2 = x * x + (y * y + 1)
    ray_along, ray_start, ray_end = ray_dot(along), ray_dot(start), ray_dot(end)
    along2, start_along, start2 = dot(along, along), dot(start, along), dot(start, start)

    def ball(ray_center: Tensor, center2: Tensor, radius: Tensor) -> Tensor:
        excess = wide(center2 - radius * radius)
        discriminant = ray_center * ray_center - ray2 * excess
        return torch.where((discriminant > 0) & (ray_center > 0),
                           (ray_center + discriminant.clamp(min=0).sqrt()) / excess, 0)

    # The mantle: along2' |q|^2 - (q.along)^2 - 2 (q.along) narrowing r + ... = 0 for q = z ray - start.
    slant2 = along2 - narrowing * narrowing
    a = wide(slant2) * ray2 - ray_along * ray_along
    b = wide(slant2) * ray_start - ray_along * wide(start_along + narrowing * start_radius)
    c = wide(slant2 * start2 - start_along * start_along - 2 * start_along * narrowing * start_radius
             - along2 * start_radius * start_radius)
    discriminant = b * b - a * c
    nearness = (b + discriminant.clamp(min=0).sqrt()) / c
    z = 1 / nearness
    height = ray_along * z - wide(start_along + start_radius * narrowing)
    on_mantle = (discriminant > 0) & (nearness > 0) & (height > 0) & (height < wide(slant2))
    mantle = torch.where(on_mantle, nearness, 0)
    return torch.maximum(mantle, torch.maximum(ball(ray_start, start2, start_radius),
                                               ball(ray_end, dot(end, end), end_radius)))


def box(center: Tensor, axes: Tensor, half: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of a box.

    Args:
        center: (B, 3) in metres.
        axes: (B, 3, 3), whose columns are the directions of the edges.
        half: (B, 3) half lengths of the edges, in metres.
    """
    x, y = view.rays
    enter, leave = torch.full_like(x, -torch.inf), torch.full_like(x, torch.inf)
    for axis, h in zip(axes.unbind(2), half.unbind(1), strict=True):
        ray = axis[:, 0, None, None] * x + (axis[:, 1, None, None] * y + axis[:, 2, None, None])
        ray = torch.where(ray.abs() < 1e-9, 1e-9, ray)
        c = dot(axis, center)
        one, two = (c - h)[:, None, None] / ray, (c + h)[:, None, None] / ray
        enter, leave = torch.maximum(enter, torch.minimum(one, two)), torch.minimum(leave, torch.maximum(one, two))
    return torch.where((enter < leave) & (enter > 0), 1 / enter, 0)
