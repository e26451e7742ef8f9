"""A scene together with the camera that sees it: built from a seed, drawn into any window of the camera's image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.synthetic import scenes
from hand_pose_ros.synthetic.crops import settle
from hand_pose_ros.synthetic.furniture import furnish
from hand_pose_ros.synthetic.hand import HandModel, SkinnedHand
from hand_pose_ros.synthetic.poses import LIMITS, sample_poses
from hand_pose_ros.synthetic.renderer import View, depth_of
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.scenes import Scene
from hand_pose_ros.synthetic.sensors import sensor_table
from hand_pose_ros.synthetic.shapes import Shape, sample_shapes

CUBE_SIDE = 0.30
"""Side of the cube of the product's detector, metres."""
WINDOW = 144
"""Pixels across the window that is drawn for a patch, with a margin for effects that look sideways."""

_COARSE, _COARSE_SIDE = 64, 0.64  # pixels and metres across the image in which the detector's rule runs
_NEAREST = 24  # so many of its pixels (1 cm2 each) make the first guess, from a finger to a hand
_NEGATIVES = 0.05  # share of samples without a hand
_FOREARM = 6  # number of this part of the skin
_SECOND_HAND = 0.08  # share of samples with another hand nearby

# Streams of random numbers.
_SHAPE, _POSE, _VIEW, _CAMERA, _FURNITURE, _SECOND, CROP, _MOTION, _PAST, WINDOW_AT = range(10)


