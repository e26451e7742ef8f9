"""What else there is in a scene: tables, bodies, sleeves, things in the hand and around it."""

from __future__ import annotations

import torch
from torch import Tensor

from hand_pose_ros.synthetic import renderer
from hand_pose_ros.synthetic.renderer import dot
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.scenes import VIEWS, Scene, Solid, cross, normalize, random_rotation, spin_about


class Furnisher:
    """Adds things to a scene. Each draws from a random stream of its own.

    The arm, and what the hand holds and wears, move with the hand. Everything else is placed to fit the hands of the
    scene `around`.
    """

    def __init__(self, rng: Random, scene: Scene, view: Tensor, elbow: Tensor, around: Scene) -> None:
        self.rng, self.scene, self.view, self.elbow, self.around = rng, scene, view, elbow, around
        self.center = around.joints.mean(1)
        self.far = around.joints[..., 2].amax(1) + 0.012
        self._stream = 0

    def _draws(self) -> Random:
        self._stream += 1
        return self.rng.fork(self._stream)

    def _chance(self, rng: Random, shares: dict[str, float]) -> Tensor:
        """Samples (K,), chosen with the share of their view, or with that of 'any' if their view has none."""
        table = torch.tensor([shares.get(name, shares['any']) for name in VIEWS], device=rng.device)
        return (rng.uniform() < table[self.view]).nonzero()[:, 0]

    @staticmethod
    def _ellipsoid(to: list[Solid], samples: Tensor, center: Tensor, axes: Tensor, radii: Tensor) -> None:
        center, axes, radii = center[samples], axes[samples], radii[samples]
        to.append(Solid(renderer.ellipsoid, samples, (center, axes, radii), center[:, None],
                        radii.amax(1, keepdim=True)))

    @staticmethod
    def _box(to: list[Solid], samples: Tensor, center: Tensor, axes: Tensor, half: Tensor) -> None:
        center, axes, half = center[samples], axes[samples], half[samples]
        to.append(Solid(renderer.box, samples, (center, axes, half), center[:, None],
                        dot(half, half).sqrt()[:, None]))

    @staticmethod
    def _cone(to: list[Solid], samples: Tensor, start: Tensor, end: Tensor, radius: Tensor, end_radius: Tensor) -> None:
        start, end, radius, end_radius = start[samples], end[samples], radius[samples], end_radius[samples]
        to.append(Solid(renderer.round_cone, samples, (start, end, radius, end_radius),
                        torch.stack([start, end], 1), torch.stack([radius, end_radius], 1)))

    def surface(self) -> None:
        """A table under the hand or a wall behind it, as a plane that arm and hand touch or stay clear of."""
        rng = self._draws()
        samples = self._chance(rng, {'overhead': 0.8, 'egocentric': 0.6, 'any': 0.35})
        down = torch.tensor([0.0, 0.75, 0.66], device=rng.device)
        away = torch.tensor([0.0, 0.0, 1.0], device=rng.device)
        table = self.view == list(VIEWS).index('egocentric')
        normal = normalize(torch.where(table[:, None], down, away) + rng.normal(3, std=0.22))
        normal = torch.where(normal[:, 2:] < 0.2, away, normal)
        touch = dot(normal[:, None], self.around.vertices).amax(1)
        gap = torch.where(rng.chance(0.25), 0.0, -torch.log(1 - rng.uniform()) * 0.25)
        self.scene.soft.append(Solid(renderer.plane, samples, (normal[samples], (touch + gap)[samples])))

    def body(self, arm: bool) -> None:
        """In some samples, torso and head of the person behind the hand. With `arm`, all hands have an upper arm."""
        rng = self._draws()
        samples = self._chance(rng, {'overhead': 0.1, 'egocentric': 0.05, 'any': 0.6})
        size = rng.uniform(3, low=0.85, high=1.15)
        torso = size * torch.tensor([0.20, 0.31, 0.12], device=rng.device)
        gap = rng.uniform(low=0.01, high=0.5)
        aside, below = rng.normal(std=0.16), rng.uniform(low=-0.1, high=0.45)
        center = torch.stack([self.center[:, 0] + aside, self.center[:, 1] + below, self.far + gap + torso[:, 2]], 1)
        axes = spin_about(torch.eye(3, device=rng.device).expand(len(rng), 3, 3), 2, rng.normal(std=0.15))
        self._ellipsoid(self.scene.soft, samples, center, axes, torso)
        head = size * torch.tensor([0.078, 0.118, 0.098], device=rng.device)
        nod = rng.normal(3, std=0.03)
        above = torch.stack([nod[:, 0], -torso[:, 1] - 0.09 + nod[:, 1], nod[:, 2]], 1)
        self._ellipsoid(self.scene.soft, samples, center + above, axes, head)
        shoulder = center + torch.stack([torso[:, 0] * torch.where(rng.chance(0.5), 0.95, -0.95), -0.75 * torso[:, 1],
                                         torch.zeros_like(gap)], 1)
        if arm:
            away, behind = self.elbow - self.scene.joints[:, 0], torch.tensor([0.0, 0.0, 0.4], device=rng.device)
            free = self.elbow + 0.3 * normalize(normalize(away) + rng.normal(3, std=0.5) + behind)
            free = torch.cat([free[:, :2], free[:, 2:].clamp(min=0.2)], 1)
            seated = torch.zeros(len(rng), dtype=torch.bool, device=rng.device).index_fill_(0, samples, True)
            thick = 0.042 * size[:, 0]
            self._cone(self.scene.soft, self.scene.present.nonzero()[:, 0], self.elbow,
                       torch.where(seated[:, None], shoulder, free), thick, thick * 1.35)

    def sleeve(self) -> None:
        """A sleeve from somewhere along the forearm to the elbow, loose or tight."""
        rng = self._draws()
        samples = self._chance(rng, {'any': 0.4})
        wrist = self.scene.joints[:, 0]
        cuff = wrist + (self.elbow - wrist) * rng.uniform(1, low=0.12, high=0.8)
        width = rng.uniform(low=0.034, high=0.052)
        self._cone(self.scene.soft, samples, cuff, self.elbow, width, width * rng.uniform(low=1.0, high=1.4))

    def held(self) -> None:
        """A ball, a bar or a flat box in the hand."""
        rng = self._draws()
        chosen, what = rng.chance(0.14), rng.uniform()
        joints = self.scene.joints
        across, along = normalize(joints[:, 5] - joints[:, 17]), normalize(joints[:, 9] - joints[:, 0])
        palmar = normalize(cross(across, along))
        radius = rng.uniform(low=0.010, high=0.038)
        palm = joints[:, (0, 5, 9, 13, 17)].mean(1) + palmar * (0.012 + radius[:, None])
        center = palm + 0.5 * (joints[:, (4, 8, 12, 16)].mean(1) - palm)
        axis = normalize(across + rng.normal(3, std=0.25))
        reach = axis * rng.uniform(1, low=0.04, high=0.13)
        self._ellipsoid(self.scene.hard, (chosen & (what < 0.35)).nonzero()[:, 0], center,
                  random_rotation(rng), radius[:, None] * rng.uniform(3, low=0.8, high=1.3))
        self._cone(self.scene.hard, (chosen & (what >= 0.35) & (what < 0.75)).nonzero()[:, 0],
                  center - reach, center + reach, radius * 0.7, radius * 0.7)
        frame = torch.stack([across, along, palmar], 2)
        half = rng.uniform(3, low=0.7, high=1.3) * torch.tensor([0.036, 0.07, 0.007], device=rng.device)
        self._box(self.scene.hard, (chosen & (what >= 0.75)).nonzero()[:, 0], center, frame, half)

    def clutter(self) -> None:
        """Things behind, beside and in front of the hand."""
        for chance, before in ((0.25, False), (0.25, False), (0.07, True)):
            rng = self._draws()
            chosen, what = rng.chance(chance), rng.uniform()
            size = rng.uniform(3, low=0.012, high=0.05) if before else rng.uniform(3, low=0.03, high=0.2)
            aside = rng.normal(2, std=0.05) if before else rng.normal(2, std=0.2)
            z = (self.around.joints[..., 2].amin(1) - 0.02 - size.amax(1) - rng.uniform(high=0.08) if before
                 else self.far + size.amax(1) + rng.uniform(high=0.4))
            center = torch.stack([self.center[:, 0] + aside[:, 0], self.center[:, 1] + aside[:, 1], z], 1)
            axes = random_rotation(rng)
            chosen = chosen & (center[:, 2] - size.amax(1) > 0.1)
            self._ellipsoid(self.scene.hard, (chosen & (what < 0.3)).nonzero()[:, 0], center, axes, size)
            self._box(self.scene.hard, (chosen & (what >= 0.3) & (what < 0.65)).nonzero()[:, 0], center, axes, size)
            end = axes[..., 0] * (0.3 if before else 0.5)
            end = torch.stack([end[:, 0], end[:, 1], end[:, 2].abs() * 0.5], 1)
            thin = size[:, 1] * (0.5 if before else 0.4)
            self._cone(self.scene.hard, (chosen & (what >= 0.65)).nonzero()[:, 0], center, center + end,
                      thin, thin * 1.2)

    def no_hand(self) -> None:
        """Where there is no hand, mostly an elbow, the stump of a forearm, a head or an object in its place."""
        rng = self._draws()
        absent, what = ~self.scene.present, rng.uniform()
        axes = random_rotation(rng)
        reach = axes[..., 0] * rng.uniform(1, low=0.06, high=0.22)
        thick = rng.uniform(low=0.02, high=0.055)
        self._cone(self.scene.soft, (absent & (what < 0.45)).nonzero()[:, 0], self.center - reach,
                  self.center + reach, thick, thick * rng.uniform(low=0.9, high=1.4))
        self._ellipsoid(self.scene.soft, (absent & (what >= 0.45) & (what < 0.75)).nonzero()[:, 0], self.center,
                  axes, rng.uniform(3, low=0.06, high=0.13))
        self._box(self.scene.hard, (absent & (what >= 0.75) & (what < 0.9)).nonzero()[:, 0], self.center, axes,
                  rng.uniform(3, low=0.02, high=0.12))


def furnish(rng: Random, scene: Scene, view: Tensor, elbow: Tensor, around: Scene | None = None, *,
            arm: bool = True, alone: bool = False) -> None:
    """Fill scenes with what there is besides the hands.

    Args:
        view: (B,) the second result of `sample_views`.
        elbow: (B, 3) in metres.
        around: the scene with the hands as they were when the rest was placed, if they move; `scene` by default.
        arm: whether the hands have arms. If so, they may be clothed.
        alone: leave out what may cover or imitate a hand.
    """
    furnisher = Furnisher(rng, scene, view, elbow, around or scene)
    # Each draws from the next stream of random numbers, so the order matters.
    furnisher.surface()
    furnisher.body(arm)
    if arm:
        furnisher.sleeve()
    if not alone:
        furnisher.held()
        furnisher.clutter()
        furnisher.no_hand()
