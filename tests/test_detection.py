"""Where a hand may be: closed-form scenes, and real frames."""

import json

import cv2
import numpy as np
import pytest

from hand_pose_ros.detection import detect, holds_a_hand
from hand_pose_ros.geometry import Cube, Intrinsics

CAMERA = Intrinsics(500, 500, 319.5, 239.5, 640, 480)


def add_sphere(depth, center, radius, camera=CAMERA):
    """Render a sphere into a depth image, nearest surface first."""
    v, u = np.mgrid[:camera.height, :camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    along, square = rays @ np.asarray(center), (rays ** 2).sum(-1)
    inside = along ** 2 - square * (np.dot(center, center) - radius ** 2)
    z = ((along - np.sqrt(np.maximum(inside, 0))) / square).astype(np.float32)
    hit = (inside > 0) & ((depth == 0) | (z < depth))
    depth[hit] = z[hit]


@pytest.fixture
def empty():
    return np.zeros((480, 640), np.float32)


@pytest.mark.parametrize(('center', 'radius'), [
    ((0, 0, 0.16), 0.04), ((0, 0, 0.4), 0.04), ((0.1, -0.08, 0.6), 0.04), ((-0.2, 0.1, 1.0), 0.04),
    ((0.3, 0.3, 1.4), 0.031)])
def test_a_sphere_is_found_where_it_is(empty, center, radius):
    add_sphere(empty, center, radius)
    [cube] = detect(empty, CAMERA)
    assert cube.center[:2] == pytest.approx(center[:2], abs=0.006)
    assert center[2] - radius < cube.center[2] < center[2]  # only its near side is seen


def test_the_border_of_the_image_does_not_shift_the_centre(empty):
    """A sphere half out of view: the centre is that of the visible half, not pushed further in."""
    x = (0 - CAMERA.cx) / CAMERA.fx * 0.5
    add_sphere(empty, (x, 0, 0.5), 0.05)
    [cube] = detect(empty, CAMERA)
    v, u = np.nonzero(empty)
    z = empty[v, u]
    seen = ((u.mean() - CAMERA.cx) / CAMERA.fx * z.mean(), (v.mean() - CAMERA.cy) / CAMERA.fy * z.mean(), z.mean())
    assert cube.center == pytest.approx(seen, abs=0.004)


@pytest.mark.parametrize('fine', [Intrinsics(1000, 1000, 639.5, 479.5, 1280, 960),
                                  Intrinsics(1000, 500, 639.5, 239.5, 1280, 480)], ids=['both', 'across'])
def test_sizes_are_metres_not_pixels(fine):
    """The same scene seen with twice the resolution gives the same cube."""
    low, high = np.zeros((480, 640), np.float32), np.zeros((fine.height, fine.width), np.float32)
    for depth, camera in ((low, CAMERA), (high, fine)):
        add_sphere(depth, (0.05, 0.2, 0.7), 0.035, camera)
    [a], [b] = detect(low, CAMERA), detect(high, fine)
    assert a.center == pytest.approx(b.center, abs=0.003)


def test_the_nearest_hand_sized_object_wins_and_specks_do_not(empty):
    add_sphere(empty, (0, 0, 0.82), 0.05)  # in sight of the nearest one, but behind its cube
    add_sphere(empty, (-0.1, 0, 0.6), 0.05)
    add_sphere(empty, (0.05, 0.05, 0.3), 0.006)
    first, second = detect(empty, CAMERA, max_hands=2)
    assert first.center[2] == pytest.approx(0.57, abs=0.02) and second.center[2] == pytest.approx(0.79, abs=0.02)
    assert detect(empty, CAMERA) == [first]


@pytest.mark.parametrize('scene', ['nothing', 'wall', 'too far', 'too near', 'speck', 'table', 'pole'])
def test_no_hand_is_said_honestly(empty, scene):
    if scene == 'wall':
        empty[:] = 0.8
    elif scene == 'too far':
        add_sphere(empty, (0, 0, 2.0), 0.05)
    elif scene == 'too near':
        add_sphere(empty, (0, 0, 0.11), 0.04)
        empty[empty > 0.099] = 0
    elif scene == 'speck':
        add_sphere(empty, (0, 0, 0.5), 0.01)
    elif scene == 'table':  # a plane seen from above at an angle
        v = (np.arange(480) - CAMERA.cy) / CAMERA.fy
        empty[:] = (0.5 / (0.7 + 0.7 * v))[:, None]
    elif scene == 'pole':
        empty[:, 220:420] = 0.5
    assert detect(empty, CAMERA) == []


def test_what_leaves_through_one_side_may_be_an_arm(empty):
    """However wide its sleeve, and as flat as can be."""
    empty[240:, 220:420] = 0.5
    assert len(detect(empty, CAMERA)) == 1


def test_a_tracked_cube_is_lost_when_the_hand_is_gone(empty):
    cube = Cube((0, 0, 0.5), 0.3)
    assert not holds_a_hand(empty, CAMERA, cube)
    add_sphere(empty, (0.03, 0, 0.52), 0.045)
    assert holds_a_hand(empty, CAMERA, cube)
    assert not holds_a_hand(empty, CAMERA, cube, far=0.45) and not holds_a_hand(empty, CAMERA, cube, near=0.6)
    empty[:] = 0.5
    assert not holds_a_hand(empty, CAMERA, cube)
    assert holds_a_hand(empty, CAMERA, cube, max_through=1)  # for a network that can tell


def test_every_annotated_real_hand_is_found(shared_data):
    """In all 29 frames something is found, and in at least 27 the whole hand lies within the cube."""
    whole = 0
    for frame in json.loads((shared_data / 'frames/annotations.json').read_text())['frames']:
        depth = cv2.imread(str(shared_data / 'frames' / frame['file']), cv2.IMREAD_UNCHANGED).astype(np.float32)
        camera = Intrinsics(*(frame[k] for k in ('fx', 'fy', 'cx', 'cy', 'width', 'height')))
        [cube] = detect(depth * np.float32(frame['depth_scale_m']), camera)
        marks = np.array([p for p in frame['points'].values() if p])
        whole += np.abs(cube.to_cube(camera.back_project(marks[:, :2], marks[:, 2] / 1000))).max() <= 1
    assert whole >= 27


def test_regions_of_interest_replace_the_search(empty):
    add_sphere(empty, (-0.1, 0, 0.6), 0.05)
    add_sphere(empty, (0.2, 0, 0.9), 0.05)
    u, v = CAMERA.project((0.2, 0, 0.9)).astype(int)
    [cube] = detect(empty, CAMERA, regions=[(u - 60, v - 60, 120, 120)])
    assert cube.center[2] == pytest.approx(0.87, abs=0.02)
    assert detect(empty, CAMERA, regions=[(0, 0, 50, 50)]) == []
    assert detect(empty, CAMERA, regions=[(-60, -60, 50, 50)]) == []
    assert len(detect(empty, CAMERA, regions=[(-60, -60, 700, 540)], max_hands=2)) == 2


def test_an_arm_that_reaches_towards_the_camera_does_not_hide_its_hand(empty):
    """The elbow is nearest and found first; the next cube is around the hand at the far end of the arm."""
    hand = np.array([0.0, -0.2, 0.75])
    for share in np.linspace(0, 1, 30):
        add_sphere(empty, np.array([0.0, 0.1, 0.6]) * (1 - share) + hand * share, 0.035)
    first, second = detect(empty, CAMERA, max_hands=2)
    assert first.center[2] < 0.65
    assert np.linalg.norm(second.center - hand) < 0.08
