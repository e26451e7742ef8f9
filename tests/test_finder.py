"""The network that finds hands, and the way from a camera's image to its own and back."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_pose_ros.errors import CheckpointError, HandPoseError, InputError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.models.checkpoints import WEIGHTS
from hand_pose_ros.models.finder import CELL, FOCAL, MULTIPLE, cell_rays
from hand_pose_ros.runtime.finder import SHIPPED, Finder
from hand_pose_ros.synthetic.generator import SyntheticHands

CAMERA = Intrinsics(570.0, 570.0, 320.0, 240.0, 640, 480)


@pytest.fixture(scope='module')
def find() -> Finder:
    return Finder.from_pretrained()


class Nearest(torch.nn.Module):
    """Takes whatever is seen for a hand, the nearer the surer, and says of it what its cell knows."""

    def forward(self, depth):
        z = torch.nn.functional.max_pool2d(depth, CELL)
        return 5 * (z[:, 0] > 0) - z[:, 0], torch.cat([cell_rays(z).expand(len(z), -1, -1, -1), z - 1], dim=1)


@pytest.fixture(scope='module')
def nearest() -> Finder:
    return Finder(Nearest())


@settings(max_examples=60, deadline=None)
@given(focal=st.floats(280, 900), stretch=st.floats(0.9, 1.1), width=st.integers(60, 900), height=st.integers(60, 900),
       at=st.tuples(st.floats(0.1, 0.9), st.floats(0.1, 0.9)),
       off=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), z=st.floats(0.2, 1.4))
def test_what_is_found_lies_where_the_camera_sees_it(nearest, focal, stretch, width, height, at, off, z) -> None:
    camera = Intrinsics(focal, focal * stretch, width * (0.5 + off[0]), height * (0.5 + off[1]), width, height)
    u, v = int(at[0] * width), int(at[1] * height)
    reach = int(np.ceil(2 * focal / FOCAL))  # more than a pixel of the network's image
    depth = np.zeros((height, width), np.float32)
    depth[max(0, v - reach):v + reach + 1, max(0, u - reach):u + reach + 1] = z
    cube = nearest(depth, camera)[0]
    assert cube.center[2] == pytest.approx(z, abs=1e-5)
    # within a cell, and the pixels that the blob has beside it
    assert camera.project(np.array(cube.center)) == pytest.approx((u, v), abs=(CELL + 3) * focal * 1.1 / FOCAL + 2)


def test_hands_before_walls_on_tables_and_beside_people_are_found(find) -> None:
    hands, found, images = SyntheticHands('test'), 0, 0
    for index in range(7000, 7040):
        depth, camera, joints, side = hands.full_frame(index)
        if side == 'none':
            continue
        pixels = camera.project(joints)
        if not ((pixels >= 0) & (pixels < (camera.width, camera.height))).all():
            continue
        images += 1
        middle = joints.mean(0)
        found += any(np.linalg.norm(np.subtract(cube.center, middle)) < 0.08 for cube in find(depth, camera)[:2])
    assert images > 25
    assert found / images > 0.8


def test_nothing_is_found_where_nothing_is(find) -> None:
    assert find(np.zeros((480, 640), np.float32), CAMERA) == []
    wall = np.full((480, 640), 0.9, np.float32)
    assert find(wall, CAMERA) == []


def test_range_and_regions_limit_where_hands_are_looked_for(nearest) -> None:
    depth = np.zeros((480, 640), np.float32)
    depth[100:140, 100:140], depth[300:340, 500:540] = 0.5, 0.8
    assert round(nearest(depth, CAMERA)[0].center[2], 3) == 0.5
    assert {round(cube.center[2], 3) for cube in nearest(depth, CAMERA, near=0.6)} == {0.8}
    assert {round(cube.center[2], 3) for cube in nearest(depth, CAMERA, far=0.6)} == {0.5}
    for region, z in (((480, 0, 160, 480), 0.8), ((0, 280, 640, 200), 0.8), ((0, 0, 400, 480), 0.5),
                      ((0, 0, 640, 200), 0.5), ((100, 100, 40, 40), 0.5)):
        assert {round(cube.center[2], 3) for cube in nearest(depth, CAMERA, regions=[region])} == {z}
    assert nearest(depth, CAMERA, regions=[]) == []
    depth[112:128, 112:128] = 0.7  # between what is too near
    assert {round(cube.center[2], 3) for cube in nearest(depth, CAMERA, near=0.6)} == {0.7, 0.8}


def test_the_six_likeliest_places_are_told_each_where_it_is_the_likeliest(nearest) -> None:
    depth = np.zeros((480, 640), np.float32)
    for k in range(8):
        rows, columns = np.mgrid[:80, :80]
        depth[160 * (k // 4):, 160 * (k % 4):][:80, :80] = 0.5 + 0.1 * k + 0.0002 * (rows + columns)
    cubes = nearest(depth, CAMERA, side=0.25)
    assert [round(cube.center[2], 1) for cube in cubes] == [0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    assert {cube.side for cube in cubes} == {0.25}
    assert nearest(np.full((480, 640), 7.1, np.float32), CAMERA, far=9.0)
    assert nearest(np.full((480, 640), 7.3, np.float32), CAMERA, far=9.0) == []  # which scores 0.09


def test_the_middle_of_a_cell_is_where_the_camera_sees_it(nearest) -> None:
    camera = Intrinsics(2 * FOCAL, 4 * FOCAL, 90.0, 130.0, 192, 256)  # pixels a half and a quarter as large
    depth = np.zeros((256, 192), np.float32)
    depth[66:80:4, 41:48:2] = 0.5  # those that are seen
    [cube] = nearest(depth, camera)
    assert camera.project(np.array(cube.center)) == pytest.approx((43.5, 71.5), abs=1e-3)


def test_weights_of_another_network_are_refused() -> None:
    with pytest.raises(CheckpointError, match='not a hand_finder'):
        Finder.from_pretrained(WEIGHTS / 'deep_prior.safetensors')
    with pytest.raises(HandPoseError, match='give no joints'):
        HandPoseEstimator.from_pretrained(SHIPPED, device='cpu')


def test_a_camera_that_cannot_be_is_refused_with_the_reason(find) -> None:
    with pytest.raises(InputError, match='no camera of 640x480'):
        find(np.zeros((480, 640), np.float32), Intrinsics(50.0, 50.0, 320.0, 240.0, 640, 480))


def test_any_size_of_image_fits(find) -> None:
    for width, height in ((1, 1), (7, 900), (1280, 720), (MULTIPLE, MULTIPLE)):
        assert isinstance(find(np.full((height, width), 0.5, np.float32),
                               Intrinsics(300.0, 300.0, width / 2, height / 2, width, height)), list)
