"""The class that users call: depth in, metric joints out, with the weights that ship."""

import json
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.models.checkpoints import DEFAULT, available, load_checkpoint, save_checkpoint
from hand_pose_ros.skeleton import HAND21, SKELETONS
from hand_pose_ros.synthetic.generator import SyntheticHands

pytestmark = pytest.mark.usefixtures('load_once')

KINECT2 = Intrinsics(363.9, 363.9, 255.4, 206.3, 512, 424)


@pytest.fixture(scope='module', params=sorted(available()))
def estimator(request):
    return HandPoseEstimator.from_pretrained(request.param, device='cpu')


@pytest.fixture(scope='module')
def sequence():
    """A second of a moving hand that no network has seen."""
    return [SimpleNamespace(depth=depth, intrinsics=camera, joints=joints)
            for depth, camera, joints, _ in SyntheticHands('test').sequence(5, frames=30)]


def mirrored(depth, camera):
    flipped = np.ascontiguousarray(depth[:, ::-1])
    return flipped, replace(camera, cx=camera.width - 1 - camera.cx)


def test_what_a_hand_is_made_of(estimator, sequence):
    estimator.reset()
    frame = sequence[0]
    [hand] = estimator(frame.depth, frame.intrinsics)
    assert hand.joints.shape == (21, 3) and hand.joints.dtype == np.float32 and np.isfinite(hand.joints).all()
    assert hand.joint_names[0] == 'wrist' and hand.joint_names[8] == 'index_tip' and len(hand.joint_names) == 21
    assert hand.confidence.shape == (21,) and ((hand.confidence >= 0) & (hand.confidence <= 1)).all()
    assert 0 <= hand.score <= 1 and hand.side in ('left', 'right', 'unknown')
    assert set(estimator.timings) == {'detect', 'crop', 'predict', 'uncrop'}


def test_joints_are_metric_and_where_the_hand_is(estimator, sequence):
    estimator.reset()
    errors = []
    for frame in sequence:
        [hand] = estimator(frame.depth, frame.intrinsics)
        errors.append(np.linalg.norm(hand.joints - frame.joints, axis=1))
    assert np.median(errors) < 0.025


def test_a_hand_behind_the_camera_is_none_and_does_not_last():
    answers = iter([-0.95, 0.0, 0.0])
    engine = SimpleNamespace(outputs=('joints', 'confidence', 'hand', 'side'), run_full=lambda patches: {
        'joints': np.full((len(patches), 21, 3), (0, 0, next(answers, 0.0)), np.float32),
        'confidence': np.full((len(patches), 21), 9.0, np.float32), 'hand': np.full(len(patches), 9.0, np.float32),
        'side': np.zeros(len(patches), np.float32)})
    estimator = HandPoseEstimator(engine, HAND21, find=lambda *_, **__: [Cube((0.0, 0.0, 0.13), 0.3)], min_score=0.0)
    depth = np.full((424, 512), 0.13, np.float32)
    assert estimator(depth, KINECT2) == []
    assert len(estimator(depth, KINECT2)) == 1 and len(estimator(depth, KINECT2)) == 1


def test_one_hand_keeps_its_name_until_reset(estimator, sequence):
    estimator.reset()
    names = {estimator(frame.depth, frame.intrinsics)[0].id for frame in sequence}
    assert len(names) == 1
    estimator.reset()
    assert estimator(sequence[0].depth, sequence[0].intrinsics)[0].id not in names


@pytest.mark.parametrize(('options', 'message'), [
    ({'side': 'Left'}, "unknown side 'Left': choose auto"), ({'max_hands': 0}, 'max_hands is 0'),
    ({'near': 1.0, 'far': 0.5}, 'which are 1.0 and 0.5 m'), ({'near': -0.1}, 'which are -0.1 and 1.5 m'),
    ({'cube_side': -0.3}, 'cube_side is -0.3'),
    ({'smoothing': float('nan')}, 'smoothing nan'), ({'min_score': float('nan')}, 'min_score nan: .* all finite')])
def test_options_that_find_nothing_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        HandPoseEstimator(SimpleNamespace(), HAND21, **options)


