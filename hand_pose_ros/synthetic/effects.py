"""What depth sensors do to a perfect depth image.

Each effect is one small function `(nearness, shot) -> nearness`, so that it can be shown alone. Nearness is 1/z in 1/m,
0 = no reading. Triangulating sensors measure disparity, which is focal length x baseline x nearness.

Sources:

- Handa et al. 2014, "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM" (ICL-NUIM), for the
  structured-light chain (jitter, matching window, quantised disparity)
- Nguyen et al. 2012 and Khoshelham and Elberink 2012 for the noise of the first Kinect
- Fankhauser et al. 2015 for the noise of the second Kinect
- Sarbolandi et al. 2015 for flying pixels and multipath of time-of-flight cameras
- Keselman et al. 2017 for RealSense stereo
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from torch.nn import functional

from hand_pose_ros.synthetic.rng import Random

_TILE = 512
_KINDS = {'white': 0.0, 'smooth': 2.0, 'blobs': 6.0}  # standard deviation of the smoothing, px


@cache
def _noise(kind: str, height: int, width: int, device: torch.device) -> Tensor:
    """All cuts of height x width pixels from a tile of normal noise of unit variance.

    They are a view (_TILE, _TILE, height, width) of a plane in which the tile repeats itself.
    """
    tile = Random(torch.tensor([list(_KINDS).index(kind)])).normal(_TILE, _TILE)[0]
    frequency = torch.fft.fftfreq(_TILE)
    squared = frequency[:, None] ** 2 + frequency[None] ** 2
    tile = torch.fft.ifft2(torch.fft.fft2(tile) * torch.exp(-2 * (torch.pi * _KINDS[kind]) ** 2 * squared)).real
    times = (height + _TILE - 1) // _TILE + 1, (width + _TILE - 1) // _TILE + 1
    plane = (tile / tile.std()).repeat(*times)[:_TILE + height - 1, :_TILE + width - 1].to(device)
    return plane.unfold(0, height, 1).unfold(1, width, 1)


@dataclass(frozen=True)
class Shot:
    """What the noise of one batch of images depends on. Tensors are (B, 1, 1).

    Attributes:
        rng: random numbers for what differs from image to image.
        lasting: random numbers for what stays while a camera looks at a scene.
        focal: focal length in pixels of the images at hand.
        scale: `focal` over the focal length of the sensor. It is below 1 where an image was thinned out.
        severity: how strong most effects are, because no two sensors, rooms and skins are alike.
        mirrored: bool, whether the image is mirrored afterwards. If so, the projector is on the other side.
        baseline, noise, step, smoothing: see sensors.Sensor.
    """

    rng: Random
    lasting: Random
    focal: Tensor
    scale: Tensor
    severity: Tensor
    mirrored: Tensor
    baseline: Tensor
    noise: Tensor
    step: Tensor
    smoothing: Tensor
    height: int
    width: int

    @property
    def disparity_per_nearness(self) -> Tensor:
        """Focal length x baseline of the sensor itself, px m."""
        return self.focal / self.scale * self.baseline

    def field(self, kind: str) -> Tensor:
        """(B, H, W) normal noise of unit variance: 'white', 'smooth' (over 2 px) or the lasting 'blobs' (6 px).

        It is cut at random from a fixed tile, which is many times faster than a random number per pixel.
        """
        rng = self.lasting if kind == 'blobs' else self.rng
        row, column = (rng.uniform(2) * _TILE).long().unbind(1)
        return _noise(kind, self.height, self.width, rng.device)[row, column]


def _spread(nearness: Tensor, combine: Callable[[Tensor, Tensor], Tensor] = torch.maximum) -> Tensor:
    """Maximum (or minimum) over 3x3 pixels."""
    for axis in (1, 2):
        length = nearness.shape[axis] - 1
        head, tail = nearness.narrow(axis, 0, length), nearness.narrow(axis, 1, length)
        pair = combine(head, tail)
        middle = combine(pair.narrow(axis, 0, length - 1), tail.narrow(axis, 1, length - 1))
        nearness = torch.cat([pair.narrow(axis, 0, 1), middle, pair.narrow(axis, length - 1, 1)], axis)
    return nearness


def _mean(nearness: Tensor) -> Tensor:
    """Mean over 3x3 pixels. Beyond the border, the pixels at the border are repeated."""
    for axis in (1, 2):
        length = nearness.shape[axis]
        padded = torch.cat([nearness.narrow(axis, 0, 1), nearness, nearness.narrow(axis, length - 1, 1)], axis)
        before, here, after = (padded.narrow(axis, start, length) for start in range(3))
        nearness = (before + here + after) * (1 / 3)
    return nearness


def _slope(nearness: Tensor, shot: Shot) -> Tensor:
    """Squared tangent of the angle of incidence.

    Along each axis, a pixel takes the flatter of its two sides, so that steps between surfaces do not count. For a
    plane, nearness is N . ray, so its gradient in ray slopes is (N_x, N_y) and tan^2 = |gradient|^2 / nearness^2.
    """
    total = torch.zeros_like(nearness)
    for axis in (1, 2):
        length = nearness.shape[axis] - 1
        step = (nearness.narrow(axis, 1, length) - nearness.narrow(axis, 0, length)).abs()
        flat = torch.cat([step.narrow(axis, 0, 1),
                          torch.minimum(step.narrow(axis, 0, length - 1), step.narrow(axis, 1, length - 1)),
                          step.narrow(axis, length - 1, 1)], axis)
        total = total + flat * flat
    ratio = shot.focal / nearness.clamp(min=1e-6)
    return total * (ratio * ratio)


def jitter(nearness: Tensor, shot: Shot) -> Tensor:
    """Lateral noise, which frays edges: each pixel looks N(0, 0.5 px) of the sensor beside itself (Handa 2014)."""
    reach = 0.5 * shot.scale * shot.severity
    across = (shot.field('smooth') * reach).round().long()
    down = (shot.field('smooth') * reach).round().long()
    rows = (torch.arange(shot.height, device=down.device)[:, None] + down).clamp(0, shot.height - 1)
    columns = (torch.arange(shot.width, device=down.device) + across).clamp(0, shot.width - 1)
    return nearness.flatten(1).gather(1, (rows * shot.width + columns).flatten(1)).reshape_as(nearness)


def shadow(nearness: Tensor, shot: Shot) -> Tensor:
    """Shadows beside silhouettes, on one side. What the projector (or second camera) cannot see has no reading.

    A projector at +b sees the pixel u at u - disparity. If it sees a pixel further right in the row more than 1 px
    further left than u, that pixel is nearer and in the way, and u has no reading.
    """
    sign = torch.where(shot.mirrored, -1, 1)
    facing = torch.where(sign > 0, nearness.flip(2), nearness)  # now the projector is on the left
    disparity = facing * (shot.focal * shot.baseline)
    seen_at = torch.arange(shot.width, device=nearness.device) + disparity
    lit = seen_at >= seen_at.cummax(2).values - 1.0
    return torch.where(torch.where(sign > 0, lit.flip(2), lit), nearness, 0)


def matching_window(nearness: Tensor, shot: Shot) -> Tensor:
    """Ragged holes along steps, because a window of the pattern on two surfaces matches neither (Handa 2014)."""
    behind = _spread(nearness) - nearness > 0.03 * nearness
    before = nearness - _spread(nearness, torch.minimum) > 0.03 * nearness
    luck = shot.field('smooth') + 0.5 * shot.field('white')
    bar = shot.severity * shot.scale
    lost = (behind & (luck < 1.2 * bar)) | (before & (luck > 2.7 - 0.9 * bar))
    return torch.where(lost, 0, nearness)


def disparity_noise(nearness: Tensor, shot: Shot) -> Tensor:
    """Noise of the disparity, and its rounding to a step.

    The noise is smooth, because windows overlap. In depth, both grow with z^2 (Khoshelham and Elberink 2012).
    """
    noise = (0.9 * shot.field('smooth') + 0.4 * shot.field('white')) * (shot.noise * shot.severity)
    disparity = ((nearness * shot.disparity_per_nearness + noise) / shot.step).round() * shot.step
    return torch.where(nearness > 0, disparity / shot.disparity_per_nearness, 0).clamp(min=0)


def grazing_holes(nearness: Tensor, shot: Shot) -> Tensor:
    """Grazing surfaces send too little light back. Beyond about 75 degrees, most readings fail (Nguyen 2012)."""
    limit = 4.0 + 1.2 * shot.field('smooth')
    limit = (limit / shot.severity).clamp(min=1.5)
    return torch.where(_slope(nearness, shot) < limit * limit, nearness, 0)


def dark_spots(nearness: Tensor, shot: Shot) -> Tensor:
    """Dark or shiny patches (hair, cloth, rings, wet skin) and single pixels that return nothing."""
    patchy = 2.3 + 3.0 * shot.lasting.uniform(1, 1)
    speckle = 3.0 + 2.0 * shot.lasting.uniform(1, 1)
    lost = (shot.field('blobs') > patchy) | (shot.field('white') > speckle)
    return torch.where(lost, 0, nearness)


def edge_smear(nearness: Tensor, shot: Shot) -> Tensor:
    """Silhouettes grow by about a pixel, because a pixel gathers light from more than its own square.

    The nearer surface sends more of this light. The outermost pixels of silhouettes lie 5-40 mm too deep (measured on
    recordings of a second Kinect).
    """
    amount = shot.scale * (0.5 + shot.lasting.uniform(1, 1))
    within = nearness - ((nearness - _mean(nearness)) * (0.12 * amount)).clamp(max=0.03)
    front = _spread(nearness)
    ramp = (0.022 + 0.009 * shot.field('white')).clamp(0.004, 0.04)
    grows = (front - nearness > 0.05 * front) & (shot.field('smooth') < 2.2 * amount - 0.6)
    return torch.where(grows, front / (1 + front * ramp), within)


def flying_pixels(nearness: Tensor, shot: Shot) -> Tensor:
    """At a step of some centimetres, a pixel mixes both surfaces (Sarbolandi et al. 2015, section 4).

    Either the filter of the driver drops it, or it lies anywhere between the surfaces.
    """
    front, back = _spread(nearness), _spread(nearness, torch.minimum)
    behind = front - nearness > 0.06 * front
    luck = shot.field('white') + shot.field('smooth')
    kept = 2.0 + 2.0 * shot.lasting.uniform(1, 1)  # how strict the driver's filter is
    between = back + (0.5 + 0.35 * shot.field('white')).clamp(0, 1) * (front - back)
    return torch.where(behind & (luck > -2.0), torch.where(luck > kept, between, 0), nearness)


def multipath(nearness: Tensor, shot: Shot) -> Tensor:
    """Light that bounces inside a hollow (a cupped palm) arrives late, so the hollow seems too deep by millimetres."""
    size = (shot.height, shot.width)
    around = functional.avg_pool2d(nearness[:, None], 8, ceil_mode=True)
    around = functional.interpolate(around, size, mode='bilinear')[:, 0]
    hollow = (around / nearness.clamp(min=1e-6) - 1).clamp(0, 0.03)
    gain = 0.4 * shot.severity * shot.lasting.uniform(1, 1)
    return nearness / (1 + gain * hollow)


def tof_noise(nearness: Tensor, shot: Shot) -> Tensor:
    """Axial noise of the second Kinect (Fankhauser 2015).

    In mm, sigma = 1.5 - 0.5 z + 0.3 z^2 + 0.1 z^1.5 theta^2 / (pi/2 - theta)^2. Here, tan^2 theta replaces the last
    fraction.
    """
    z = 1 / nearness.clamp(min=0.1)
    tangent2 = _slope(nearness, shot).clamp(max=40)
    sigma = 1.5 - 0.5 * z + 0.3 * z * z + 0.1 * z * z.sqrt() * tangent2
    scatter = sigma * 1e-3 * (shot.noise * shot.severity)
    noise = 0.85 * shot.field('white') + 0.5 * shot.field('smooth')
    return nearness / (1 + nearness * (scatter * noise).clamp(-0.03, 0.03))


def fattening(nearness: Tensor, shot: Shot) -> Tensor:
    """Silhouettes bulge here and there, because block matching gives the pixels beside a near surface its disparity."""
    return torch.where(shot.field('smooth') > 0.3 - 0.6 * shot.scale * shot.severity,
                       _spread(nearness), nearness)


def smoothing(nearness: Tensor, shot: Shot) -> Tensor:
    """The driver's spatial and temporal filters, as a mean within surfaces but not across steps."""
    front, back = _spread(nearness), _spread(nearness, torch.minimum)
    inside = front - back < 0.04 * front
    return nearness + torch.where(inside, (_mean(nearness) - nearness) * shot.smoothing, 0)
