"""Labelled depth hands without end: hand, scene, camera, noise, and the crop that the product would make.

    hands = SyntheticHands('train')
    sample = hands.batch(torch.arange(64))        # patch, joints, ... of samples 0 to 63 of the training split

A sample depends on its split and index alone: not on the batch it is in, nor on what was made before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hand_pose_ros.geometry import PATCH_SIZE, Intrinsics
from hand_pose_ros.synthetic import scenes
from hand_pose_ros.synthetic.hand import HandModel
from hand_pose_ros.synthetic.poses import sample_poses
from hand_pose_ros.synthetic.renderer import View, depth_of
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.scenes import Scene
from hand_pose_ros.synthetic.sensors import SENSORS, get_sensor, sense, sensor_table
from hand_pose_ros.synthetic.shapes import sample_shapes

SPLITS = ('train', 'val', 'test')
LEFT, RIGHT = 1, 2  # as in the message HandJoints

CUBE_SIDE = 0.30  # of the product's detector
_WINDOW = 144  # pixels across the rendered window: the patch and a margin for effects that look sideways
_COARSE, _COARSE_SIDE = 64, 0.64  # pixels and metres across the image in which the detector's rule runs
_NEAREST = 24  # of its pixels (1 cm2 each) make the first guess: an object of finger-to-hand size
_NEGATIVES = 0.05  # share of samples without a hand
_SECOND_HAND = 0.08
_SECOND_BLOCK = 8

# Behind its surface lies a joint that can be seen: at most about its flesh (m, for a hand of 0.175 m).
_FLESH = torch.tensor([0.034] + [0.034, 0.024, 0.016, 0.015] + [0.026, 0.017, 0.015, 0.014] * 4)

_SHAPE, _POSE, _VIEW, _CAMERA, _FURNITURE, _SECOND, _CROP = range(7)  # streams of random numbers


@dataclass(frozen=True)
class Ingredients:
    """What makes the hands real; switch one off to learn what it is worth.

    Attributes:
        surface: skin; without it, sticks and balls.
        poses: the pose sampler; without it, independent uniform angles.
        forearm: the arm behind the wrist.
        scenes: anything but the hand.
        noise: the sensor; without it, perfect depth.
        detector: crops centred as the product does; without it, on the true mean of the joints.
    """

    surface: bool = True
    poses: bool = True
    forearm: bool = True
    scenes: bool = True
    noise: bool = True
    detector: bool = True


@dataclass
class _Stage:
    """Scenes with the cameras that see them; all for right hands, to be mirrored where `mirrored`."""

    seeds: Tensor
    scene: Scene
    sensor: Tensor
    mirrored: Tensor
    position: Tensor

    def camera(self, scale: Tensor | float = 1.0) -> tuple[Tensor, ...]:
        """fx, fy, cx, cy, width and height (B,) of the sensors with `scale` times their pixels."""
        fx, fy, cx, cy, width, height = (sensor_table(name, self.sensor.device)[self.sensor]
                                         for name in ('fx', 'fy', 'cx', 'cy', 'width', 'height'))
        cx = torch.where(self.mirrored, width - 1 - cx, cx)
        return (fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5,
                (width * scale).round(), (height * scale).round())


class SyntheticHands:
    """Samples of one split.

    Args:
        split: 'train', 'val' or 'test': no two share a hand, a pose or any other random number.
        seed_base: another value gives another, equally disjoint, family of splits.
        device: where everything happens.
        sensors: names of the sensors to draw from, equally often; all by default.
        ingredients: see Ingredients.
        chunk: samples worked on at a time; bounds memory, does not change any sample.

    Raises:
        ValueError: an unknown split or sensor.
    """

    def __init__(self, split: str = 'train', *, seed_base: int = 0, device: str | torch.device = 'cpu',
                 sensors: Sequence[str] | None = None, ingredients: Ingredients | None = None, chunk: int = 64) -> None:
        if split not in SPLITS:
            raise ValueError(f"unknown split '{split}': choose one of {', '.join(SPLITS)}")
        self.device = torch.device(device)
        self.ingredients = ingredients or Ingredients()
        self.chunk = chunk
        self._first_seed = (seed_base * len(SPLITS) + SPLITS.index(split)) << 40
        names = [sensor.name for sensor in SENSORS] if sensors is None else list(sensors)
        self._sensors = torch.tensor([get_sensor(name) for name in names], device=self.device)
        self._hand = HandModel().to(self.device)
        hand_only = (self._hand.vertex_part[self._hand.faces] != 6).any(1)
        self._faces = self._hand.faces if self.ingredients.forearm else self._hand.faces[hand_only]
        self._hand_vertices = self._faces.unique()
        forearm = (self._hand.vertex_part == 6).nonzero()[:, 0]
        rest, _ = self._hand(sample_shapes(Random(torch.zeros(1, device=self.device))),
                             self._hand.rest[None])
        self._elbow = forearm[rest[0, forearm, 1].argsort()[:8]]

    @torch.no_grad()
    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """The samples of these indices (B,), int64 >= 0.

        Returns:
            patch: (B, 1, 128, 128) float32 in [-1, 1], as geometry.crop makes it; a left hand's is mirrored, so that a
                network only ever sees right hands.
            joints: (B, 21, 3) hand21 in the patch's cube units (see geometry.Cube), mirrored with it.
            joints_m: (B, 21, 3) metres, optical frame, as they are in the scene.
            cube_center (B, 3), cube_side (B,): metres, optical frame, as in the scene.
            visible: (B, 21) bool, whether the joint's skin is what the camera sees there.
            hand_present: (B,) bool; joints are 0 and invisible where there is none.
            side: (B,) int64, 1 = left, 2 = right in the scene.
            sensor: (B,) int64, index in sensors.SENSORS.
        """
        indices = indices.to(self.device, torch.int64)
        parts = []
        for some in indices.split(self.chunk):
            # Always whole chunks: matrix products round differently in other sizes.
            full = torch.cat([some, some[-1:].expand(self.chunk - len(some))])
            parts.append({key: value[:len(some)] for key, value in self._chunk(self._first_seed + full).items()})
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    def _chunk(self, seeds: Tensor) -> dict[str, Tensor]:
        stage = self._stage(seeds)
        scene = stage.scene
        center, side = self._cubes(stage)
        view, inside = self._window(stage, center, side)
        clean, own = self._render(stage, view, center[:, 2] + side / 2)
        clean = torch.where(inside, clean, 0)
        depth = self._sense(stage, clean, view, seeds)
        joints = to_cube(scene.joints, center, side)
        visible = self._visible(scene, view, clean, own, inside)
        flip = torch.where(stage.mirrored, -1.0, 1.0)[:, None] * torch.tensor([1.0, 0, 0], device=self.device)
        flip = flip + torch.tensor([0, 1.0, 1.0], device=self.device)
        there = scene.present[:, None, None]
        return {'patch': crop(depth, center, side, view), 'joints': torch.where(there, joints, 0),
                'joints_m': torch.where(there, scene.joints * flip[:, None], 0), 'cube_center': center * flip,
                'cube_side': side, 'visible': visible, 'hand_present': scene.present,
                'side': torch.where(stage.mirrored, LEFT, RIGHT), 'sensor': stage.sensor}

    def _stage(self, seeds: Tensor) -> _Stage:
        rng = Random(seeds)
        pose = self._poses(rng.fork(_POSE))
        vertices, joints = self._hand(sample_shapes(rng.fork(_SHAPE)), pose)
        rotation, kind = scenes.sample_views(rng.fork(_VIEW))
        draws = rng.fork(_CAMERA)
        sensor = self._sensors[draws.choice(torch.ones(len(self._sensors)))]
        mirrored, present = draws.chance(0.5), ~draws.chance(_NEGATIVES)
        position = scenes.sample_positions(draws, sensor)
        rotation = scenes.keep_arm_off_camera(rotation, position)
        vertices, joints = scenes.place(vertices, joints, rotation, position)
        scene = Scene(vertices, joints, present)
        stage = _Stage(seeds, scene, sensor, mirrored, position)
        if self.ingredients.scenes:
            scenes.furnish(rng.fork(_FURNITURE), scene, kind, vertices[:, self._elbow].mean(1))
            self._second_hands(stage)
        return stage

    def _poses(self, rng: Random) -> Tensor:
        return sample_poses(rng)

    def _second_hands(self, stage: _Stage) -> None:
        chosen = Random(stage.seeds).fork(_SECOND).chance(_SECOND_HAND).nonzero()[:, 0]
        if len(chosen) == 0:
            return
        rng = Random(stage.seeds[chosen]).fork(_SECOND)
        rng.uniform()  # the one that chose them
        rotation, _ = scenes.sample_views(rng.fork(0))
        left = rng.chance(0.7)
        angle = 2 * math.pi * rng.uniform()
        away = 0.09 + 0.12 * rng.uniform()
        offset = torch.stack([away * torch.cos(angle), away * torch.sin(angle), 0.05 * rng.normal()], 1)
        position = stage.position[chosen] + offset
        rotation = scenes.keep_arm_off_camera(rotation, position)
        vertices, joints = [], []
        for some in chosen.split(_SECOND_BLOCK):  # whole blocks, as in `batch`
            full = torch.cat([some, some[-1:].expand(_SECOND_BLOCK - len(some))])
            draws = Random(stage.seeds[full]).fork(_SECOND)
            v, j = self._hand(sample_shapes(draws.fork(1)), sample_poses(draws.fork(2)))
            vertices.append(v[:len(some)])
            joints.append(j[:len(some)])
        mirror = torch.where(left, -1.0, 1.0)[:, None, None]
        mirror = torch.cat([mirror, torch.ones_like(mirror), torch.ones_like(mirror)], 2)
        placed, _ = scenes.place(torch.cat(vertices) * mirror, torch.cat(joints) * mirror, rotation, position)
        stage.scene.other, stage.scene.other_of, stage.scene.other_is_left = placed, chosen, left

    def _render(self, stage: _Stage, view: View, back: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Nearness of everything, and of the hand alone."""
        relief = scenes.smooth_relief(Random(stage.seeds).fork(_FURNITURE).fork(99), view)
        image = scenes.draw_solids(stage.scene, view, back, relief)
        own, others = scenes.draw_hands(stage.scene, self._faces, view)
        if others is not None:
            image[stage.scene.other_of] = torch.maximum(image[stage.scene.other_of], others)
        return torch.maximum(image, own), own

    def _sense(self, stage: _Stage, clean: Tensor, view: View, seeds: Tensor) -> Tensor:
        if not self.ingredients.noise:
            return depth_of(clean)
        return sense(clean, seeds, stage.sensor, view.fx, stage.mirrored)

    def _cubes(self, stage: _Stage) -> tuple[Tensor, Tensor]:
        """Centres (B, 3) and sides (B,) of the crops: half as the detector finds them, half as tracking would."""
        rng = Random(stage.seeds).fork(_CROP)
        middle = stage.scene.joints.mean(1)
        side = CUBE_SIDE * rng.uniform(low=0.85, high=1.2)
        if not self.ingredients.detector:
            return middle, side
        tail = torch.where(rng.chance(0.1), 2.2, 1.0)[:, None]
        tracked = middle + (rng.normal(3, std=0.008) * tail).clamp(-0.025, 0.025)
        found = self._detect(stage) + rng.normal(3, std=0.003)
        astray = (to_cube(middle[:, None], found, torch.full_like(side, CUBE_SIDE))[:, 0].abs() > 0.6).any(1)
        use = rng.chance(0.5) & ~(astray & stage.scene.present)
        return torch.where(use[:, None], found, tracked), side

    def _detect(self, stage: _Stage) -> Tensor:
        """The rule of hand_pose_ros.detection on a coarse image around the hand: from the nearest object to the centre
        of mass of what a cube around it holds, five times. (B, 3) in metres."""
        x, y, z = stage.position.unbind(1)
        focal = _COARSE / _COARSE_SIDE * z
        middle = (_COARSE - 1) / 2
        view = View(focal, focal, middle - x / z * focal, middle - y / z * focal, _COARSE, _COARSE)
        scene = stage.scene
        hand = scenes.splat(scene.vertices[:, self._hand_vertices], view)
        image = torch.maximum(scenes.draw_solids(scene, view, stage.position[:, 2] + CUBE_SIDE), torch.where(scene.present[:, None, None], hand, 0))
        if scene.other is not None:
            image[scene.other_of] = torch.maximum(image[scene.other_of], scenes.splat(scene.other, view[scene.other_of]))
        ray_x, ray_y = view.rays
        fx, fy, cx, cy, width, height = (t[:, None, None] for t in stage.camera())
        column, row = ray_x * fx + cx, ray_y * fy + cy
        image = torch.where((column >= 0) & (column < width) & (row >= 0) & (row < height) & (image > 1 / 1.5), image, 0)

        ray_x, ray_y = ray_x.expand_as(image).flatten(1), ray_y.expand_as(image).flatten(1)
        nearest, where = image.flatten(1).topk(_NEAREST)
        depth = depth_of(image).flatten(1)

        def centroid(mask: Tensor, at_x: Tensor, at_y: Tensor, at_z: Tensor, otherwise: Tensor) -> Tensor:
            count = mask.sum(1)
            mean = [torch.where(mask, value, 0).double().sum(1) / count.clamp(min=1) for value in (at_x, at_y, at_z)]
            point = torch.stack([mean[0] * mean[2], mean[1] * mean[2], mean[2]], 1).float()
            return torch.where((count > 0)[:, None], point, otherwise)

        center = centroid(nearest > 0, ray_x.gather(1, where), ray_y.gather(1, where), depth_of(nearest), stage.position)
        half = CUBE_SIDE / 2
        for _ in range(5):
            x, y, z = (t[:, None] for t in center.unbind(1))
            mask = ((depth > 0) & ((depth - z).abs() <= half) & ((ray_x * z - x).abs() <= half)
                    & ((ray_y * z - y).abs() <= half))
            center = centroid(mask, ray_x, ray_y, depth, center)
        return center

    def _window(self, stage: _Stage, center: Tensor, side: Tensor) -> tuple[View, Tensor]:
        """The pixels of the sensor that the crop can see, and which of them (B, H, W) lie in its image.

        A sensor finer than the patch is thinned out to the patch's grid: nearest-neighbour cropping does that anyway.
        """
        fx, fy, cx, cy, *_ = stage.camera()
        scale = (PATCH_SIZE * center[:, 2] / side / torch.maximum(fx, fy)).clamp(max=1)
        fx, fy, cx, cy, width, height = stage.camera(scale)
        left = (center[:, 0] / center[:, 2] * fx + cx - (_WINDOW - 1) / 2).round()
        top = (center[:, 1] / center[:, 2] * fy + cy - (_WINDOW - 1) / 2).round()
        pixels = torch.arange(_WINDOW, device=self.device)
        columns, rows = pixels + left[:, None], pixels + top[:, None]
        inside = (((columns >= 0) & (columns < width[:, None]))[:, None, :]
                  & ((rows >= 0) & (rows < height[:, None]))[:, :, None])
        return View(fx, fy, cx - left, cy - top, _WINDOW, _WINDOW), inside

    def _visible(self, scene: Scene, view: View, clean: Tensor, own: Tensor, inside: Tensor) -> Tensor:
        u, v = view.project(scene.joints)
        u, v = u.round().long(), v.round().long()
        within = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height) & scene.present[:, None]
        at = v.clamp(0, view.height - 1) * view.width + u.clamp(0, view.width - 1)
        look = lambda image: image.flatten(1).gather(1, at)  # noqa: E731
        size = dot_length(scene.joints[:, 9] - scene.joints[:, 0]) / 0.078
        behind = scene.joints[..., 2] - depth_of(look(own))
        return (within & look(inside) & (look(own) > 0) & (look(own) >= look(clean))
                & (behind <= _FLESH.to(self.device) * size[:, None]))

    @torch.no_grad()
    def full_frame(self, index: int) -> tuple[NDArray[np.float32], Intrinsics, NDArray[np.float32], str]:
        """A whole image of sample `index`: depth (H, W) in metres, its camera, joints_m (21, 3), 'left' or 'right'.

        The side is 'none' and the joints 0 where there is no hand.
        """
        stage = self._stage(torch.tensor([self._first_seed + index], device=self.device))
        return self._whole(stage, stage.seeds)

    def _whole(self, stage: _Stage, noise: Tensor) -> tuple[NDArray[np.float32], Intrinsics, NDArray[np.float32], str]:
        fx, fy, cx, cy, width, height = stage.camera()
        view = View(fx, fy, cx, cy, int(height), int(width))
        clean, _ = self._render(stage, view)
        depth = self._sense(stage, clean, view, noise)[0].cpu().numpy()
        joints = stage.scene.joints[0].cpu().numpy()
        intrinsics = SENSORS[int(stage.sensor)].intrinsics
        if not stage.scene.present:
            return depth, intrinsics, np.zeros_like(joints), 'none'
        if stage.mirrored:
            return np.ascontiguousarray(depth[:, ::-1]), intrinsics, joints * np.float32([-1, 1, 1]), 'left'
        return depth, intrinsics, joints, 'right'


def dot_length(vector: Tensor) -> Tensor:
    return (vector * vector).sum(-1).sqrt()


def to_cube(points: Tensor, center: Tensor, side: Tensor) -> Tensor:
    """Points (B, N, 3) in metres -> cube units, as geometry.Cube.to_cube."""
    half = side[:, None] / 2
    x, y, z = points.unbind(-1)
    on_plane = center[:, 2:] / z
    return torch.stack([(x * on_plane - center[:, :1]) / half, (y * on_plane - center[:, 1:2]) / half,
                        (z - center[:, 2:]) / half], -1)


def crop(depth: Tensor, center: Tensor, side: Tensor, view: View) -> Tensor:
    """geometry.crop for a batch, bit for bit: depth (B, H, W) -> patches (B, 1, 128, 128).

    Its warp (cv2.warpAffine, nearest) rounds positions to 1/1024 of a pixel and those halves up.
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
    back = (at[:, 2] + half).float()[:, None, None]
    patch = torch.where(inside & (patch != 0), patch, back)
    return ((patch - center[:, 2, None, None]) / (side / 2)[:, None, None]).clamp(-1, 1)[:, None]


