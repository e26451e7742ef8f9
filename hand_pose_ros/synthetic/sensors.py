"""Depth sensors by name: their cameras, ranges and noise, and the chain of effects of each family.

The effects are in `hand_pose_ros.synthetic.effects`, with their sources.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.synthetic import effects
from hand_pose_ros.synthetic.effects import Shot
from hand_pose_ros.synthetic.rng import Random


@dataclass(frozen=True)
class Sensor:
    """One model of depth camera.

    Attributes:
        family: key of `FAMILIES`.
        hand_distance: nearest and farthest distance of a hand that it is used for, m.
        near, far: nearest and farthest reading, m.
        noise: standard deviation of the disparity, px; for time of flight, a factor on Fankhauser's model.
        baseline: from camera to projector or second camera along +x, m.
        step: step to which the disparity is rounded, px.
        unit: metres per unit of its images.
        smoothing: share of an edge-preserving 3x3 mean in the output (the filters that its driver runs).
    """

    name: str
    family: str
    intrinsics: Intrinsics
    hand_distance: tuple[float, float]
    near: float
    far: float
    noise: float
    baseline: float = 0.0
    step: float = 0.0
    unit: float = 0.001
    smoothing: float = 0.0


SENSORS = (
    Sensor('primesense', 'structured_light', Intrinsics(588.03, 587.07, 320, 240, 640, 480), (0.5, 1.1), 0.4, 3.5,
           noise=0.045, baseline=0.075, step=1 / 8),
    Sensor('kinect1', 'structured_light', Intrinsics(585.6, 585.6, 316, 247.6, 640, 480), (0.7, 1.4), 0.5, 4.0,
           noise=0.055, baseline=0.075, step=1 / 8),
    Sensor('sr305', 'structured_light', Intrinsics(476.0, 476.0, 313.7, 242.8, 640, 480), (0.25, 0.8), 0.2, 1.5,
           noise=0.018, baseline=0.026, step=1 / 32, unit=0.000125, smoothing=0.8),
    Sensor('kinect2', 'time_of_flight', Intrinsics(364.5, 364.5, 256, 208, 512, 424), (0.6, 1.2), 0.5, 4.5, noise=1.3),
    Sensor('azure', 'time_of_flight', Intrinsics(504.0, 504.0, 320, 332, 640, 576), (0.3, 1.1), 0.25, 4.0, noise=0.8),
    Sensor('pmd', 'time_of_flight', Intrinsics(210.6, 210.6, 112, 86, 224, 172), (0.25, 0.8), 0.1, 4.0, noise=1.6),
    Sensor('senz3d', 'time_of_flight', Intrinsics(241.4, 241.4, 160, 120, 320, 240), (0.22, 0.65), 0.15, 1.5,
           noise=1.5),
    Sensor('d435', 'active_stereo', Intrinsics(383.0, 383.0, 320, 240, 640, 480), (0.3, 0.9), 0.2, 6.0,
           noise=0.08, baseline=0.050, step=1 / 32, smoothing=0.5),
    Sensor('d415', 'active_stereo', Intrinsics(606.0, 606.0, 320, 240, 640, 480), (0.4, 1.1), 0.3, 6.0,
           noise=0.08, baseline=0.055, step=1 / 32, smoothing=0.5),
)
"""Intrinsics are typical factory values. A hand may be anywhere in `hand_distance`."""


def get_sensor(name: str) -> int:
    """Index in SENSORS of the sensor of this name.

    Raises:
        HandPoseError: there is none.
    """
    names = [sensor.name for sensor in SENSORS]
    if name not in names:
        raise HandPoseError(f"unknown sensor '{name}': choose one of {', '.join(names)}")
    return names.index(name)


@cache
def sensor_table(field: str, device: torch.device) -> Tensor:
    """One property of all SENSORS as a (S,) or (S, 2) tensor. Intrinsics have their own names (fx, width ...)."""
    return torch.tensor([getattr(s if hasattr(s, field) else s.intrinsics, field) for s in SENSORS],
                        dtype=torch.float32, device=device)


FAMILIES: dict[str, tuple[Callable[[Tensor, Shot], Tensor], ...]] = {
    'structured_light': (effects.shadow, effects.jitter, effects.matching_window, effects.grazing_holes,
                         effects.disparity_noise, effects.smoothing, effects.dark_spots),
    'time_of_flight': (effects.multipath, effects.grazing_holes, effects.edge_smear, effects.tof_noise,
                       effects.flying_pixels, effects.dark_spots),
    'active_stereo': (effects.shadow, effects.fattening, effects.jitter, effects.grazing_holes,
                      effects.disparity_noise, effects.smoothing, effects.dark_spots),
}
"""The effects of each family, in the order in which they happen."""


def sense(nearness: Tensor, seeds: Tensor, sensor: Tensor, focal: Tensor, mirrored: Tensor, frame: int = 0) -> Tensor:
    """What the sensors make of perfect images.

    Args:
        nearness: (B, H, W), 1/z in 1/m.
        seeds: (B,) of the noise, and of what stays while a camera looks at a scene.
        sensor: (B,) indices in SENSORS.
        focal: (B,) focal length of these images, px. It is lower than that of the sensor where they were thinned out.
        mirrored: (B,) bool, whether the images are mirrored afterwards.
        frame: number of these images in a sequence, where each image has its own noise.

    Returns:
        (B, H, W) depth in metres, 0 = no reading.
    """
    depth = torch.zeros_like(nearness)
    for family, chain in FAMILIES.items():
        of_family = torch.tensor([s.family == family for s in SENSORS], device=sensor.device)
        members = of_family[sensor].nonzero()[:, 0]
        if len(members) == 0:
            continue

        def of_sensor(field: str, members: Tensor = members) -> Tensor:
            return sensor_table(field, sensor.device)[sensor[members]][:, None, None]

        rng = Random(seeds[members])
        lasting = rng.fork(0)
        focal_here = focal[members][:, None, None]
        shot = Shot(rng.fork(1 + frame), lasting, focal_here, focal_here / of_sensor('fx'),
                    lasting.uniform(1, 1, low=0.5, high=1.5),
                    mirrored[members][:, None, None], of_sensor('baseline'), of_sensor('noise'), of_sensor('step'),
                    of_sensor('smoothing'), *nearness.shape[1:])
        image = nearness[members]
        for effect in chain:
            image = effect(image, shot)
        unit = of_sensor('unit')
        z = (1 / image.clamp(min=1e-6) / unit).round() * unit
        depth[members] = torch.where((z >= of_sensor('near')) & (z <= of_sensor('far')), z, 0)
    return depth
