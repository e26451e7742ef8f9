"""Endless labelled depth images of hands: hand, scene, camera, noise, and the crop that the product would make.

    hands = SyntheticHands('train')
    sample = hands.batch(torch.arange(64))        # patch, joints, ... of samples 0 to 63 of the training split

A sample depends on its split and index only. It does not depend on its batch, nor on what was made before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.synthetic.crops import crop, to_cube
from hand_pose_ros.synthetic.hand import HandModel, SkinnedHand
from hand_pose_ros.synthetic.renderer import View, depth_of, dot
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.scenes import Scene
from hand_pose_ros.synthetic.sensors import SENSORS, get_sensor, sense
from hand_pose_ros.synthetic.stages import CROP, CUBE_SIDE, WINDOW_AT, Ingredients, Motion, Stage, Stages

SPLITS = ('train', 'val', 'test')
LEFT, RIGHT = 1, 2  # as in the message HandJoints

_ELSEWHERE = 0.12  # of the samples with a hand, the share whose cube shows something else, if there is anything else

# A joint is visible only if it lies at most this far behind the surface that is seen. This is about the thickness of
# its flesh (m, for a hand of 0.175 m).
_FLESH = torch.tensor([0.034] + [0.034, 0.024, 0.016, 0.015] + [0.026, 0.017, 0.015, 0.014] * 4)


class SyntheticHands:
    """Samples of one split.

    Args:
        split: 'train', 'val' or 'test'. No two splits share a hand, a pose or any other random number.
        seed_base: each value has its own three splits, which share nothing with those of other values.
        device: where the samples are made.
        sensors: names of the sensors to draw from, equally often; all by default.
        ingredients: what makes the hands real, see `Ingredients`; all by default.
        hand: the hand whose skin is drawn, for example a `rig.Rig`; the parametric hand by default.
        chunk: number of samples that are made at a time, which does not change them. By default it is 64 on a CPU,
            because these fit its caches. On a GPU it is 2,048, because there it takes longer to start the work on a few
            samples than to do it.

    Raises:
        HandPoseError: an unknown split or sensor.
    """

    def __init__(self, split: str = 'train', *, seed_base: int = 0, device: str | torch.device = 'cpu',
                 sensors: Sequence[str] | None = None, ingredients: Ingredients | None = None,
                 hand: SkinnedHand | None = None, chunk: int | None = None) -> None:
        if split not in SPLITS:
            raise HandPoseError(f"unknown split '{split}': choose one of {', '.join(SPLITS)}")
        self.device = torch.device(device)
        self.ingredients = ingredients or Ingredients()
        self.chunk = chunk or (64 if self.device.type == 'cpu' else 2048)
        self._first_seed = (seed_base * len(SPLITS) + SPLITS.index(split)) << 40
        names = [sensor.name for sensor in SENSORS] if sensors is None else list(sensors)
        self._stages = Stages(self.ingredients, torch.tensor([get_sensor(name) for name in names]),
                              hand or HandModel(), self.device)

    @torch.no_grad()
    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """The samples of these indices (B,), int64 >= 0.

        Returns:
            patch: (B, 1, 128, 128) float32 in [-1, 1], as geometry.crop makes it. That of a left hand is mirrored, so
                that a network sees right hands only.
            joints: (B, 21, 3) hand21 in the cube units of the patch (see geometry.Cube), mirrored if the patch is.
            joints_m: (B, 21, 3) metres, optical frame, as they are in the scene.
            cube_center (B, 3), cube_side (B,): metres, optical frame, as in the scene.
            visible: (B, 21) bool, whether what the camera sees at the joint is the skin of this joint.
            hand_present: (B,) bool, whether the crop is of a hand. If not, all joints are 0 and not visible.
            side: (B,) int64, 1 = left, 2 = right in the scene.
            sensor: (B,) int64, index in sensors.SENSORS.
        """
        indices = indices.to(self.device, torch.int64)
        parts = [self._chunk(self._first_seed + some) for some in indices.split(self.chunk)]
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    def _chunk(self, seeds: Tensor) -> dict[str, Tensor]:
        stage = self._stages.build(seeds)
        scene = stage.scene
        center, side, present = self._cubes(stage)
        view, inside = stage.window(center, side)
        clean, own = self._stages.draw(stage, view, center[:, 2] + side / 2)
        clean = torch.where(inside, clean, 0)
        depth = self._sense(stage, clean, view)
        joints = to_cube(scene.joints, center, side)
        visible = self._visible(scene, view, clean, own, inside) & present[:, None]
        flip = torch.where(stage.mirrored, -1.0, 1.0)[:, None] * torch.tensor([1.0, 0, 0], device=self.device)
        flip = flip + torch.tensor([0, 1.0, 1.0], device=self.device)
        there = present[:, None, None]
        return {'patch': crop(depth, center, side, view), 'joints': torch.where(there, joints, 0),
                'joints_m': torch.where(there, scene.joints * flip[:, None], 0), 'cube_center': center * flip,
                'cube_side': side, 'visible': visible, 'hand_present': present,
                'side': torch.where(stage.mirrored, LEFT, RIGHT), 'sensor': stage.sensor}

    @torch.no_grad()
    def scenes(self, indices: Tensor, focal: float, width: int, height: int) -> dict[str, Tensor]:
        """Images of the whole scene of each sample (B,), thinned out to a focal length in pixels.

        Each image is a window of width x height pixels at a random place of the sensor's image. The sensor's image may
        be smaller than the window.

        Returns:
            depth: (B, height, width) metres, 0 = no reading, or outside the sensor's image.
            hands: (B, 2, 3) column (px), row (px) and depth (m) of the middles of the hand and of a second hand; 0
                if not shown.
            shown: (B, 2) bool, whether that hand is there and its middle lies in the image.
        """
        indices = indices.to(self.device, torch.int64)
        parts = [self._scenes(self._first_seed + some, focal, width, height) for some in indices.split(self.chunk)]
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    def _scenes(self, seeds: Tensor, focal: float, width: int, height: int) -> dict[str, Tensor]:
        stage = self._stages.build(seeds)
        scale = focal / stage.camera()[0]
        fx, fy, cx, cy, columns, rows = stage.camera(scale)
        rng = Random(seeds).fork(WINDOW_AT)
        left = ((columns - width) * rng.fork(0).uniform()).round()
        top = ((rows - height) * rng.fork(1).uniform()).round()
        view = View(fx, fy, cx - left, cy - top, height, width)
        clean, _ = self._stages.draw(stage, view)
        across = torch.arange(width, device=self.device) + left[:, None]
        down = torch.arange(height, device=self.device) + top[:, None]
        inside = (((across >= 0) & (across < columns[:, None]))[:, None, :]
                  & ((down >= 0) & (down < rows[:, None]))[:, :, None])
        depth = self._sense(stage, torch.where(inside, clean, 0), view)
        middles = torch.stack([stage.scene.joints.mean(1), torch.zeros_like(stage.position)], 1)
        there = torch.stack([stage.scene.present, torch.zeros_like(stage.scene.present)], 1)
        if (others := stage.scene.others) is not None:
            middles[others.samples, 1] = self._stages.middles(others.vertices)
            there[others.samples, 1] = True
        u, v = view.project(middles)
        at = torch.stack([u, v, middles[..., 2]], -1)
        at_pixel = (torch.arange(len(seeds), device=self.device)[:, None], v.round().long().clamp(0, height - 1),
                    u.round().long().clamp(0, width - 1))
        shown = (there & (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1) & (middles[..., 2] > 0)
                 & inside[at_pixel])
        return {'depth': depth, 'hands': torch.where(shown[..., None], at, 0), 'shown': shown}

    def _sense(self, stage: Stage, clean: Tensor, view: View, frame: int = 0) -> Tensor:
        if not self.ingredients.noise:
            return depth_of(clean)
        return sense(clean, stage.seeds, stage.sensor, view.fx, stage.mirrored, frame)

    def _cubes(self, stage: Stage) -> tuple[Tensor, Tensor, Tensor]:
        """Centres (B, 3) and sides (B,) of the crops, and whether they are of a hand (B,).

        About half are where the detector finds the hand, and half where tracking would have it. Some are of something
        else in the scene, so that a network learns to tell a hand from an elbow, a head or a table.
        """
        rng = Random(stage.seeds).fork(CROP)
        middle = stage.scene.joints.mean(1)
        side = CUBE_SIDE * rng.uniform(low=0.85, high=1.2)
        if not self.ingredients.detector:
            return middle, side, stage.scene.present
        tail = torch.where(rng.chance(0.1), 2.2, 1.0)[:, None]
        tracked = middle + (rng.normal(3, std=0.008) * tail).clamp(-0.025, 0.025)
        present, elsewhere = stage.scene.present, rng.chance(_ELSEWHERE) & stage.scene.present
        if stage.scene.others is not None:
            elsewhere[stage.scene.others.samples] = False  # the something else could be a second hand
        found = self._stages.detect(stage, elsewhere) + rng.normal(3, std=0.003)
        off = to_cube(middle[:, None], found, torch.full_like(side, CUBE_SIDE))[:, 0].abs().amax(1)
        elsewhere &= off > 1.2
        use = elsewhere | (rng.chance(0.5) & ~((off > 0.6) & present))
        return torch.where(use[:, None], found, tracked), side, present & ~elsewhere

    def _visible(self, scene: Scene, view: View, clean: Tensor, own: Tensor, inside: Tensor) -> Tensor:
        u, v = view.project(scene.joints)
        u, v = u.round().long(), v.round().long()
        within = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height) & scene.present[:, None]
        at = v.clamp(0, view.height - 1) * view.width + u.clamp(0, view.width - 1)
        look = lambda image: image.flatten(1).gather(1, at)  # noqa: E731
        metacarpal = scene.joints[:, 9] - scene.joints[:, 0]
        size = dot(metacarpal, metacarpal).sqrt() / 0.078
        behind = scene.joints[..., 2] - depth_of(look(own))
        return (within & look(inside) & (look(own) > 0) & (look(own) >= look(clean))
                & (behind <= _FLESH.to(self.device) * size[:, None]))

    @torch.no_grad()
    def full_frame(self, index: int) -> tuple[NDArray[np.float32], Intrinsics, NDArray[np.float32], str]:
        """A whole image of sample `index`: depth (H, W) in metres, its camera, joints_m (21, 3), 'left' or 'right'.

        If there is no hand, the side is 'none' and the joints are 0.
        """
        stage = self._stages.build(torch.tensor([self._first_seed + index], device=self.device))
        return self._whole(stage)

    @torch.no_grad()
    def sequence(self, index: int, frames: int, *, frames_per_key: int = 24,
                 ) -> Iterator[tuple[NDArray[np.float32], Intrinsics, NDArray[np.float32], str]]:
        """Frames like those of `full_frame`, of a hand that is held up to the camera and moves smoothly.

        Poses, small turns and shifts are drawn every `frames_per_key` frames and joined by cosines. The rest of the
        scene stands still.
        """
        seeds = torch.tensor([self._first_seed + index], device=self.device)
        keys = Motion.draw(seeds, frames // frames_per_key + 2)
        around = self._stages.build(seeds, keys.between(0, 0.0)).scene
        for frame in range(frames):
            key, part = divmod(frame, frames_per_key)
            stage = self._stages.build(seeds, keys.between(key, part / frames_per_key), around)
            yield self._whole(stage, frame)

    def _whole(self, stage: Stage, frame: int = 0) -> tuple[NDArray[np.float32], Intrinsics, NDArray[np.float32], str]:
        fx, fy, cx, cy, width, height = stage.camera()
        view = View(fx, fy, cx, cy, int(height), int(width))
        clean, _ = self._stages.draw(stage, view)
        depth = self._sense(stage, clean, view, frame)[0].cpu().numpy()
        joints, side = stage.scene.joints[0].cpu().numpy(), 'right'
        if stage.mirrored:
            depth, side = np.ascontiguousarray(depth[:, ::-1]), 'left'
            joints = joints * np.array([-1, 1, 1], np.float32)
        if not stage.scene.present:
            joints, side = np.zeros_like(joints), 'none'
        return depth, SENSORS[int(stage.sensor)].intrinsics, joints, side
