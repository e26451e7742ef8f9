"""A small network that finds hands in a whole depth image. The design is ours.

It sees the image as a camera with a focal length of FOCAL pixels would take it. So the depth of a hand determines its
size in pixels. Each cell of the maps says how much it looks like the middle of a hand, and where exactly that middle is
(Zhou et al. 2019, Objects as Points, with depth instead of a box).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models.dense import Lateral, Residual, conv_norm, pyramid

FOCAL = 128.0
"""Focal length of the images in pixels. A hand at 1 m is about 23 pixels large."""
CELL = 4
"""Pixels along each side of a cell."""
MULTIPLE = 32
"""Height and width of the images are multiples of this."""
FAR = 2.0
"""In metres. Everything further away counts as empty."""
USUAL_Z = 0.6
"""In metres. An untrained network predicts this depth for a hand."""


def channels(depth: Tensor) -> Tensor:
    """Depth (B, 1, H, W) in metres, 0 = no reading -> (B, 3, H, W): nearness, its relief, and what is seen.

    Tables and walls are planes. The nearness (1 / depth) of a plane is linear over the image, so its mean around a
    place is its value there. Relief is the difference from this mean.
    """
    seen = ((depth > 0) & (depth < FAR)).to(depth.dtype)
    nearness = seen * 0.3 / torch.where(seen > 0, depth, torch.ones_like(depth)).clamp(min=0.1)
    share, total = (F.avg_pool2d(F.avg_pool2d(x, CELL), 5, 1, 2) for x in (seen, nearness))  # over 20 x 20 pixels
    mean = F.interpolate(total / share.clamp(min=1e-3), scale_factor=CELL, mode='bilinear', align_corners=False)
    return torch.cat([nearness, 10 * (nearness - mean) * seen, seen], dim=1)


class HandFinder(nn.Module):
    """Depth images to middles of hands.

    Args:
        width: channels of the maps.

    Raises:
        HandPoseError: the width is less than 2.
    """

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        if width < 2:
            raise HandPoseError(f'width {width}: give at least 2')
        w = width
        self.stem = nn.Sequential(conv_norm(3, w // 2, 5, stride=2), nn.ReLU(),
                                  conv_norm(w // 2, w, 3, stride=2), nn.ReLU())
        self.stages = nn.ModuleList([Residual(w, w, 1), Residual(w, 2 * w, 2),
                                     Residual(2 * w, 4 * w, 2), Residual(4 * w, 4 * w, 2)])
        self.laterals = nn.ModuleList(Lateral(k * w, w, 1) for k in (1, 2, 4, 4))
        self.fuse = nn.Sequential(conv_norm(w, w, 3), nn.ReLU())
        self.maps = nn.Conv2d(w, 4, 1)
        nn.init.normal_(self.maps.weight, std=0.01)
        nn.init.zeros_(self.maps.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.maps.bias[0] = -4  # type: ignore[index]  # at first, nothing is a hand

    def forward(self, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Depth (B, 1, H, W) in metres, 0 = no reading, H and W multiples of 32 -> maps of H/4 x W/4 cells.

        Returns:
            Logits (B, H/4, W/4) that a cell is the middle of a hand, and the middle of that hand (B, 3, H/4, W/4):
            x / z, y / z and z - 1. These are the cube units (`geometry.Cube`) of a cube of 2 m whose centre is 1 m in
            front of the camera. The axis of the camera goes through the middle of the image.
        """
        with torch.autocast(depth.device.type, enabled=False):
            x = channels(depth.float())
        _, fused = pyramid(self.stem(x), self.stages, self.laterals)
        maps = self.maps(self.fuse(fused)).float()
        rays = cell_rays(maps)
        lateral_m = 0.1 * maps[:, 1:3]
        z = USUAL_Z * torch.exp(maps[:, 3:].clamp(-3, 2))
        return maps[:, 0], torch.cat([rays + lateral_m / z, z - 1], dim=1)


def cell_rays(maps: Tensor) -> Tensor:
    """x / z and y / z of the middles of the cells of maps (B, C, h, w): (1, 2, h, w)."""
    rows, columns = maps.shape[2:]
    x = (torch.arange(columns, device=maps.device, dtype=torch.float32) - (columns - 1) / 2) * (CELL / FOCAL)
    y = (torch.arange(rows, device=maps.device, dtype=torch.float32) - (rows - 1) / 2) * (CELL / FOCAL)
    return torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)])[None]
