"""The renderer against closed forms, brute force and its own labels."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.synthetic import renderer
from hand_pose_ros.synthetic.renderer import View, depth_of, rasterise

SIZE = 96


pytestmark = pytest.mark.usefixtures('one_thread')


def view(batch: int = 1, focal: float = 200.0, height: int = SIZE, width: int = SIZE + 8) -> View:
    one = torch.ones(batch)
    return View(focal * one, 1.1 * focal * one, 50.3 * one, 47.6 * one, height, width)


def camera(v: View) -> Intrinsics:
    return Intrinsics(*(float(t[0]) for t in (v.fx, v.fy, v.cx, v.cy)), v.width, v.height)


def points(depth: Tensor, v: View) -> Tensor:
    """(1, H, W, 3) in metres, as the product sees a depth image."""
    pixels = np.stack(np.meshgrid(np.arange(v.width), np.arange(v.height)), -1)
    return torch.from_numpy(camera(v).back_project(pixels, depth[0].numpy()))[None]


def icosphere(times: int) -> tuple[Tensor, Tensor]:
    t = (1 + math.sqrt(5)) / 2
    corners = torch.tensor([(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t), (0, -1, -t),
                            (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)])
    faces = torch.tensor([(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
                          (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9),
                          (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)])
    for _ in range(times):
        a, b, c = (corners[faces[:, i]] for i in range(3))
        ab, bc, ca = (len(corners) + torch.arange(3 * len(faces))).reshape(3, -1)
        corners = torch.cat([corners, (a + b) / 2, (b + c) / 2, (c + a) / 2])
        faces = torch.cat([torch.stack(f, 1) for f in ((faces[:, 0], ab, ca), (faces[:, 1], bc, ab),
                                                       (faces[:, 2], ca, bc), (ab, bc, ca))])
    return corners / corners.norm(dim=1, keepdim=True), faces


def test_triangle_has_the_depth_of_its_plane_inside_and_nothing_outside():
    corners = torch.tensor([[[-0.08, -0.06, 0.5], [0.02, 0.09, 0.8], [0.1, -0.07, 0.6]]])
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces = torch.tensor([[0, 1, 2]]) if (normal * corners[:, 0]).sum() < 0 else torch.tensor([[0, 2, 1]])
    v = view()
    image = rasterise(corners, faces, v)
    # Brute force: the ray meets the triangle's plane at weights w of its corners, all positive inside.
    x, y = v.rays
    rays = torch.stack(torch.broadcast_tensors(x, y, torch.ones(1, 1, 1)), -1).double()
    weights = rays @ torch.linalg.inv(corners[0].double())
    depth = 1 / weights.sum(-1)
    inside = weights.amin(-1) > 1e-3
    assert inside.sum() > 500
    torch.testing.assert_close(depth_of(image)[inside].double(), depth[inside], rtol=1e-4, atol=0)
    assert not image[weights.amin(-1) < -1e-3].any()
    assert not rasterise(corners, faces.flip(1), v).any(), 'a triangle seen from behind is not drawn'


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10 ** 6))
def test_overlapping_triangles_equal_brute_force(seed):
    generator = torch.Generator().manual_seed(seed)
    middle = torch.tensor([0.0, 0.0, 0.5]) + torch.randn(6, 1, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.05])
    size = 10 ** (-1.2 - 1.5 * torch.rand(6, 1, 1, generator=generator))
    triangles = middle + torch.randn(6, 3, 3, generator=generator) * size
    v = view(focal=150.0)
    image = rasterise(triangles.reshape(1, 18, 3), torch.arange(18).reshape(6, 3), v)
    x, y = v.rays
    rays = torch.stack(torch.broadcast_tensors(x, y, torch.ones(1, 1, 1)), -1)[0].double()
    expected = torch.zeros(v.height, v.width, dtype=torch.float64)
    doubtful = torch.zeros_like(expected, dtype=torch.bool)
    for corners in triangles.double():
        normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
        if normal @ corners[0] >= 0 or corners[:, 2].min() < renderer.NEAR:
            continue
        weights = rays @ torch.linalg.inv(corners)
        share = weights * corners[:, 2] / (weights * corners[:, 2]).sum(-1, keepdim=True)
        edge = share.amin(-1)
        doubtful |= edge.abs() < 2e-3
        expected = torch.where(edge > 0, torch.maximum(expected, weights.sum(-1)), expected)
    sure = ~doubtful
    torch.testing.assert_close(image[0][sure].double(), expected[sure], rtol=2e-3, atol=0)


def test_points_are_seen_where_the_product_projects_them():
    v, several = view(), torch.tensor([[[0.1, -0.2, 0.7], [-0.03, 0.05, 0.4]]])
    np.testing.assert_allclose(torch.stack(v.project(several), -1).numpy(), camera(v).project(several), rtol=1e-5)


def test_solids_look_like_their_meshes():
    """Seen askew, with measures that differ: the same outline, and the same side of it."""
    axes = torch.linalg.qr(torch.tensor([[[1.0, 0.3, -0.2], [0.1, 0.9, 0.4], [-0.5, 0.2, 1.0]]]))[0]
    axes[:, :, 0] *= axes.det()
    center, size, v = torch.tensor([[0.01, 0.02, 0.5]]), torch.tensor([[0.05, 0.03, 0.08]]), view()
    cube = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    sides = torch.tensor([q for a, b, c, d in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4),
                                               (1, 5, 7, 3)) for q in ((a, b, c), (a, c, d))])
    for draw, (corners, faces), tolerance in ((renderer.ellipsoid, icosphere(4), 6e-4),
                                              (renderer.box, (cube, sides), 1e-5)):
        solid = draw(center, axes, size, v)
        mesh = rasterise((corners * size) @ axes[0].T + center[:, None], faces, v)
        assert ((mesh > 0) != (solid > 0)).sum() <= 15
        both = (mesh > 0) & (solid > 0)
        assert both.sum() > 600
        assert (depth_of(mesh) - depth_of(solid))[both].abs().quantile(0.98) < tolerance


@pytest.mark.parametrize('center', [(-0.1, 0.1, 0.5), (0.14, -0.11, 0.5)])
def test_mesh_that_leaves_the_image_is_cut_and_not_wrapped_around(center):
    corners, faces = icosphere(3)
    v = view()
    small = rasterise(corners[None] * 0.1 + torch.tensor(center), faces, v)
    wide = View(v.fx, v.fy, v.cx + 60, v.cy + 60, v.height + 120, v.width + 120)
    large = rasterise(corners[None] * 0.1 + torch.tensor(center), faces, wide)
    torch.testing.assert_close(small, large[:, 60:-60, 60:-60], rtol=1e-5, atol=0)
    assert large[:, 60:-60, 60:-60].any() and (large > 0).sum() > (small > 0).sum()


def test_mesh_that_reaches_the_camera_is_drawn_as_far_as_a_sensor_sees():
    """An arm from behind the camera: what is left out is what comes too near, and nothing is turned inside out."""
    for fineness in (1, 3):
        corners, faces = icosphere(fineness)
        arm, v = corners[None] * torch.tensor([0.04, 0.04, 0.4]) + torch.tensor([0.05, 0.04, 0.25]), view()
        far = (arm[0, :, 2][faces] > renderer.NEAR).all(1)
        assert 0.3 < far.float().mean() < 0.8
        image = rasterise(arm, faces, v)
        assert torch.equal(image, rasterise(arm, faces[far], v))
        assert image.any() and depth_of(image)[image > 0].min() > renderer.NEAR
    floor = torch.tensor([[[-0.1, 0.05, 0.4], [0.1, 0.05, 0.4], [0.0, 0.05, -0.2]]])
    for faces in torch.tensor([[0, 1, 2]]), torch.tensor([[0, 2, 1]]):
        assert not rasterise(floor, faces, v).any(), 'nor with a corner behind the camera'


def test_plane_is_exact():
    normal, v = torch.tensor([[0.2, -0.3, 0.933]]), view()
    depth = depth_of(renderer.plane(normal, torch.tensor([0.7]), v))
    torch.testing.assert_close(points(depth, v) @ normal[0].double(), torch.full((1, SIZE, SIZE + 8), 0.7).double(),
                               rtol=1e-5, atol=0)


@pytest.mark.parametrize('radii', [(0.05, 0.02), (0.02, 0.05), (0.03, 0.03)])
def test_round_cone_is_the_union_of_its_balls(radii):
    start, end, v = torch.tensor([[-0.05, 0.02, 0.5]]), torch.tensor([[0.08, -0.03, 0.6]]), view()
    a, b = (torch.tensor([r]) for r in radii)
    cone = renderer.round_cone(start, end, a, b, v)
    balls = torch.zeros_like(cone)
    for part in torch.linspace(0, 1, 150):
        radius = (a + part * (b - a))[:, None].expand(1, 3)
        ball = renderer.ellipsoid(start + part * (end - start), torch.eye(3)[None], radius, v)
        balls = torch.maximum(balls, ball)
    assert ((cone > 0) != (balls > 0)).sum() <= 4
    both = (cone > 0) & (balls > 0)
    torch.testing.assert_close(depth_of(cone)[both], depth_of(balls)[both], rtol=1e-3, atol=0)


def test_nothing_behind_the_camera_is_drawn():
    v, back = view(), torch.tensor([[0.0, 0.0, -0.5]])
    assert not renderer.ellipsoid(back, torch.eye(3)[None], torch.full((1, 3), 0.1), v).any()
    assert not renderer.round_cone(back, back - 0.1, torch.tensor([0.05]), torch.tensor([0.05]), v).any()
    assert not renderer.box(back, torch.eye(3)[None], torch.full((1, 3), 0.1), v).any()
    assert not renderer.plane(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([-0.5]), v).any()
    corners, faces = icosphere(2)
    assert not rasterise(corners[None] * 0.1 + back, faces, v).any()
    # Nor is the inside of what the camera is in.
    around, size = torch.tensor([[0.01, 0.0, 0.02]]), torch.full((1, 3), 0.1)
    assert not renderer.ellipsoid(around, torch.eye(3)[None], size, v).any()
    assert not renderer.round_cone(around, around - 0.1, size[:, 0], size[:, 0], v).any()
    assert not renderer.box(around, torch.eye(3)[None], size, v).any()


def test_a_sample_does_not_depend_on_its_batch():
    corners, faces = icosphere(3)
    many = torch.stack([corners * (0.03 + 0.01 * i) + torch.tensor([0.01 * i, 0, 0.4 + 0.05 * i]) for i in range(5)])
    at, each = view(5), torch.arange(5.0)
    v = View(at.fx + 9 * each, at.fy - 7 * each, at.cx + each, at.cy - 2 * each, at.height, at.width)
    together = rasterise(many, faces, v)
    for i in range(5):
        alone = View(v.fx[i:i + 1], v.fy[i:i + 1], v.cx[i:i + 1], v.cy[i:i + 1], v.height, v.width)
        assert torch.equal(rasterise(many[i:i + 1], faces, alone)[0], together[i])
        assert torch.equal(rasterise(many[i:i + 1], faces, v[torch.tensor([i])])[0], together[i])
