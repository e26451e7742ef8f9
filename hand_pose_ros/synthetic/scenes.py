"""What stands before the camera: a right hand, seen from somewhere, and the things around it.

A left hand is the mirror image of a whole scene, so every scene is made with a right hand. Axes are those of the
optical frame: x right, y down, z away from the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from hand_pose_ros.synthetic import renderer
from hand_pose_ros.synthetic.renderer import View, dot
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.sensors import sensor_table

VIEWS = {'frontal': 0.38, 'egocentric': 0.17, 'overhead': 0.13, 'side': 0.12, 'any': 0.20}
"""Shares of the ways in which a camera looks at a hand."""

# For each of VIEWS: where the fingers point, where the palm faces, and the spread about it in radians (out of the image
# plane, within it). Frontal: held up to a camera opposite; egocentric: seen from above one's own head; overhead: on a table.
_BASES = torch.tensor([[[0, -1, 0], [0, 0, -1]], [[0, -0.6, 0.8], [0, 0.8, 0.6]], [[0, -1, 0], [0, 0, 1]],
                       [[0, -1, 0], [1, 0, 0]], [[0, -1, 0], [0, 0, -1]]], dtype=torch.float32)
_SCATTER = torch.tensor([[0.45, 0.7], [0.5, 0.7], [0.4, 3.0], [0.5, 1.0], [3.0, 3.0]])
_TURNED = torch.tensor([0.3, 0.4, 0.25, 0.5, 0.5])  # chance of the other face of the hand
_HALF_HAND = 0.10  # m
_ARM_NEAR = 0.12  # a forearm that comes this close to the camera, in metres, would come out of the camera


@dataclass
class Solid:
    """One kind of solid, in some samples of a batch.

    Attributes:
        draw: of `renderer`; its arguments are the measures and a view.
        samples: (K,) that contain it.
        measures: each (K, ...).
        center, radius: (K, 3), (K,) of a ball around it, or None where there is no end to it.
    """

    draw: Callable[..., Tensor]
    samples: Tensor
    measures: tuple[Tensor, ...]
    center: Tensor | None = None
    radius: Tensor | None = None

    def within(self, view: View, back: Tensor) -> Solid:
        """Those of it that may be seen in the `view` before the distance `back` (B,)."""
        if self.center is None or self.radius is None:
            return self
        view, back = view[self.samples], back[self.samples]
        (u, v), r = view.project(self.center[:, None]), self.radius
        reach = torch.maximum(view.fx, view.fy) * r * 1.5 / (self.center[:, 2] - r).clamp(min=0.05)
        seen = ((self.center[:, 2] - r < back) & (u[:, 0] > -reach) & (u[:, 0] < view.width + reach)
                & (v[:, 0] > -reach) & (v[:, 0] < view.height + reach)).nonzero()[:, 0]
        return Solid(self.draw, self.samples[seen], tuple(m[seen] for m in self.measures))


@dataclass
class Scene:
    """A batch of scenes, in metres and in the optical frame.

    Attributes:
        vertices, joints: (B, V, 3) and (B, 21, 3) of the right hand.
        present: (B,) bool, whether there is a hand at all.
        soft: things with folds and relief (bodies, walls); hard: objects.
        other, other_of, other_is_left: (K, V, 3) second hands, the samples (K,) that have them, and which side they are.
    """

    vertices: Tensor
    joints: Tensor
    present: Tensor
    soft: list[Solid] = field(default_factory=list)
    hard: list[Solid] = field(default_factory=list)
    other: Tensor | None = None
    other_of: Tensor | None = None
    other_is_left: Tensor | None = None


def _normalize(vector: Tensor) -> Tensor:
    return vector / dot(vector, vector).sqrt()[..., None]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack([a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1], a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
                        a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]], -1)


def turn(rotation: Tensor, points: Tensor) -> Tensor:
    """Rotation matrices (B, 3, 3) times points (B, N, 3)."""
    return torch.stack([dot(rotation[:, None, i], points) for i in range(3)], -1)


def random_rotation(rng: Random) -> Tensor:
    """(B, 3, 3) uniform over all rotations (from a normal quaternion)."""
    q = rng.normal(4)
    w, x, y, z = (q / (q * q).sum(1, keepdim=True).sqrt()).unbind(1)
    return torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)


def _spin(vectors: Tensor, axis: int, angle: Tensor) -> Tensor:
    """Turn vectors (B, N, 3) by `angle` (B,) about a coordinate axis."""
    cos, sin = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out = [vectors[..., 0]] * 3
    out[axis] = vectors[..., axis]
    out[a] = cos * vectors[..., a] - sin * vectors[..., b]
    out[b] = sin * vectors[..., a] + cos * vectors[..., b]
    return torch.stack(out, -1)


def sample_views(rng: Random) -> tuple[Tensor, Tensor]:
    """Rotations (B, 3, 3) from the hand frame to the optical frame, and which of VIEWS (B,) each belongs to."""
    kind = rng.choice(torch.tensor(list(VIEWS.values()), device=rng.device))
    base = _BASES.to(rng.device)[kind]
    spread, roll = _SCATTER.to(rng.device)[kind].unbind(1)
    turned = rng.uniform() < _TURNED.to(rng.device)[kind]
    palm = torch.where(turned[:, None], -base[:, 1], base[:, 1])
    directions = torch.stack([base[:, 0], palm], 1)
    directions = _spin(directions, 1, rng.normal() * spread)
    directions = _spin(directions, 0, rng.normal() * spread * 0.8)
    directions = _spin(directions, 2, rng.normal() * roll)
    fingers, palm = directions.unbind(1)
    structured = torch.stack([_cross(fingers, palm), fingers, palm], 2)
    rotation = torch.where((kind == list(VIEWS).index('any'))[:, None, None], random_rotation(rng), structured)
    return rotation, kind


def sample_positions(rng: Random, sensor: Tensor) -> Tensor:
    """(B, 3) where hands are: at the distances of the sensor, mostly near the middle of its image, some near its border."""
    table = lambda name: sensor_table(name, sensor.device)[sensor]  # noqa: E731
    near, far = table('hand_distance').unbind(1)
    z = near + (far - near) * rng.uniform()
    size, focal = torch.stack([table('width'), table('height')], 1), torch.stack([table('fx'), table('fy')], 1)
    whole = (size / 2 - _HALF_HAND * focal / z[:, None]).clamp(min=0)  # as far from the middle a hand is not cut off
    middling = torch.maximum(torch.minimum(rng.normal(2) * 0.16 * size, whole), -whole)
    u, v = torch.where(rng.chance(0.12)[:, None], rng.uniform(2, low=-0.5, high=0.5) * size, middling).unbind(1)
    u, v = u + (table('width') / 2 - table('cx')), v + (table('height') / 2 - table('cy'))
    return torch.stack([u / table('fx') * z, v / table('fy') * z, z], 1)


def place(vertices: Tensor, joints: Tensor, rotation: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Hands from the hand frame into the camera's, the mean of their joints at `position` (B, 3)."""
    middle = joints.mean(1, keepdim=True)
    return (turn(rotation, vertices - middle) + position[:, None], turn(rotation, joints - middle) + position[:, None])