@pytest.mark.parametrize('tilt', [0.0, 0.5], ids=['wall', 'table'])
def test_a_hand_before_a_wall_or_over_a_table_is_found_and_followed(sequence, tilt):
    """The table comes nearer than the hand, at the lower edge of the image."""
    estimator = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu')
    names, errors = [], []
    for frame in sequence:
        row = (np.arange(frame.depth.shape[0]) - frame.intrinsics.cy) / frame.intrinsics.fy
        at = frame.joints.max(0)[2] + 0.06 + tilt * frame.joints.max(0)[1]
        plane = np.broadcast_to((at / (1 + tilt * row))[:, None], frame.depth.shape).astype(np.float32)
        hidden = (frame.depth == 0) | (frame.depth > plane)
        hands = estimator(np.where(hidden, plane, frame.depth), frame.intrinsics)
        names += [hand.id for hand in hands]
        errors += [np.linalg.norm(hand.joints - frame.joints, axis=1) for hand in hands]
    assert names == ['hand_1'] * len(sequence)
    assert np.median(errors) < 0.025


def test_the_cube_of_a_tracked_hand_fits_it_unless_its_size_was_given(sequence):
    def sides(**options):
        estimator = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', **options)
        return [hand.cube.side for frame in sequence for hand in estimator(frame.depth, frame.intrinsics)]

    assert set(sides(cube_side=0.27)) == {0.27}
    usual = sides()
    assert usual[0] == 0.3 and len(set(usual)) > 10
    assert max(abs(np.diff(usual))) < 0.01 and 0.24 < min(usual) < max(usual) < 0.37


def test_the_cube_stays_where_joints_do_not_tell_the_size_of_a_hand(sequence, tmp_path, monkeypatch):
    names = ('palm', *HAND21.joint_names[1:])
    monkeypatch.setitem(SKELETONS, 'palm21', replace(HAND21, name='palm21', joint_names=names))
    whole, path = load_checkpoint(DEFAULT), tmp_path / 'palm.safetensors'
    save_checkpoint(path, whole.network, {**whole.metadata, 'skeleton': 'palm21'})
    estimator = HandPoseEstimator.from_pretrained(path, device='cpu')
    assert {hand.cube.side for frame in sequence for hand in estimator(frame.depth, frame.intrinsics)} == {0.3}


@pytest.fixture(scope='module')
def sequence_of_two(sequence):
    """The hand, and beside it the same once more."""
    def once_more(frame):
        beside = np.zeros_like(frame.depth)
        beside[:, 200:] = frame.depth[:, :-200]
        depth = np.where((beside > 0) & ((frame.depth == 0) | (beside < frame.depth)), beside, frame.depth)
        return SimpleNamespace(depth=depth, intrinsics=frame.intrinsics)
    return [once_more(frame) for frame in sequence]


def test_two_hands_are_found_at_once_and_keep_their_names(sequence_of_two):
    estimator = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', max_hands=2)
    images = [estimator(frame.depth, frame.intrinsics) for frame in sequence_of_two]
    assert {tuple(hand.id for hand in hands) for hands in images} == {('hand_1', 'hand_2')}
    assert all(np.linalg.norm(np.subtract(*(hand.cube.center for hand in hands))) > 0.15 for hands in images)


def test_hands_are_told_apart_by_what_they_are(sequence_of_two):
    hands = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', max_hands=2)(
        sequence_of_two[0].depth, sequence_of_two[0].intrinsics)
    assert [hands.index(hand) for hand in hands] == [0, 1]
    assert len(set(hands)) == 2


def test_fewer_hands_are_followed_when_fewer_are_wanted(sequence_of_two):
    estimator = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', max_hands=2)
    counts = []
    for i, frame in enumerate(sequence_of_two[:6]):
        estimator.max_hands = 2 if i < 3 else 1
        counts.append([hand.id for hand in estimator(frame.depth, frame.intrinsics)])
    assert counts == [['hand_1', 'hand_2']] * 3 + [['hand_1']] * 3


def test_a_second_hand_that_enters_is_found_soon(sequence, sequence_of_two):
    estimator = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', max_hands=2)
    images = [estimator(frame.depth, frame.intrinsics) for frame in sequence[:10] + sequence_of_two[10:]]
    assert {len(hands) for hands in images[:10]} == {1} and {len(hands) for hands in images[20:]} == {2}
    assert {hands[0].id for hands in images} == {'hand_1'}