@dataclass(frozen=True)
class Ingredients:
    """What makes the hands real. Switch one off to learn what it is worth.

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
class Motion:
    """How hands depart from those of their samples, as one row or as several to move between.

    Attributes:
        pose: (N, P) radians. It replaces the pose of the sample.
        turn: (N, 3) radians, about the three axes of the camera.
        shift: (N, 3) metres, added to the position.
        nearer: (N, 1) factor on the position, before the shift.
    """

    pose: Tensor
    turn: Tensor
    shift: Tensor
    nearer: Tensor

    @staticmethod
    def draw(seed: Tensor, number: int) -> Motion:
        """`number` random rows to move between, for one seed (1,)."""
        rng = Random(seed).fork(_MOTION)
        high, low = (rng.uniform(2, number)[0] * 2 ** 24).long()
        return Motion(sample_poses(Random(high << 24 | low)), rng.normal(number, 3, std=0.25)[0],
                      rng.normal(number, 3, std=0.025)[0], rng.uniform(number, 1, low=0.9, high=1.1)[0])

    def between(self, key: int, part: float) -> Motion:
        """`part` of the way from row `key` to the next, starting and ending softly."""
        ease = (1 - math.cos(math.pi * part)) / 2
        return Motion(*((t[key:key + 1] + ease * (t[key + 1:key + 2] - t[key:key + 1]))
                         for t in (self.pose, self.turn, self.shift, self.nearer)))


@dataclass
class Stage:
    """Scenes with the cameras that see them. All are made for right hands, and are to be mirrored where `mirrored`."""

    seeds: Tensor
    scene: Scene
    sensor: Tensor
    mirrored: Tensor
    position: Tensor
    elbow: Tensor

    def camera(self, scale: Tensor | float = 1.0) -> tuple[Tensor, ...]:
        """fx, fy, cx, cy, width and height (B,) of the sensors, with `scale` times their pixels along each side."""
        fx, fy, cx, cy, width, height = (sensor_table(name, self.sensor.device)[self.sensor]
                                         for name in ('fx', 'fy', 'cx', 'cy', 'width', 'height'))
        cx = torch.where(self.mirrored, width - 1 - cx, cx)
        return (fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5,
                (width * scale).round(), (height * scale).round())

    def window(self, center: Tensor, side: Tensor) -> tuple[View, Tensor]:
        """The pixels of the sensor that the crop can see, and which of them (B, H, W) lie in the image of the sensor.

        A sensor that is finer than the patch is thinned out to the grid of the patch, because nearest-neighbour
        cropping does that anyway.
        """
        fx, fy, cx, cy, *_ = self.camera()
        scale = (PATCH_SIZE * center[:, 2] / side / torch.maximum(fx, fy)).clamp(max=1)
        fx, fy, cx, cy, width, height = self.camera(scale)
        left = (center[:, 0] / center[:, 2] * fx + cx - (WINDOW - 1) / 2).round()
        top = (center[:, 1] / center[:, 2] * fy + cy - (WINDOW - 1) / 2).round()
        pixels = torch.arange(WINDOW, device=center.device)
        columns, rows = pixels + left[:, None], pixels + top[:, None]
        inside = (((columns >= 0) & (columns < width[:, None]))[:, None, :]
                  & ((rows >= 0) & (rows < height[:, None]))[:, :, None])
        return View(fx, fy, cx - left, cy - top, WINDOW, WINDOW), inside


class _Armed(nn.Module):
    """A hand that ends at the wrist, such as a `Rig`, with the forearm of HandModel."""

    faces: Tensor
    vertex_part: Tensor
    rest: Tensor

    def __init__(self, hand: SkinnedHand) -> None:
        super().__init__()
        self.hand, self.arm = hand, HandModel()
        arm = self.arm.faces[(self.arm.vertex_part[self.arm.faces] == _FOREARM).any(1)]
        self.register_buffer('faces', torch.cat([hand.faces, arm + len(hand.vertex_part)]))
        self.register_buffer('vertex_part', torch.cat([hand.vertex_part, self.arm.vertex_part]))
        self.register_buffer('rest', self.arm.rest.clone())

    def forward(self, shape: Shape, pose: Tensor) -> tuple[Tensor, Tensor]:
        skin, joints = self.hand(shape, pose)
        return torch.cat([skin, self.arm(shape, pose)[0]], 1), joints


class Stages:
    """Makes stages. The arguments are those of `SyntheticHands`, but `sensors` are indices in SENSORS to draw from."""

    def __init__(self, ingredients: Ingredients, sensors: Tensor, hand: SkinnedHand, device: torch.device) -> None:
        self.ingredients = ingredients
        self._sensors = sensors.to(device)
        self._hand: SkinnedHand | _Armed = (hand if (hand.vertex_part == _FOREARM).any() else _Armed(hand)).to(device)
        hand_only = (self._hand.vertex_part[self._hand.faces] != _FOREARM).any(1)
        self._faces = self._hand.faces if self.ingredients.forearm else self._hand.faces[hand_only]
        self._drawn = self._faces.unique()
        forearm = (self._hand.vertex_part == _FOREARM).nonzero()[:, 0]
        rest, _ = self._hand(sample_shapes(Random(torch.zeros(1, device=device))), self._hand.rest[None])
        self._elbow = forearm[rest[0, forearm, 1].argsort()[:8]]

    def build(self, seeds: Tensor, motion: Motion | None = None, around: Scene | None = None) -> Stage:
        """The scenes of these seeds (B,).

        With `motion`, all hands are held up to the camera and depart from their sample by it. What else there is then
        fits the hands of the scene `around`.
        """
        rng = Random(seeds)
        pose = self._poses(rng.fork(_POSE)) if motion is None else motion.pose
        vertices, joints = self._hand(sample_shapes(rng.fork(_SHAPE)), pose)
        rotation, kind = scenes.sample_views(rng.fork(_VIEW), only=None if motion is None else 'frontal')
        draws = rng.fork(_CAMERA)
        sensor = self._sensors[draws.choice(torch.ones(len(self._sensors)))]
        mirrored, present = draws.chance(0.5), ~draws.chance(_NEGATIVES)
        position = scenes.sample_positions(draws, sensor)
        if motion is not None:
            present = torch.ones_like(present)
            position = position * motion.nearer + motion.shift
            rotation = scenes.spin(rotation.mT, motion.turn).mT
        rotation = scenes.keep_arm_off_camera(rotation, position)
        vertices, joints = scenes.place(vertices, joints, rotation, position)
        scene = Scene(vertices, joints, present)
        stage = Stage(seeds, scene, sensor, mirrored, position, vertices[:, self._elbow].mean(1))
        if self.ingredients.scenes:
            furnish(rng.fork(_FURNITURE), scene, kind, stage.elbow, around, arm=self.ingredients.forearm,
                    alone=motion is not None)
            if motion is None:
                self._second_hands(stage)
        return stage

    def _poses(self, rng: Random) -> Tensor:
        if self.ingredients.poses:
            return sample_poses(rng)
        low, high = LIMITS.to(rng.device).unbind(1)
        return low + (high - low) * rng.uniform(len(LIMITS))

    def _second_hands(self, stage: Stage) -> None:
        chosen = Random(stage.seeds).fork(_SECOND).chance(_SECOND_HAND).nonzero()[:, 0]
        if len(chosen) == 0:
            return
        rng = Random(stage.seeds[chosen]).fork(_SECOND)
        rng = rng.fork(0)  # so that the number that chose them is not drawn again
        rotation, _ = scenes.sample_views(rng.fork(0))
        left = rng.chance(0.7)
        angle = 2 * math.pi * rng.uniform()
        away = 0.09 + 0.12 * rng.uniform()
        offset = torch.stack([away * torch.cos(angle), away * torch.sin(angle), 0.05 * rng.normal()], 1)
        position = stage.position[chosen] + offset
        rotation = scenes.keep_arm_off_camera(rotation, position)
        vertices, joints = self._hand(sample_shapes(rng.fork(1)), sample_poses(rng.fork(2)))
        mirror = torch.where(left, -1.0, 1.0)[:, None, None]
        mirror = torch.cat([mirror, torch.ones_like(mirror), torch.ones_like(mirror)], 2)
        placed, _ = scenes.place(vertices * mirror, joints * mirror, rotation, position)
        stage.scene.others = scenes.Others(placed, chosen, left)

    def middles(self, vertices: Tensor) -> Tensor:
        """The mean (B, 3) of this skin (B, V, 3) without the forearm, which is about the mean of the joints."""
        return vertices[:, self._hand.vertex_part != _FOREARM].mean(1)

    def detect(self, stage: Stage, elsewhere: Tensor) -> Tensor:
        """Where the product's detector settles, (B, 3) in metres, found in a coarse image around the hand.

        Args:
            elsewhere: (B,) bool, look past the hand, as the detector does after it has judged an object. Then what is
                near the hand is left out, which leaves the arm. In half of these, all that is nearer than a random
                distance behind the hand is left out, too, which leaves the body or what else is there.
        """
        x, y, z = stage.position.unbind(1)
        focal = _COARSE / _COARSE_SIDE * z
        middle = (_COARSE - 1) / 2
        view = View(focal, focal, middle - x / z * focal, middle - y / z * focal, _COARSE, _COARSE)
        scene = stage.scene
        hand = scenes.splat(scene.vertices[:, self._drawn], view)
        solids = scenes.draw_solids(scene, view, z + torch.where(elsewhere, 3, 1) * CUBE_SIDE)
        image = torch.maximum(solids, torch.where(scene.present[:, None, None], hand, 0))
        if scene.others is not None:
            samples = scene.others.samples
            image[samples] = torch.maximum(image[samples], scenes.splat(scene.others.vertices, view[samples]))
        fx, fy, cx, cy, width, height = (t[:, None, None] for t in stage.camera())
        column, row = view.rays[0] * fx + cx, view.rays[1] * fy + cy
        seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        depth = depth_of(torch.where(seen, image, 0))
        past = Random(stage.seeds).fork(_PAST)
        behind = z + torch.where(past.chance(0.5), 0.3 * past.uniform(), -3.0)
        hand_x, hand_y, hand_z = (t[:, None, None] for t in scene.joints.mean(1).unbind(1))
        cut = ((view.rays[0] * depth - hand_x).abs().maximum((view.rays[1] * depth - hand_y).abs()).maximum(
            (depth - hand_z).abs()) < CUBE_SIDE / 2) | (depth < behind[:, None, None])
        depth = torch.where(cut & elsewhere[:, None, None], 0, depth)
        return settle(depth, view, CUBE_SIDE, _NEAREST, otherwise=stage.position)

    def draw(self, stage: Stage, view: View, back: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Nearness of everything, and of the hand alone."""
        relief = scenes.smooth_relief(Random(stage.seeds).fork(_FURNITURE).fork(99), view)
        image = scenes.draw_solids(stage.scene, view, back, relief)
        own, others = scenes.draw_hands(stage.scene, self._faces, view)
        if not self.ingredients.surface:
            own = scenes.draw_sticks(stage.scene, stage.elbow if self.ingredients.forearm else None, view)
        return torch.maximum(torch.maximum(image, others), own), own
