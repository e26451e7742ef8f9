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

from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic import renderer
from hand_pose_ros.synthetic.renderer import View, dot
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.sensors import sensor_table

VIEWS = {'frontal': 0.44, 'egocentric': 0.16, 'overhead': 0.12, 'side': 0.12, 'any': 0.16}
"""Shares of the ways in which a camera looks at a hand."""

# For each of VIEWS, _BASES tells where the fingers point and where the palm faces. _SCATTER is the spread about that in
# radians, out of the image plane and within it. A frontal hand is held up to a camera opposite. An egocentric one is
# seen from one's own head, and an overhead one from above a table.
_BASES = torch.tensor([[[0, -1, 0], [0, 0, -1]], [[0, -0.8, 0.6], [0, 0.6, 0.8]], [[0, -1, 0], [0, 0, 1]],
                       [[0, -1, 0], [1, 0, 0]], [[0, -1, 0], [0, 0, -1]]], dtype=torch.float32)
_SCATTER = torch.tensor([[0.45, 0.7], [0.5, 0.7], [0.4, 3.0], [0.5, 1.0], [3.0, 3.0]])
_LEAN = torch.tensor([0.35, 0.0, 0.0, 0.25, 0.0])  # radians, as a hand held out to the camera is nearer than its elbow
_TURNED = torch.tensor([0.3, 0.4, 0.25, 0.5, 0.5])  # chance to see the other face of the hand
_HALF_HAND = 0.10  # m
_ARM_NEAR = 0.12  # a forearm that comes this close to the camera, in metres, would come out of it
_ARM_HIDES = 0.8  # cosine between fingers and line of sight; beyond it, one sees mostly an elbow


@dataclass
class Solid:
    """One kind of solid, in some samples of a batch.

    Attributes:
        draw: function of `renderer`. Its arguments are the measures and a view.
        samples: (K,) indices of the samples that contain it.
        measures: arguments of `draw`, each (K, ...).
        balls, radii: centres (K, N, 3) and radii (K, N) of N balls whose hull contains it. None if it has no end.
    """

    draw: Callable[..., Tensor]
    samples: Tensor
    measures: tuple[Tensor, ...]
    balls: Tensor | None = None
    radii: Tensor | None = None

    def within(self, view: View, back: Tensor) -> Solid:
        """The same solid, in only those samples where it may be seen in the `view`, nearer than `back` (B,) metres."""
        if self.balls is None or self.radii is None:
            return self
        view, back = view[self.samples], back[self.samples]
        u, v = view.project(self.balls)
        nearest = self.balls[..., 2] - self.radii
        reach = torch.maximum(view.fx, view.fy)[:, None] * self.radii * 1.5 / nearest.clamp(min=0.05)
        beside = torch.stack([u < -reach, u > view.width + reach, v < -reach, v > view.height + reach,
                              nearest > back[:, None]])
        # It cannot be seen if all its balls are beyond the same side of the window, or beyond `back`. Balls near the
        # plane of the camera project anywhere, so they count as seen.
        seen = (~beside.all(2).any(0) | (nearest < 0.05).any(1)).nonzero()[:, 0]
        return Solid(self.draw, self.samples[seen], tuple(m[seen] for m in self.measures))


@dataclass
class Others:
    """Second hands, with their skin (K, V, 3), the samples (K,) they are in, and which of them are left hands (K,)."""

    vertices: Tensor
    samples: Tensor
    left: Tensor


@dataclass
class Scene:
    """A batch of scenes, in metres and in the optical frame.

    Attributes:
        vertices, joints: (B, V, 3) and (B, 21, 3) of the right hand.
        present: (B,) bool, whether there is a hand at all.
        soft: things with folds and relief (bodies, walls).
        hard: objects.
        others: second hands, if there are any.
    """

    vertices: Tensor
    joints: Tensor
    present: Tensor
    soft: list[Solid] = field(default_factory=list)
    hard: list[Solid] = field(default_factory=list)
    others: Others | None = None


