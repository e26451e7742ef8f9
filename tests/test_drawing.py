"""What pictures promise: joints, cube and surface are drawn where they are."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hand_pose_ros.drawing import FINGER_COLORS, close_up, contact_sheet, overlay, shade
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.skeleton import HAND21

TIPS = range(4, 21, 4)


@pytest.fixture
def drawn():
    """A hand before a wall, with one joint in each finger where it can be told apart."""
    joints = np.zeros((21, 3), np.float32)
    joints[:, 2] = 0.5
    for finger in range(5):
        for k in range(4):
            joints[1 + 4 * finger + k] = (-0.08 + 0.04 * finger, 0.04 - 0.03 * k, 0.5)
    joints[0] = (0.0, 0.08, 0.5)
    camera = Intrinsics(400.0, 400.0, 170.0, 110.0, 320, 240)
    depth = np.full((240, 320), 0.52, np.float32)
    depth[:, :20] = 0
    hand = SimpleNamespace(joints=joints, cube=Cube((0.0, 0.0, 0.5), 0.3), side='left', score=0.5, id='a',
                           confidence=np.ones(21, np.float32))
    return depth, camera, hand


def color_at(picture, point, camera):
    u, v = camera.project(point).round().astype(int)
    return tuple(picture[v, u, ::-1].tolist())


def test_joints_are_drawn_where_they_are_in_the_colour_of_their_finger(drawn):
    depth, camera, hand = drawn
    picture = overlay(depth, camera, [hand], height=480)
    assert picture.shape == (480, 640 + 480, 3)
    twice = Intrinsics(800.0, 800.0, 2 * 170.5 - 0.5, 2 * 110.5 - 0.5, 640, 480)
    # The close-up shows the cube: its centre in the middle, its side as wide as the picture.
    cube = Intrinsics(800.0, 800.0, 239.5, 239.5, 480, 480)
    for tip in TIPS:
        color = FINGER_COLORS[HAND21.fingers[tip]]
        assert color_at(picture, hand.joints[tip], twice) == color
        assert color_at(picture[:, 640:], hand.joints[tip], cube) == color
        assert color_at(close_up(depth, camera, hand.cube, hand.joints), hand.joints[tip], cube) == color


def test_a_picture_shows_the_surface_where_it_is_the_cube_and_what_was_found(drawn):
    depth, camera, hand = drawn
    thrice = overlay(depth, camera, [], height=720)
    np.testing.assert_allclose(thrice[1::3, 1::3][20:].astype(int), shade(depth, camera)[20:], atol=1)
    picture = overlay(depth, camera, [hand])
    for part, change in ((slice(640), {'cube': Cube((0.0, 0.0, 0.5), 0.2)}), (slice(640, 1120), {'side': 'right'}),
                         (slice(640, 1120), {'score': 0.6})):
        other = overlay(depth, camera, [SimpleNamespace(**{**vars(hand), **change})])
        assert (other[:, part] != picture[:, part]).any()
    aside = depth.copy()
    aside[:, :40] = 2.0  # outside the cube it does not change how the cube is tinted
    np.testing.assert_array_equal(close_up(aside, camera, hand.cube, hand.joints),
                                  close_up(depth, camera, hand.cube, hand.joints))


def test_nothing_is_dark_and_near_is_brighter_than_far():
    camera = Intrinsics(400.0, 400.0, 160.0, 120.0, 320, 240)
    depth = np.full((240, 320), 1.0, np.float32)
    depth[:, :100], depth[:, 220:] = 0.5, 0
    picture = shade(depth, camera).astype(int).sum(axis=2)
    assert picture[120, 50] > picture[120, 160] > picture[120, 270]
    assert shade(np.zeros((4, 4), np.float32), camera).max() < 40
    # The light is over the left shoulder: of ridges, the left and the upper flanks are brighter.
    v, u = np.mgrid[:240, :320]
    for at, first, second in ((np.abs(u - 160), (120, 100), (120, 220)), (np.abs(v - 120), (60, 160), (180, 160))):
        ridge = shade((0.5 + at / 800).astype(np.float32), camera).astype(int).sum(axis=2)
        assert ridge[first] > ridge[second] + 100


def test_what_is_not_finite_is_drawn_as_no_reading(drawn):
    depth, camera, hand = drawn
    broken = depth.copy()
    broken[100:110, 150:160], broken[:, :20] = np.nan, np.inf
    depth[100:110, 150:160] = 0
    np.testing.assert_array_equal(shade(broken, camera), shade(depth, camera))
    np.testing.assert_array_equal(overlay(broken, camera, [hand]), overlay(depth, camera, [hand]))
    np.testing.assert_array_equal(shade(depth.astype(float), camera), shade(depth, camera))


def test_the_nearest_joint_is_on_top(drawn):
    depth, camera, hand = drawn
    for z in (0.45, 0.55):
        joints = np.full((21, 3), np.nan)
        joints[list(TIPS[:2])] = np.array([0.1, 0.1, 1]) * [[0.5], [z]]
        picture = close_up(depth, camera, hand.cube, joints)
        cube = Intrinsics(800.0, 800.0, 239.5, 239.5, 480, 480)
        assert color_at(picture, joints[4], cube) == FINGER_COLORS['index' if z < 0.5 else 'thumb']


def test_joints_that_are_nowhere_are_not_drawn(drawn):
    depth, camera, hand = drawn
    whole, nothing = (close_up(depth, camera, hand.cube, joints) for joints in (hand.joints, np.full((21, 3), np.nan)))
    aside = hand.joints.copy()
    aside[TIPS[1], 0] = 1e8
    assert (close_up(depth, camera, hand.cube, aside) != whole).any()  # whose pixel no integer holds
    for nowhere in (np.nan, np.inf, 0.0):
        for joint in (TIPS[1], TIPS[1] - 1):  # nor are bones from or to them
            joints = hand.joints.copy()
            joints[joint] = nowhere
            picture = close_up(depth, camera, hand.cube, joints)
            assert (picture != whole).any() and (picture != nothing).any()
            assert (picture[(whole == nothing).all(axis=2)] == nothing[(whole == nothing).all(axis=2)]).all()
        np.testing.assert_array_equal(close_up(depth, camera, hand.cube, np.full((21, 3), nowhere)), nothing)


@pytest.mark.parametrize('shape', [(1, 4000), (4000, 1), (1, 1)])
def test_the_thinnest_images_give_a_picture_that_can_be_written(shape):
    height, width = shape
    picture = overlay(np.full(shape, 0.5, np.float32), Intrinsics(2000, 2000, 0, 0, width, height), [])
    assert picture.shape[0] == 480 and 120 <= picture.shape[1] <= 8000
    assert cv2.imencode('.png', picture)[0]


def test_a_contact_sheet_is_read_like_text():
    sheet = contact_sheet([np.full((2, 3, 3), value, np.uint8) for value in (50, 100, 150)], columns=2)
    assert sheet.shape == (4, 6, 3)
    assert (sheet[0, 0, 0], sheet[0, 3, 0], sheet[2, 0, 0]) == (50, 100, 150)
    assert contact_sheet([np.zeros((2, 3, 3), np.uint8)]).shape == (2, 3, 3)
