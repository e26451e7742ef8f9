"""The camera, the cube and the crop: exact inverses, and values that mean what they say."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import Cube, Intrinsics, crop

VGA = Intrinsics(588.03, 587.07, 320.0, 240.0, 640, 480)


def camera_info(**changes):
    info = SimpleNamespace(width=640, height=480, k=[500.0, 0, 320, 0, 510, 240, 0, 0, 1], p=[0.0] * 12,
                           binning_x=0, binning_y=0,
                           roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0))
    for name, value in changes.items():
        setattr(info, name, value)
    return info


cubes = st.builds(lambda x, y, z, side: Cube((x * z, y * z, z), side),
                  st.floats(-0.5, 0.5), st.floats(-0.4, 0.4), st.floats(0.25, 1.5), st.floats(0.15, 0.4))
offsets = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


@given(cubes, offsets)
def test_a_joint_survives_crop_and_uncrop(cube, offset):
    joint = np.add(cube.center, np.multiply(offset, cube.side))
    back = cube.from_cube(cube.to_cube(joint))
    assert np.abs(back - joint).max() < 1e-5  # 0.01 mm


@given(cubes, offsets)
def test_cube_units_are_pixels_of_the_patch(cube, offset):
    joint = np.add(cube.center, np.multiply(offset, cube.side))
    column, row, depth = cube.to_cube(joint)
    pixel, middle = VGA.project(joint), VGA.project(cube.center)
    half = cube.side / 2 / cube.center[2]
    assert pixel - middle == pytest.approx([column * half * VGA.fx, row * half * VGA.fy], abs=1e-6)
    assert depth == pytest.approx((joint[2] - cube.center[2]) / (cube.side / 2))


@given(st.lists(st.floats(-1, 1), min_size=2, max_size=2), st.floats(0.1, 5))
def test_projection_and_back_projection_are_inverse(xy, z):
    point = np.array([*xy, z])
    assert VGA.back_project(VGA.project(point), z) == pytest.approx(point, abs=1e-9)


def test_a_point_right_of_and_below_the_axis_projects_right_and_down():
    u, v = VGA.project([0.1, 0.2, 1.0])
    assert u == pytest.approx(320 + 58.803) and v == pytest.approx(240 + 117.414)


@given(cubes, st.integers(0, 2 ** 32 - 1))
def test_a_patch_is_within_minus_one_and_one_whatever_the_depth(cube, seed):
    depth = np.random.default_rng(seed).choice(np.array([0, 0.2, 0.6, 1.0, 9.0], np.float32), (480, 640))
    patch = crop(depth, cube, VGA)
    assert patch.shape == (1, 128, 128) and patch.dtype == np.float32
    assert patch.min() >= -1 and patch.max() <= 1


@pytest.mark.parametrize(('reading', 'value'), [
    (0.0, 1.0), (np.nan, 1.0), (-0.5, 1.0),     # no reading
    (0.8, 1.0), (3e38, 1.0),    # behind the back face
    (0.65, 1.0),    # on the back face
    (0.575, 0.5), (0.5, 0.0), (0.425, -0.5),
    (0.2, -1.0),    # before the front face
])
def test_what_a_patch_shows_of_a_plane(reading, value):
    depth = np.full((480, 640), reading, np.float32)
    with np.errstate(over='raise'):
        patch = crop(depth, Cube((0, 0, 0.5), 0.3), VGA)
    assert np.allclose(patch, value, atol=1e-6)
    assert 0 < reading < 0.66 or (patch == 1).all()  # exactly: what is less is seen


@pytest.mark.parametrize('kind', ['f8', '>f4'])
def test_a_patch_is_the_same_of_any_type_of_depth(kind):
    depth = np.linspace(0.6, 0.9, 480 * 640, dtype=np.float32).reshape(480, 640)
    cube = Cube((0.0, 0.0, 0.75), 0.3)
    assert np.array_equal(crop(depth.astype(kind), cube, VGA), crop(depth, cube, VGA))


def test_outside_the_image_is_background():
    depth = np.ones((480, 640), np.float32)
    patch = crop(depth, Cube(((0 - 320) / 588.03, 0, 1.0), 0.3), VGA)[0]
    assert (patch[:, :63] == 1).all() and (patch[:, 65:] == 0).all()


@pytest.mark.parametrize('axis', [0, 1], ids=['rows', 'columns'])
def test_a_pixel_of_a_patch_is_the_reading_nearest_to_its_middle(axis):
    camera, cube = Intrinsics(600.0, 400.0, 310.0, 250.0, 640, 480), Cube((0.02, -0.03, 0.5), 0.25)
    depth = (0.46 + 1e-4 * np.indices((480, 640))[axis]).astype(np.float32)  # tells where it was read
    read = (0.5 + 0.125 * crop(depth, cube, camera)[0].astype(np.float64) - 0.46) / 1e-4
    row, column = (np.indices((128, 128)) + 0.5) / 64 - 1
    at = camera.project(cube.from_cube(np.stack([column, row, np.zeros_like(row)], axis=-1)))[..., 1 - axis]
    assert np.abs(read - read.round()).max() < 0.05 and np.abs(read - at).max() < 0.6


def test_a_patch_shows_a_joint_where_cube_units_say():
    cube = Cube((0.05, -0.03, 0.6), 0.3)
    depth = np.zeros((480, 640), np.float32)
    joint = np.array([0.1, 0.02, 0.62])
    u, v = VGA.project(joint).round().astype(int)
    depth[v - 1:v + 2, u - 1:u + 2] = joint[2]
    rows, columns = np.nonzero(crop(depth, cube, VGA)[0] < 1)
    assert len(rows)
    column, row, _ = (cube.to_cube(joint) + 1) * 64 - 0.5
    assert columns.mean() == pytest.approx(column, abs=1) and rows.mean() == pytest.approx(row, abs=1)


def test_rectified_images_take_p_and_raw_ones_k():
    p = [400.0, 0, 310, 0, 0, 410, 230, 0, 0, 0, 1, 0]
    assert Intrinsics.from_camera_info(camera_info(p=p)) == Intrinsics(400, 410, 310, 230, 640, 480)
    assert Intrinsics.from_camera_info(camera_info(p=p), rectified=False) == Intrinsics(500, 510, 320, 240, 640, 480)
    assert Intrinsics.from_camera_info(camera_info()) == Intrinsics(500, 510, 320, 240, 640, 480)  # P not filled in


def test_intrinsics_follow_binning_and_region_of_interest():
    roi = SimpleNamespace(x_offset=100, y_offset=40, width=400, height=200)
    assert (Intrinsics.from_camera_info(camera_info(roi=roi, binning_x=2, binning_y=4))
            == Intrinsics(250, 127.5, 110, 50, 200, 50))


@pytest.mark.parametrize('changes', [
    {'k': [0.0] * 9}, {'width': 0}, {'height': 0}, {'k': [float('nan')] * 9}, {'k': [-1.0] * 9},
    {'k': [500.0, 0, 320, 0, -510, 240, 0, 0, 1]}])
def test_unusable_camera_info_is_refused(changes):
    with pytest.raises(InputError, match='camera'):
        Intrinsics.from_camera_info(camera_info(**changes))


def test_intrinsics_of_another_image_are_refused():
    with pytest.raises(InputError, match=r'320x240.*640x480'):
        VGA.check_size(320, 240)
    with pytest.raises(InputError, match=r'640x240.*640x480'):
        VGA.check_size(640, 240)


@pytest.mark.parametrize(('fx', 'fy', 'cx', 'cy', 'wrong'), [
    (200, 200, 320, 240, None), (1000, 400, 320, 240, None),
    (500, 500, 1600, 240, 'of 500 .* at 1600'), (500, 500, -900, 240, 'of 500 .* at -900'),
    (900, 310, 320, 1000, 'of 310 .* at 1000'), (9e6, 9e6, 320, 240, 'of 9e.06 .* at 320'),
    (1300, 400, 320, 240, 'lengths of 1300 and 400'), (400, 1300, 320, 240, 'lengths of 400 and 1300')])
def test_only_what_a_lens_can_see_is_computed_with(fx, fy, cx, cy, wrong):
    camera = Intrinsics(fx, fy, cx, cy, 640, 480)
    if wrong is None:
        camera.check_lens()
    else:
        with pytest.raises(InputError, match=wrong):
            camera.check_lens()


@pytest.mark.parametrize(('center', 'side'), [
    ((0, 0, 0), 0.3), ((0, 0, -1), 0.3), ((0, 0, 1), 0), ((np.nan, 0, 1), 0.3)])
def test_a_cube_behind_the_camera_is_refused(center, side):
    with pytest.raises(InputError, match='cube'):
        Cube(center, side)