@pytest.mark.parametrize('detector', ['network', 'nearest'])
def test_one_hand_is_followed_while_a_second_is_missing_at_little_cost(sequence, monkeypatch, detector):
    """To look at what may be a hand costs several times as much as to track: most images do without."""
    def looks(max_hands):
        estimator = HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', max_hands=max_hands, detector=detector)
        run_full, shown = estimator.engine.run_full, []
        monkeypatch.setattr(estimator.engine, 'run_full', lambda patches: shown.append(1) or run_full(patches))
        return np.diff([len(estimator(frame.depth, frame.intrinsics)) and len(shown) for frame in sequence])

    more = looks(2) - looks(1)  # behind the first image
    assert (more == 0).sum() >= 0.75 * len(more) and more.max() <= 3
    assert more.any() == (detector == 'nearest')  # there is an arm, which is near, but does not look like a hand


def test_a_mirrored_scene_gives_mirrored_joints_of_the_other_hand(estimator, sequence):
    estimator.reset()
    for frame in sequence:
        [hand] = estimator(frame.depth, frame.intrinsics)
    estimator.reset()
    for frame in sequence:
        [other] = estimator(*mirrored(frame.depth, frame.intrinsics))
    assert {hand.side, other.side} == {'left', 'right'}
    # Pixels fall elsewhere in the mirror, and what that moves, the cube of the next image follows. Regression, with
    # nothing behind it, is moved most.
    refined, dense = 'refiner' in estimator.metadata, 'hand' in estimator.engine.outputs
    assert np.abs(other.joints * (-1, 1, 1) - hand.joints).max() < (0.005 if dense else 0.010 if refined else 0.015)


def test_results_repeat_to_the_bit(estimator, sequence):
    runs = []
    for _ in range(2):
        estimator.reset()
        runs.append(np.stack([estimator(frame.depth, frame.intrinsics)[0].joints for frame in sequence]))
    assert (runs[0] == runs[1]).all()


@pytest.mark.parametrize('value', [0.0, 0.8, 5.0])
def test_no_hand_is_an_empty_list(estimator, value):
    estimator.reset()
    assert estimator(np.full((424, 512), value, np.float32), KINECT2) == []


def test_a_hand_that_leaves_is_lost_and_found_again(estimator, sequence):
    estimator.reset()
    frame = sequence[0]
    assert estimator(frame.depth, frame.intrinsics)
    assert estimator(np.zeros_like(frame.depth), frame.intrinsics) == []
    assert estimator(frame.depth, frame.intrinsics)


def test_input_of_the_wrong_kind_is_refused(estimator):
    with pytest.raises(InputError, match='float32'):
        estimator(np.zeros((424, 512), np.uint16), KINECT2)
    with pytest.raises(InputError, match='512x424'):
        estimator(np.zeros((480, 640), np.float32), KINECT2)


def test_a_number_of_threads_reaches_the_networks():
    with pytest.raises(HandPoseError, match='num_threads is 0'):
        HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', num_threads=0)


def test_unknown_detectors_are_named():
    with pytest.raises(InputError, match='choose network or nearest'):
        HandPoseEstimator.from_pretrained(DEFAULT, device='cpu', detector='nose')


def test_the_hand_is_found_in_real_frames(estimator, shared_data):
    """In nearly all by the default network; the paper's, which is held against the depth, is refused more often."""
    estimator.reset()
    found = 0
    files = sorted((shared_data / 'frames/kinect2').glob('*.png'))
    for file in files:
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
        found += len(estimator(depth, KINECT2)) == 1
    assert found >= (0.95 if estimator.metadata['name'] == DEFAULT else 0.25) * len(files)


def test_a_scene_without_a_hand_has_none(estimator, shared_data):
    estimator.reset()
    depth = cv2.imread(str(shared_data / 'frames/must_reject/no_hand_jsk_16uc1.png'), cv2.IMREAD_UNCHANGED)
    assert estimator(depth.astype(np.float32) / 1000, Intrinsics(588, 588, 320, 240, 640, 480)) == []


def test_real_fingertips_are_found_within_a_finger(estimator, shared_data):
    """Annotated fingertips of two real sensors: the median lateral error is bounded (numbers: docs/models.md)."""
    errors = []
    for frame in json.loads((shared_data / 'frames/annotations.json').read_text())['frames']:
        depth = cv2.imread(str(shared_data / 'frames' / frame['file']), cv2.IMREAD_UNCHANGED)
        camera = Intrinsics(*(frame[key] for key in ('fx', 'fy', 'cx', 'cy', 'width', 'height')))
        estimator.reset()
        for hand in estimator(depth.astype(np.float32) * np.float32(frame['depth_scale_m']), camera):
            for name, point in frame['points'].items():
                if point and name.endswith('_tip') and name not in frame['doubtful']:
                    u, v = camera.project(hand.joints[hand.joint_names.index(name)])
                    z = point[2] / 1000
                    errors.append(np.hypot((u - point[0]) / camera.fx * z, (v - point[1]) / camera.fy * z))
    assert np.median(errors) < (0.008 if estimator.metadata['name'] == DEFAULT else 0.050)


