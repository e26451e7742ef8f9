"""Shows one sample in many ways: turned, moved and scaled in the plane of the patch, with noise and gaps.

The geometry is exact, because cube units follow the rays of the camera. Another cube around the same scene is an affine
map of patch and joints. A turn of the patch about its centre is a roll of the camera, if the centre of the cube is
turned with it. What the new cube contains and the old one did not is unknown, and becomes background. What was in front
of the old cube was shown at its front face, and stays at that depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from hand_pose_ros.datasets import Batch
from hand_pose_ros.synthetic.rng import Random


@dataclass(frozen=True)
class Augmentation:
    """How much of each. By default, nothing changes."""

    rotation_deg: float = 0.0
    """The patch is turned by up to this angle, to both sides."""
    jitter: float = 0.0
    """Standard deviation of the shift of the centre of the cube, metres per axis."""
    jitter_tail: float = 0.0
    """Share of samples that are shifted three times as far."""
    scale: float = 1.0
    """The side of the cube is multiplied by a factor from [1 / scale, scale], uniform in its logarithm."""
    exclusive: bool = False
    """Each sample is either shifted, or turned, or neither, with equal chances (DeepPrior++)."""
    noise: float = 0.0
    """Maximum standard deviation of the noise of a patch, metres."""
    dropout: float = 0.0
    """Maximum share of readings of a patch that are lost."""
    erase: float = 0.0
    """Share of samples that lose a rectangle of 2 to 20 % of the patch."""
    mirror: float = 0.0
    """Share of samples that are shown as the wrong side, as if a left hand had not been mirrored."""


PRESETS = {
    'none': Augmentation(),  # the paper mentions none
    'deep_prior_pp': Augmentation(rotation_deg=180, jitter=0.005, exclusive=True),  # original code
    'modern': Augmentation(rotation_deg=180, jitter=0.008, jitter_tail=0.1, scale=1.2, noise=0.002, dropout=0.15,
                           erase=0.3, mirror=0.15),
}


def augment(batch: Batch, augmentation: Augmentation, numbers: Tensor, seed: int) -> Batch:
    """Augmented copies of the samples, with `mirrored` (B,) bool added.

    Args:
        batch: see `hand_pose_ros.datasets.base.Batch`. Without a 'patch', only the geometry is augmented.
        numbers: (B,) int64. What happens to a sample depends on its number and `seed`, not on its neighbours.
    """
    joints = batch['joints']
    device = joints.device
    random = Random(numbers.to(device) + (seed << 40))
    out = dict(batch)
    out['mirrored'] = random.fork(0).chance(augmentation.mirror)
    angle, scale, shift = _draw_geometry(random.fork(1), augmentation, batch['cube_side'])

    # A point p of the patch becomes p' = (r R p - shift) / scale. r is the new depth of the centre over the old one.
    center, half = batch['cube_center'], batch['cube_side'] / 2
    depth = center[:, 2] + shift[:, 2] * half
    r = depth / center[:, 2]
    cos, sin = torch.cos(angle), torch.sin(angle)
    flip = torch.where(out['mirrored'], -1.0, 1.0)
    rotation = torch.stack([torch.stack([cos * flip, -sin], -1), torch.stack([sin * flip, cos], -1)], -2)  # (B, 2, 2)
    plane = torch.einsum('bij,bkj->bki', rotation * r[:, None, None], joints[..., :2])
    out['joints'] = torch.cat([(plane - shift[:, None, :2]) / scale[:, None, None],
                               (joints[..., 2:] - shift[:, None, 2:]) / scale[:, None, None]], dim=-1)
    lateral = torch.einsum('bij,bj->bi', rotation, center[:, :2]) * r[:, None] + shift[:, :2] * half[:, None]
    out['cube_center'] = torch.cat([lateral, depth[:, None]], dim=-1)
    out['cube_side'] = batch['cube_side'] * scale

    if 'patch' in batch:
        patch = batch['patch']
        if augmentation.rotation_deg or augmentation.jitter or augmentation.scale != 1 or augmentation.mirror:
            # From a pixel p' of the new patch back to p of the old one. Nearest neighbour, as when an image is cropped.
            inverse = rotation.mT / r[:, None, None]
            theta = torch.cat([inverse * scale[:, None, None], inverse @ shift[:, :2, None]], dim=-1)
            grid = F.affine_grid(theta, list(patch.shape), align_corners=False)
            moved = F.grid_sample(patch - 1, grid, mode='nearest', padding_mode='zeros', align_corners=False)
            depths = (moved + (1 - shift[:, 2])[:, None, None, None]) / scale[:, None, None, None]
            patch = torch.where(moved == 0, 1.0, depths.clamp_(-1, 1))
        out['patch'] = _degrade(patch, random.fork(2), augmentation, out['cube_side'])
    return out


def _draw_geometry(random: Random, augmentation: Augmentation, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angle (B,) in radians, factor of the side of the cube (B,), and shift of its centre (B, 3) in half sides."""
    angle = random.uniform(low=-1, high=1) * math.radians(augmentation.rotation_deg)
    scale = torch.exp(random.uniform(low=-1, high=1) * math.log(augmentation.scale))
    far = torch.where(random.chance(augmentation.jitter_tail), 3.0, 1.0)
    shift = random.normal(3, std=augmentation.jitter) * far[:, None] / (side / 2)[:, None]
    if augmentation.exclusive:
        mode = (random.uniform() * 3).long()
        angle, shift = angle * (mode == 0), shift * (mode == 1)[:, None]
    return angle, scale, shift


def _degrade(patch: Tensor, random: Random, augmentation: Augmentation, side: Tensor) -> Tensor:
    """Patches with noise, lost readings and lost rectangles. The background (+1) stays, because it has no readings."""
    size = patch.shape[-1]
    lost = patch == 1
    if augmentation.noise:
        deviation = random.uniform(high=augmentation.noise) / (side / 2)
        patch = (patch + _noise(patch, random.fork(0)) * deviation[:, None, None, None]).clamp_(-1, 1)
    if augmentation.dropout:
        share = random.uniform(high=augmentation.dropout)
        lost = lost | (_noise(patch, random.fork(1)) < torch.special.ndtri(share)[:, None, None, None])
    if augmentation.erase:
        area = random.uniform(low=0.02, high=0.2)
        aspect = torch.exp(random.uniform(low=-1, high=1))
        extent = torch.stack([(area * aspect).sqrt(), (area / aspect).sqrt()], dim=-1)  # of the patch, rows and columns
        extent = extent * random.chance(augmentation.erase)[:, None]
        corner = random.uniform(2) * (1 - extent)
        at = (torch.arange(size, device=patch.device) + 0.5) / size
        inside = (at >= corner[..., None]) & (at < (corner + extent)[..., None])  # (B, 2, S)
        lost = lost | (inside[:, 0, :, None] & inside[:, 1, None, :])[:, None]
    return torch.where(lost, 1.0, patch)


_BANK: dict[torch.device, Tensor] = {}


def _noise(patch: Tensor, random: Random) -> Tensor:
    """Normal numbers of the shape of `patch`. They are pieces of one long fixed sequence.

    Fresh numbers for every pixel would take longer than a training step of a small network.
    """
    if patch.device not in _BANK:
        generator = torch.Generator().manual_seed(0)
        _BANK[patch.device] = torch.randn(1 << 20, generator=generator).to(patch.device)
    pixels = patch[0].numel()
    windows = _BANK[patch.device].unfold(0, pixels, 1)
    return windows[(random.uniform() * len(windows)).long()].view(patch.shape)
