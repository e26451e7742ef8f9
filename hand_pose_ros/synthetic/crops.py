"""The product's crops for batches: its cube units, its crop and where its detector settles."""

from __future__ import annotations

import torch
from torch import Tensor

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.synthetic.renderer import View

_FAR = 1.5  # m, beyond which the detector does not look


def to_cube(points: Tensor, center: Tensor, side: Tensor) -> Tensor:
    """Points (B, N, 3) in metres -> cube units, as geometry.Cube.to_cube."""
    half = side[:, None] / 2
    x, y, z = points.unbind(-1)
    on_plane = center[:, 2:] / z
    return torch.stack([(x * on_plane - center[:, :1]) / half, (y * on_plane - center[:, 1:2]) / half,
                        (z - center[:, 2:]) / half], -1)


def crop(depth: Tensor, center: Tensor, side: Tensor, view: View) -> Tensor:
    """The same as geometry.crop to the last bit, for a batch: depth (B, H, W) -> patches (B, 1, 128, 128).

    The warp of geometry.crop (cv2.warpAffine, nearest) rounds positions to 1/1024 of a pixel, and then to whole pixels,
    halves up.
    """
    batch, height, width = depth.shape
    at = center.double()
    half = side.double() / 2
    index = torch.arange(PATCH_SIZE, device=depth.device, dtype=torch.float64)

    def positions(focal: Tensor, principal: Tensor, coordinate: Tensor) -> Tensor:
        focal, principal = focal.double(), principal.double()
        middle = coordinate / at[:, 2] * focal + principal
        step = focal * (2 / PATCH_SIZE * half / at[:, 2])
        first = middle + step * (0.5 - PATCH_SIZE / 2)
        return ((step[:, None] * index * 1024).round().long() + (first * 1024).round().long()[:, None] + 512) >> 10

    columns = positions(view.fx, view.cx, at[:, 0])
    rows = positions(view.fy, view.cy, at[:, 1])
    inside = (((columns >= 0) & (columns < width))[:, None, :] & ((rows >= 0) & (rows < height))[:, :, None])
    source = rows.clamp(0, height - 1)[:, :, None] * width + columns.clamp(0, width - 1)[:, None, :]
    patch = depth.flatten(1).gather(1, source.flatten(1)).reshape(batch, PATCH_SIZE, PATCH_SIZE)
    shown = ((patch - center[:, 2, None, None]) / (side / 2)[:, None, None]).clamp(-1, 1)
    return torch.where(inside & (patch != 0), shown, 1)[:, None]


def settle(depth: Tensor, view: View, side: float, nearest: int, otherwise: Tensor) -> Tensor:
    """Where the rule of hand_pose_ros.detection settles, without its search for connected pieces.

    The first guess is the centre of the nearest pixels. Five times, it moves to the centre of mass of what a cube
    around it holds.

    Args:
        depth: (B, H, W) metres, coarse images around one object each.
        side: side of the cube, metres.
        nearest: number of the nearest pixels that make the first guess.
        otherwise: (B, 3) metres, the answer for images that hold nothing.

    Returns:
        (B, 3) metres.
    """
    depth = torch.where(depth < _FAR, depth, 0).flatten(1)
    ray_x, ray_y = (ray.expand(-1, view.height, view.width).flatten(1) for ray in view.rays)

    def centroid(mask: Tensor, values: tuple[Tensor, ...], otherwise: Tensor) -> Tensor:
        count = mask.sum(1)
        # In double precision, the order of the summands does not change the result.
        x, y, z = (torch.where(mask, value, 0).double().sum(1) / count.clamp(min=1) for value in values)
        return torch.where((count > 0)[:, None], torch.stack([x * z, y * z, z], 1).float(), otherwise)

    nearness, where = torch.where(depth > 0, 1 / depth, 0).topk(nearest)
    center = centroid(nearness > 0, (ray_x.gather(1, where), ray_y.gather(1, where), 1 / nearness), otherwise)
    for _ in range(5):
        x, y, z = (t[:, None] for t in center.unbind(1))
        inside = ((depth > 0) & ((depth - z).abs() <= side / 2) & ((ray_x * z - x).abs() <= side / 2)
                  & ((ray_y * z - y).abs() <= side / 2))
        center = centroid(inside, (ray_x, ray_y, depth), center)
    return center