@pytest.fixture
def told(monkeypatch):
    """Makes an estimator whose network says of a cube what it is told to, before a wall half a metre away.

    `say(cube)` tells where the middle of the joints is (metres), the score, and how far it looks like a right hand
    (logits); where what is seen is shown in the mirror, the score is a tenth less. `looks` are the cubes of an image.
    """
    def make(say, places=((0.0, 0.0, 0.5),), size=None, **options):
        looks = []

        def look(depth, cube, intrinsics):
            looks.append(cube)
            return np.concatenate([np.ones((1, 128, 64), np.float32), np.zeros((1, 128, 64), np.float32)], axis=2)

        def run_full(patches):
            middle, score, right = say(looks[-1])
            mirrored = patches[:, 0, 0, 0] == 0
            joints = looks[-1].to_cube(np.array(middle)) * np.where(mirrored[:, None], (-1, 1, 1), 1)
            probability = np.clip(np.where(mirrored, 0.9 * score, score), 1e-6, 1 - 1e-6)
            length = 0.0 if size is None else np.log(size / (0.19 / 0.30 * looks[-1].side))
            return {'joints': np.repeat(joints[:, None], 21, axis=1).astype(np.float32),
                    'confidence': np.full((len(patches), 21), 99.0, np.float32),
                    'hand': np.log(probability / (1 - probability)), 'side': np.where(mirrored, -right, right) / 2,
                    **({} if size is None else {'size': np.full(len(patches), length)})}

        monkeypatch.setattr('hand_pose_ros.estimator.crop', look)
        engine = SimpleNamespace(outputs=('joints', 'confidence', 'hand', 'side'), run_full=run_full)

        def find(depth, intrinsics, **where):
            estimator.asked.append(where)
            return [Cube(place, where['side']) for place in places]

        estimator = HandPoseEstimator(engine, HAND21, find=find, **options)
        estimator.looks, estimator.asked = looks, []
        return estimator
    return make


WALL = np.full((424, 512), 0.5, np.float32)


def image(estimator, **options):
    """The hands of the next image, and where was looked, across."""
    estimator.looks.clear()
    hands = estimator(WALL, KINECT2, **options)
    return hands, [round(cube.center[0], 3) for cube in estimator.looks]


def test_a_cube_follows_its_joints_until_they_are_in_its_middle_three_times_at_most(told):
    def apart(x, z=0.0):
        return told(lambda cube: (np.add(cube.center, (x, 0, z)), 0.9, 1), near=0.3)
    assert image(apart(0.029))[1] == [0] and image(apart(0.031))[1] == [0, 0.031, 0.062]
    assert image(apart(0.0, z=-0.2))[1] == [0] and image(apart(0.0, z=-0.19))[1] == [0, 0]  # where none is looked for
    [hand], _ = image(estimator := apart(0.02))
    assert hand.cube.center[0] == 0 and hand.joints[:, 0] == pytest.approx(0.02)
    assert image(estimator)[1] == [0.02]


def test_three_objects_that_are_no_hand_end_the_search_until_the_next_image(told):
    estimator = told(lambda cube: (cube.center, 0.5 if cube.center[0] > 0.55 else 0.3, 1),
                     places=[(x, 0.0, 0.5) for x in (0.0, 0.09, 0.11, 0.4, 0.6)])  # the second is the first once more
    assert image(estimator) == image(estimator) == ([], [0, 0.11, 0.4])
    estimator = told(lambda cube: (cube.center, 0.5 if cube.center[0] > 0.35 else 0.3, 1),
                     places=[(x, 0.0, 0.5) for x in (0.0, 0.2, 0.4)])
    assert [hand.id for hand in image(estimator)[0]] == ['hand_1']