def keep_arm_off_camera(rotation: Tensor, position: Tensor) -> Tensor:
    """Rotations with the hand turned about the camera's x axis where its forearm would run into the camera."""
    elbow_z = position[:, 2] - 0.30 * rotation[:, 2, 1]
    flipped = torch.stack([rotation[:, 0], -rotation[:, 1], -rotation[:, 2]], 1)
    return torch.where((elbow_z < _ARM_NEAR)[:, None, None], flipped, rotation)


class Furnisher:
    """Adds things to a scene, each from random streams of its own."""

    def __init__(self, rng: Random, scene: Scene, view: Tensor, elbow: Tensor) -> None:
        self.rng, self.scene, self.view, self.elbow = rng, scene, view, elbow
        self.center = scene.joints.mean(1)
        self.far = scene.joints[..., 2].amax(1) + 0.012
        self._stream = 0

    def _draws(self) -> Random:
        self._stream += 1
        return self.rng.fork(self._stream)

    def _chance(self, rng: Random, shares: dict[str, float]) -> Tensor:
        """(K,) samples chosen with a probability for each of VIEWS."""
        table = torch.tensor([shares.get(name, shares['any']) for name in VIEWS], device=rng.device)
        return (rng.uniform() < table[self.view]).nonzero()[:, 0]

    @staticmethod
    def _ellipsoid(to: list[Solid], samples: Tensor, center: Tensor, axes: Tensor, radii: Tensor) -> None:
        center, axes, radii = center[samples], axes[samples], radii[samples]
        to.append(Solid(renderer.ellipsoid, samples, (center, axes, radii), center, radii.amax(1)))

    @staticmethod
    def _box(to: list[Solid], samples: Tensor, center: Tensor, axes: Tensor, half: Tensor) -> None:
        center, axes, half = center[samples], axes[samples], half[samples]
        to.append(Solid(renderer.box, samples, (center, axes, half), center, dot(half, half).sqrt()))

    @staticmethod
    def _cone(to: list[Solid], samples: Tensor, start: Tensor, end: Tensor, radius: Tensor, end_radius: Tensor) -> None:
        start, end, radius, end_radius = start[samples], end[samples], radius[samples], end_radius[samples]
        along = end - start
        to.append(Solid(renderer.round_cone, samples, (start, end, radius, end_radius), (start + end) / 2,
                        dot(along, along).sqrt() / 2 + torch.maximum(radius, end_radius)))

    def surface(self) -> None:
        """A table under the hand or a wall behind it: a plane that arm and hand touch or stay clear of."""
        rng = self._draws()
        samples = self._chance(rng, {'overhead': 0.8, 'egocentric': 0.65, 'any': 0.45})
        down = torch.tensor([0.0, 0.75, 0.66], device=rng.device)
        away = torch.tensor([0.0, 0.0, 1.0], device=rng.device)
        table = self.view == list(VIEWS).index('egocentric')
        normal = _normalize(torch.where(table[:, None], down, away) + rng.normal(3, std=0.22))
        normal = torch.where(normal[:, 2:] < 0.2, away, normal)
        touch = dot(normal[:, None], self.scene.vertices).amax(1)
        gap = torch.where(rng.chance(0.25), 0.0, -torch.log(1 - rng.uniform()) * 0.25)
        self.scene.soft.append(Solid(renderer.plane, samples, (normal[samples], (touch + gap)[samples])))

    def body(self) -> None:
        """Torso, head and upper arm of the person whose hand it is, behind the hand."""
        rng = self._draws()
        samples = self._chance(rng, {'overhead': 0.1, 'egocentric': 0.05, 'any': 0.6})
        size = rng.uniform(3, low=0.85, high=1.15)
        torso = size * torch.tensor([0.20, 0.31, 0.12], device=rng.device)
        gap = rng.uniform(low=0.01, high=0.5)
        center = torch.stack([self.center[:, 0] + rng.normal(std=0.16), self.center[:, 1] + rng.uniform(low=-0.1, high=0.45),
                              self.far + gap + torso[:, 2]], 1)
        axes = _spin(torch.eye(3, device=rng.device).expand(len(rng), 3, 3), 2, rng.normal(std=0.15))
        self._ellipsoid(self.scene.soft, samples, center, axes, torso)
        head = size * torch.tensor([0.078, 0.118, 0.098], device=rng.device)
        nod = rng.normal(3, std=0.03)
        above = torch.stack([nod[:, 0], -torso[:, 1] - 0.09 + nod[:, 1], nod[:, 2]], 1)
        self._ellipsoid(self.scene.soft, samples, center + above, axes, head)
        shoulder = center + torch.stack([torso[:, 0] * torch.where(rng.chance(0.5), 0.95, -0.95), -0.75 * torso[:, 1],
                                         torch.zeros_like(gap)], 1)
        thick = 0.042 * size[:, 0]
        self._cone(self.scene.soft, samples, self.elbow, shoulder, thick, thick * 1.35)

    def sleeve(self) -> None:
        """A sleeve from somewhere along the forearm to the elbow, loose or tight."""
        rng = self._draws()
        samples = self._chance(rng, {'any': 0.35})
        wrist = self.scene.joints[:, 0]
        cuff = wrist + (self.elbow - wrist) * rng.uniform(1, low=0.12, high=0.8)
        width = rng.uniform(low=0.034, high=0.052)
        self._cone(self.scene.soft, samples, cuff, self.elbow, width, width * rng.uniform(low=1.0, high=1.4))

    def held(self) -> None:
        """A ball, a bar or a flat box in the hand."""
        rng = self._draws()
        chosen, what = rng.chance(0.14), rng.uniform()
        joints = self.scene.joints
        across, along = _normalize(joints[:, 5] - joints[:, 17]), _normalize(joints[:, 9] - joints[:, 0])
        palmar = _normalize(_cross(across, along))
        radius = rng.uniform(low=0.010, high=0.038)
        palm = joints[:, (0, 5, 9, 13, 17)].mean(1) + palmar * (0.012 + radius[:, None])
        center = palm + 0.5 * (joints[:, (4, 8, 12, 16)].mean(1) - palm)
        axis = _normalize(across + rng.normal(3, std=0.25))
        reach = axis * rng.uniform(1, low=0.04, high=0.13)
        self._ellipsoid(self.scene.hard, (chosen & (what < 0.35)).nonzero()[:, 0], center,
                  random_rotation(rng), radius[:, None] * rng.uniform(3, low=0.8, high=1.3))
        self._cone(self.scene.hard, (chosen & (what >= 0.35) & (what < 0.75)).nonzero()[:, 0],
                  center - reach, center + reach, radius * 0.7, radius * 0.7)
        frame = torch.stack([across, along, palmar], 2)
        half = rng.uniform(3, low=0.7, high=1.3) * torch.tensor([0.036, 0.07, 0.007], device=rng.device)
        self._box(self.scene.hard, (chosen & (what >= 0.75)).nonzero()[:, 0], center, frame, half)

    def clutter(self) -> None:
        """Things behind, beside and before the hand."""
        for chance, before in ((0.25, False), (0.25, False), (0.07, True)):
            rng = self._draws()
            chosen, what = rng.chance(chance), rng.uniform()
            size = rng.uniform(3, low=0.012, high=0.05) if before else rng.uniform(3, low=0.03, high=0.2)
            aside = rng.normal(2, std=0.05) if before else rng.normal(2, std=0.2)
            z = (self.scene.joints[..., 2].amin(1) - 0.02 - size.amax(1) - rng.uniform(high=0.08) if before
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
        """Where there is no hand: an elbow, a forearm's stump, a head or an object in its place."""
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


def furnish(rng: Random, scene: Scene, view: Tensor, elbow: Tensor) -> None:
    """Fill scenes with what else there is; `view` (B,) as of `sample_views`, `elbow` (B, 3) in metres."""
    furnisher = Furnisher(rng, scene, view, elbow)
    for add in (furnisher.surface, furnisher.body, furnisher.sleeve, furnisher.held, furnisher.clutter, furnisher.no_hand):
        add()


def draw_solids(scene: Scene, view: View, back: Tensor | None = None, relief: Tensor | None = None) -> Tensor:
    """Nearness (B, H, W) of everything but hands.

    Args:
        back: (B,) metres; what lies wholly behind it may be left out.
        relief: (B, H, W) metres, laid over what is soft.
    """
    image = torch.zeros(len(scene.present), view.height, view.width, device=scene.joints.device)
    for solids in (scene.soft, scene.hard):
        for solid in solids:
            if back is not None:
                solid = solid.within(view, back)
            if len(solid.samples):
                shown = solid.draw(*solid.measures, view[solid.samples])
                image[solid.samples] = torch.maximum(image[solid.samples], shown)
        if solids is scene.soft and relief is not None:
            image = image / (1 + image * relief)
    return image


def draw_hands(scene: Scene, faces: Tensor, view: View) -> tuple[Tensor, Tensor | None]:
    """Nearness of the hands (B, H, W) and of the second hands (K, H, W)."""
    hands = torch.zeros(len(scene.present), view.height, view.width, device=scene.joints.device)
    there = scene.present.nonzero()[:, 0]
    if len(there):
        hands[there] = renderer.rasterise(scene.vertices[there], faces, view[there])
    if scene.other is None or scene.other_of is None or scene.other_is_left is None:
        return hands, None
    others = torch.zeros(len(scene.other_of), view.height, view.width, device=hands.device)
    for side, winding in ((scene.other_is_left, faces.flip(1)), (~scene.other_is_left, faces)):
        members = side.nonzero()[:, 0]
        if len(members):
            others[members] = renderer.rasterise(scene.other[members], winding, view[scene.other_of[members]])
    return hands, others


def splat(points: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of points (B, N, 3), one pixel each: a coarse image of a dense mesh at a tenth of the cost."""
    u, v = view.project(points)
    column, row = u.round().long(), v.round().long()
    seen = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height) & (points[..., 2] > renderer.NEAR)
    size = view.height * view.width
    target = torch.where(seen, row * view.width + column, size)
    image = points.new_zeros(len(points), size + 1)
    return image.scatter_reduce_(1, target, 1 / points[..., 2], 'amax')[:, :size].reshape(-1, view.height, view.width)


def smooth_relief(rng: Random, view: View, cells: int = 10) -> Tensor:
    """(B, H, W) metres: folds of cloth and unevenness, up to some millimetres."""
    grid = rng.normal(1, cells, cells) * (rng.uniform(1, 1, 1) * 0.004)
    return functional.interpolate(grid, (view.height, view.width), mode='bilinear')[:, 0]