def normalize(vector: Tensor) -> Tensor:
    """Vectors (..., 3) of length 1."""
    return vector / dot(vector, vector).sqrt()[..., None]


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Vector product over the last axis."""
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


def spin_about(vectors: Tensor, axis: int, angle: Tensor) -> Tensor:
    """Turn vectors (B, N, 3) by `angle` (B,) about a coordinate axis."""
    cos, sin = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out = [vectors[..., 0]] * 3
    out[axis] = vectors[..., axis]
    out[a] = cos * vectors[..., a] - sin * vectors[..., b]
    out[b] = sin * vectors[..., a] + cos * vectors[..., b]
    return torch.stack(out, -1)


def spin(vectors: Tensor, angles: Tensor) -> Tensor:
    """Turn vectors (B, N, 3) by three `angles` (B, 3) about the axes, first x."""
    for axis in range(3):
        vectors = spin_about(vectors, axis, angles[:, axis])
    return vectors


def sample_views(rng: Random, only: str | None = None) -> tuple[Tensor, Tensor]:
    """Rotations (B, 3, 3) from the hand frame to the optical frame, and which of VIEWS (B,) each belongs to."""
    weights = [share if only in (None, name) else 0.0 for name, share in VIEWS.items()]
    kind = rng.choice(torch.tensor(weights, device=rng.device))
    base = _BASES.to(rng.device)[kind]
    spread, roll = _SCATTER.to(rng.device)[kind].unbind(1)
    turned = rng.uniform() < _TURNED.to(rng.device)[kind]
    palm = torch.where(turned[:, None], -base[:, 1], base[:, 1])
    directions = torch.stack([base[:, 0], palm], 1)
    directions = spin_about(directions, 1, rng.normal() * spread)
    directions = spin_about(directions, 0, rng.normal() * spread * 0.8 + _LEAN.to(rng.device)[kind])
    directions = spin_about(directions, 2, rng.normal() * roll)
    fingers, palm = directions.unbind(1)
    structured = torch.stack([cross(fingers, palm), fingers, palm], 2)
    rotation = torch.where((kind == list(VIEWS).index('any'))[:, None, None], random_rotation(rng), structured)
    return rotation, kind


def sample_positions(rng: Random, sensor: Tensor) -> Tensor:
    """Positions (B, 3) of hands in metres, at the distances of their sensors.

    Most are well inside the image, and some across its border.
    """
    table = lambda name: sensor_table(name, sensor.device)[sensor]  # noqa: E731
    near, far = table('hand_distance').unbind(1)
    z = near + (far - near) * rng.uniform()
    size, focal = torch.stack([table('width'), table('height')], 1), torch.stack([table('fx'), table('fy')], 1)
    whole = (size / 2 - _HALF_HAND * focal / z[:, None]).clamp(min=0)  # a hand this far from the middle is not cut off
    middling = torch.maximum(torch.minimum(rng.normal(2) * 0.16 * size, whole), -whole)
    u, v = torch.where(rng.chance(0.12)[:, None], rng.uniform(2, low=-0.5, high=0.5) * size, middling).unbind(1)
    u, v = u + (table('width') / 2 - table('cx')), v + (table('height') / 2 - table('cy'))
    return torch.stack([u / table('fx') * z, v / table('fy') * z, z], 1)


def place(vertices: Tensor, joints: Tensor, rotation: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Hands moved from the hand frame to the optical frame, with the mean of their joints at `position` (B, 3)."""
    middle = joints.mean(1, keepdim=True)
    return (turn(rotation, vertices - middle) + position[:, None], turn(rotation, joints - middle) + position[:, None])


def keep_arm_off_camera(rotation: Tensor, position: Tensor) -> Tensor:
    """Rotations (B, 3, 3) that keep forearms from hiding their hands and from running into the camera.

    Where a forearm would, the hand is turned by half a turn about the x axis of the camera.
    """
    away = rotation[:, 2, 1]  # how much the fingers point away from the camera
    flipped = torch.stack([rotation[:, 0], -rotation[:, 1], -rotation[:, 2]], 1)
    bad = (away > _ARM_HIDES) | (position[:, 2] - 0.30 * away < _ARM_NEAR)
    return torch.where(bad[:, None, None], flipped, rotation)


def draw_solids(scene: Scene, view: View, back: Tensor | None = None, relief: Tensor | None = None) -> Tensor:
    """Nearness (B, H, W) of everything but hands.

    Args:
        back: (B,) metres. What lies wholly behind it may be left out.
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


def draw_hands(scene: Scene, faces: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Nearness (B, H, W) of the hands, and of the second hands."""
    hands = torch.zeros(len(scene.present), view.height, view.width, device=scene.joints.device)
    there = scene.present.nonzero()[:, 0]
    hands[there] = renderer.rasterise(scene.vertices[there], faces, view[there])
    others = torch.zeros_like(hands)
    if scene.others is not None:
        for of_side, winding in ((scene.others.left, faces.flip(1)), (~scene.others.left, faces)):
            members = of_side.nonzero()[:, 0]
            samples = scene.others.samples[members]
            others[samples] = renderer.rasterise(scene.others.vertices[members], winding, view[samples])
    return hands, others


def draw_sticks(scene: Scene, elbow: Tensor | None, view: View) -> Tensor:
    """Nearness (B, H, W) of hands made of sticks, which remain of a hand without its surface."""
    image = torch.zeros(len(scene.present), view.height, view.width, device=scene.joints.device)
    there = scene.present.nonzero()[:, 0]
    joints, view = scene.joints[there], view[there]
    shown = image[there]
    for parent, child in HAND21.bones:
        radius = torch.full((len(there),), 0.012 if parent == 0 else 0.008, device=image.device)
        shown = torch.maximum(shown, renderer.round_cone(joints[:, parent], joints[:, child], radius, radius, view))
    if elbow is not None:
        radius = torch.full((len(there),), 0.025, device=image.device)
        shown = torch.maximum(shown, renderer.round_cone(joints[:, 0], elbow[there], radius, radius * 1.5, view))
    image[there] = shown
    return image


def splat(points: Tensor, view: View) -> Tensor:
    """Nearness (B, H, W) of points (B, N, 3), one pixel each.

    For a dense mesh, this is a coarse image at a tenth of the cost.
    """
    u, v = view.project(points)
    column, row = u.round().long(), v.round().long()
    seen = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height) & (points[..., 2] > renderer.NEAR)
    size = view.height * view.width
    target = torch.where(seen, row * view.width + column, size)
    image = points.new_zeros(len(points), size + 1)
    return image.scatter_reduce_(1, target, 1 / points[..., 2], 'amax')[:, :size].reshape(-1, view.height, view.width)


def smooth_relief(rng: Random, view: View, cells: int = 10) -> Tensor:
    """Folds of cloth and unevenness (B, H, W) in metres, up to some millimetres."""
    grid = rng.normal(1, cells, cells) * (rng.uniform(1, 1, 1) * 0.004)
    return functional.interpolate(grid, (view.height, view.width), mode='bilinear')[:, 0]