def test_beside_a_hand_one_more_object_is_looked_at_in_every_fifth_image_until_all_were(told):
    estimator = told(lambda cube: (cube.center, 0.9 if cube.center[0] == 0 else 0.3, 1), max_hands=2,
                     places=[(x, 0.0, 0.5) for x in (0.0, 0.2, 0.4)])
    others = [image(estimator)[1][1:] for _ in range(17)]
    assert {k: seen for k, seen in enumerate(others) if seen} == {0: [0.2], 5: [0.4], 15: [0.2]}
    estimator.max_hands = 1
    image(estimator)  # nothing else is looked for: what was seen is forgotten
    estimator.max_hands = 2
    assert [image(estimator)[1][1:] for _ in range(4)] == [[], [], [0.2], []]


def test_beside_a_hand_what_hardly_looks_like_one_is_looked_at_once(told):
    def looks(score):
        estimator = told(lambda cube: (np.add(cube.center, (0.06 * (cube.center[0] > 0.15), 0, 0)),
                                       score if cube.center[0] > 0.15 else 0.95, 1), max_hands=2,
                         places=[(x, 0.0, 0.5) for x in (0.0, 0.2)])
        images = [image(estimator)[1] for _ in range(6)]
        assert images[1:] == 5 * [[0]]  # nor again, wherever its joints were
        return images[0]
    assert looks(0.09) == [0, 0.2] and looks(0.12) == [0, 0.2, 0.26, 0.32]


def test_a_hand_beside_another_begins_with_the_square_root_of_the_score_that_it_may_fall_to(told):
    score = {0.0: 0.45, 0.2: 0.62}
    estimator = told(lambda cube: (cube.center, score[round(cube.center[0], 1)], 1), max_hands=2,
                     places=[(x, 0.0, 0.5) for x in (0.0, 0.2)])

    def ids(images):
        return [[hand.id for hand in image(estimator)[0]] for _ in range(images)][-1]
    assert ids(11) == ['hand_1']
    score[0.2] = 0.65
    assert ids(11) == ['hand_1', 'hand_2']
    score[0.2] = 0.41
    assert ids(11) == ['hand_1', 'hand_2']
    score[0.2], score[0.0] = 0.7, 0.39
    assert ids(1) == ['hand_2']
    estimator.min_score = -1.0  # whatever it is
    assert ids(11) == ['hand_2', 'hand_3']


def test_two_cubes_that_come_to_one_hand_are_one_hand(told):
    middle = {0: 0.0, 1: 0.2}
    estimator = told(lambda cube: ((middle[round(cube.center[0] * 5)], 0.0, 0.5), 0.9, 1), max_hands=2,
                     places=[(x, 0.0, 0.5) for x in (0.0, 0.2)])
    assert [hand.id for hand in image(estimator)[0]] == ['hand_1', 'hand_2']
    middle[1] = 0.0
    assert [hand.id for hand in image(estimator)[0]] == ['hand_1']
    estimator.reset()
    assert [hand.id for hand in image(estimator)[0]] == ['hand_3']


def test_without_tracking_every_image_is_searched_beyond_objects_beside_a_hand(told):
    places = [(x, 0.0, 0.5) for x in (0.0, 0.2, 0.4)]
    for tracking, xs in ((True, [0.0]), (False, [0.0, 0.4])):
        estimator = told(lambda cube: (cube.center, 0.3 if cube.center[0] == 0.2 else 0.9, 1), places=places,
                         max_hands=2, tracking=tracking)
        assert [hand.cube.center[0] for hand in image(estimator)[0]] == xs


def test_a_side_is_what_a_hand_has_shown_of_it_in_the_last_images(told):
    right = [3.0]
    estimator = told(lambda cube: (np.add(cube.center, (0.01, 0, 0)), 0.9, right[0]))

    def shown(value, images=1):
        right[0] = value
        hands = [image(estimator)[0][0] for _ in range(images)]
        for hand in hands:
            assert hand.score == pytest.approx(0.9 if hand.side == 'right' else 0.81, abs=1e-5)
            assert hand.joints[0, 0] == pytest.approx(hand.cube.center[0] + 0.01, abs=1e-6)
        return [hand.side for hand in hands]
    assert shown(3.0) == ['right'] and shown(-1.0, 4) == ['right', 'right', 'left', 'left']
    shown(-5.5)
    assert shown(9.0, 7) == 6 * ['left'] + ['right']  # which is not asked again before
    assert shown(-4.2) == ['left']  # as what it has shown before has faded
    estimator.side = 'left'
    assert shown(9.0) == ['left']


def test_smoothing_knows_how_much_time_has_passed(told):
    def moved(*times, smoothing=1.0):
        x = iter(0.02 * np.arange(9))
        estimator = told(lambda cube: ((next(x), 0, 0.5), 0.9, 1), smoothing=1.0)
        for time_s in times:
            [hand], _ = image(estimator, time_s=time_s)
            estimator.smoothing = smoothing
        return hand.joints[0, 0]
    assert 0 < moved(5, 5.01) < moved(5, 5 + 1 / 30) < moved(5, 6) < 0.02
    assert moved(5, 5 + 1 / 30) == pytest.approx(moved(None, None), rel=1e-6)
    assert moved(5, 5 + 1 / 30) == pytest.approx(moved(5, 4), rel=1e-6)
    assert moved(5, None) == moved(5, 5) == moved(None, None)  # some drivers do not set the time
    assert all(0 < moved(1.0, odd, 1.1, 1.2) < 0.06 for odd in (np.inf, np.nan, 1e300, -5.0))
    assert moved(5, 6, smoothing=2.0) == pytest.approx(0.02)  # another one begins anew


def test_smoothing_that_is_switched_on_again_knows_nothing_of_before(told):
    x = iter((0.0, 0.02, 0.04))
    estimator = told(lambda cube: ((next(x), 0, 0.5), 0.9, 1))
    for smoothing in (0.5, 0.0, 0.5):
        estimator.smoothing = smoothing
        [hand], _ = image(estimator)
    assert hand.joints[0, 0] == pytest.approx(0.04)


def test_from_the_moment_that_tracking_ends_hands_have_no_history(told):
    estimator = told(lambda cube: (cube.center, 0.9, 1))
    assert [hand.id for hand in image(estimator)[0]] == ['hand_1']
    estimator.tracking = False
    assert [image(estimator)[0][0].id for _ in range(2)] == ['hand_2', 'hand_3']


def test_hands_are_looked_for_where_the_caller_says(told):
    estimator = told(lambda cube: (cube.center, 0.9, 1), near=0.0, far=0.6, cube_side=0.25)
    [hand], _ = image(estimator, regions=[(1, 2, 3, 4)])
    assert estimator.asked == [{'side': 0.25, 'near': 0.0, 'far': 0.6, 'regions': [(1, 2, 3, 4)]}]
    assert hand.cube.side == 0.25
    with pytest.raises(InputError, match='no camera of 512x424'):
        estimator(WALL, replace(KINECT2, fx=50.0, fy=50.0))
    for name, value in (('near', 0.55), ('far', 0.45)):
        estimator = told(lambda cube: (cube.center, 0.9, 1))
        image(estimator)
        estimator.find = lambda *_, **__: []
        setattr(estimator, name, value)
        assert image(estimator) == ([], [])


def test_a_cube_grows_with_the_hand_half_way_after_ten_images(told):
    def sides(size):
        estimator = told(lambda cube: (cube.center, 0.9, 1), size=size, metadata={'cube_side': 0.3})
        return [image(estimator)[0][0].cube.side for _ in range(200)]
    assert sides(1.1 * 0.166)[10] == pytest.approx(0.3 * 1.1 ** 0.5)
    assert sides(0.3)[-1] == pytest.approx(0.3 * np.exp(0.2))
    assert sides(0.1)[-1] == pytest.approx(0.3 * np.exp(-0.2))


def test_an_error_is_not_met_again(told):
    fail = []

    def say(cube):
        if fail:
            raise RuntimeError(fail.pop())
        return cube.center, 0.9, 1
    estimator = told(say)
    image(estimator)
    fail.append('out of memory')
    with pytest.raises(RuntimeError, match='out of memory'):
        image(estimator)
    assert [hand.id for hand in image(estimator)[0]] == ['hand_2']


def test_times_are_of_the_last_image_and_of_all_its_looks(told, monkeypatch):
    monkeypatch.setattr('time.perf_counter', count().__next__)
    estimator = told(lambda cube: (np.add(cube.center, (0.05, 0, 0)), 0.9, 1))
    image(estimator)
    assert estimator.timings == {'detect': 2, 'crop': 3, 'predict': 3, 'uncrop': 3}
    estimator.reset()
    estimator.find = lambda *_, **__: []
    image(estimator)
    assert estimator.timings == {'detect': 2, 'crop': 0, 'predict': 0, 'uncrop': 0}
