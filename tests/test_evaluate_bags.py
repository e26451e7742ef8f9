"""`hand-pose evaluate BAG`: the estimator over real bags, scored, timed, and with whatever is wrong said."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from torch.distributed import TCPStore

from hand_pose_ros.bags import Bag, BagWriter, DepthBag, read_hands
from hand_pose_ros.cli import main
from hand_pose_ros.cli.evaluate import _names
from hand_pose_ros.cli.hand_bag import HandBag
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.estimator import HandEstimate, HandPoseEstimator
from hand_pose_ros.evaluation import bag_evaluation
from hand_pose_ros.evaluation.bag_evaluation import Settings, evaluate_bag, evaluate_bags
from hand_pose_ros.evaluation.ground_truth import Truth, with_truth
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import save_checkpoint
from hand_pose_ros.skeleton import HAND21, get_skeleton

CAMERA = Intrinsics(240, 240, 159.5, 119.5, 320, 240)
FRAMES, STEP_NS = 12, 33_000_000


def depth_image(k):
    """A fist-sized ball that moves before a wall, with an arm."""
    v, u = np.mgrid[:240, :320]
    x, y = 120 + 4 * k, 100 + 2 * k
    square = 1 - ((u - x) ** 2 + (v - y) ** 2) / 30**2
    depth = np.where(square > 0, 0.5 - 0.05 * np.sqrt(np.maximum(square, 0)), 1.4).astype(np.float32)
    depth[y + 20:, x - 9:x + 9] = 0.52
    return depth


def record(path, frames=FRAMES, truth=None, step_ns=STEP_NS):
    with BagWriter(path) as bag:
        for k in range(frames):
            bag.write_depth(10**9 + k * step_ns, 'camera', depth_image(k), CAMERA, codec=None)
            if truth is not None:
                hand = HandEstimate(truth[k].astype(np.float32), HAND21.joint_names, np.ones(21, np.float32), 1.0,
                                    'right', Cube((0, 0, 0.5), 0.3), 'a')
                bag.write_hands(10**9 + k * step_ns, 'camera', [hand], HAND21, '/truth/joints')
    return path


@pytest.fixture(scope='module')
def model(weights):
    return str(weights)


@pytest.fixture(scope='module')
def settings(model):
    return Settings(model, 'cpu', num_threads=1, estimator={'min_score': 0.0, 'detector': 'nearest'})


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return record(tmp_path_factory.mktemp('bag') / 'ball.mcap')


@pytest.fixture(scope='module')
def result(bag, settings):
    return evaluate_bag(bag, settings)


def arguments(bag, model, *more):
    return ['evaluate', str(bag), '--model', model, '--device', 'cpu', '--detector', 'nearest',
            '--min-score', '0', *map(str, more)]


def test_every_image_is_estimated_twice_the_same(bag, settings, result):
    again = evaluate_bag(bag, settings)
    assert result.predictions.shape == (FRAMES, 21, 3) and np.isfinite(result.predictions).all()
    assert result.predictions.tobytes() == again.predictions.tobytes()
    assert result.stamps_ns.tolist() == [10**9 + k * STEP_NS for k in range(FRAMES)]
    searched = evaluate_bag(bag, replace(settings, estimator={'min_score': 0.0, 'tracking': False})).predictions
    moved = searched[-1].mean(0) - searched[0].mean(0)
    assert moved[:2] == pytest.approx(np.array([4, 2]) * (FRAMES - 1) / 240 * 0.5, abs=0.02), 'it follows the ball'


def test_stages_add_up_to_the_total(result):
    stages = {stage: seconds for stage, seconds in result.seconds.items() if stage != 'total'}
    assert {'read', 'decode', 'detect', 'crop', 'predict', 'uncrop'} <= set(stages)
    share = np.sum(list(stages.values()), axis=0) / result.seconds['total']
    assert (share <= 1).all() and np.median(share) > 0.8
    assert set(result.summary()['latency_ms']['total']) == {'mean', 'p50', 'p90', 'p99', 'max'}


def test_another_hand_is_no_jitter(tmp_path, settings, result):
    """One hand leaves while another comes: it is tracked next, and that it is elsewhere says nothing of the joints."""
    with BagWriter(tmp_path / 'two.mcap') as bag:
        for k in range(FRAMES):
            seen = np.roll(depth_image(k), -90 if k < FRAMES // 2 else 110, axis=1)
            bag.write_depth(10**9 + k * STEP_NS, 'camera', seen, CAMERA, codec=None)
    np.savez(tmp_path / 'truth.npz', joints=result.predictions)
    two = evaluate_bag(tmp_path / 'two.mcap', replace(settings, ground_truth=str(tmp_path / 'truth.npz')))
    assert len(set(two.hand_ids)) == 2
    two.save(tmp_path / 'two.npz')
    for scored in (two, Result.load(tmp_path / 'two.npz'), replace(two, truth=None)):
        told, mixed = scored.summary(), replace(scored, hand_ids=None).summary()
        assert told['tracks'] == 2
        assert all(told[name] < mixed[name] / 2 for name in ('error_jitter_mm', 'jitter_mm') if name in told)


def test_images_that_are_missing_are_no_jitter(result):
    moving = np.full((FRAMES, 21, 3), 0.5)
    moving[FRAMES // 2:] += 0.2  # so far has the hand moved, while no image was recorded
    stamps = result.stamps_ns + np.where(np.arange(FRAMES) < FRAMES // 2, 0, 10**9)
    blind = replace(result, predictions=moving, stamps_ns=stamps)
    scored = replace(blind, truth=np.ones_like(moving), parts={'all': (0, FRAMES)}).summary()
    assert blind.summary()['jitter_mm'] == scored['error_jitter_mm'] == scored['parts']['all']['jitter_mm'] == 0
    assert replace(blind, stamps_ns=result.stamps_ns).summary()['jitter_mm'] > 10


@pytest.mark.parametrize('kind', ['topic', 'npz', 'npz with stamps', 'text'])
def test_truth_from_a_topic_a_file_or_text_gives_the_same_error(tmp_path, model, result, kind):
    truth = result.predictions + np.array([0.006, 0, 0.008])  # 10 mm off
    bag = record(tmp_path / 'bag.mcap', truth=truth if kind == 'topic' else None)
    source = tmp_path / ('truth.txt' if kind == 'text' else 'truth.npz')
    if kind == 'topic':
        source = '/truth/joints'
    elif kind == 'npz':
        np.savez(source, joints=truth)
    elif kind == 'npz with stamps':  # in another order, a little late, one missing
        np.savez(source, joints=truth[:0:-1], stamps_ns=result.stamps_ns[:0:-1] + 4_000_000)
    else:
        np.savetxt(source, np.concatenate([CAMERA.project(truth), 1000 * truth[..., 2:]], -1).reshape(FRAMES, -1))
    code = main(arguments(bag, model, '--ground-truth', source, '--json', tmp_path / 'r.json',
                          '--out', tmp_path / 'r.npz'))
    got = json.loads((tmp_path / 'r.json').read_text())
    assert code == 0 and got['frames'] == FRAMES - (kind == 'npz with stamps')
    assert got['mean_mm'] == pytest.approx(10, abs=1e-3) and got['max_mm'] == pytest.approx(10, abs=1e-3)
    assert got['error_jitter_mm'] == pytest.approx(0, abs=1e-3) and got['mean_rigid_aligned_mm'] < 1e-3
    assert Result.load(tmp_path / 'r.npz').summary()['mean_mm'] == got['mean_mm']


def test_a_label_belongs_to_the_nearest_image_and_to_no_other(result):
    # The third label is between two images, too far from both. No image from 2 on has a nearer label than these two.
    stamps = result.stamps_ns[[0, 2, 6]] + [0, STEP_NS // 4, STEP_NS // 2]
    labels = Truth('labels', result.predictions[[0, 2, 6]], stamps)
    scored = with_truth(result, labels, 'camera')
    labelled = np.isfinite(scored.truth).all((1, 2))
    assert np.flatnonzero(labelled).tolist() == [0, 2]
    np.testing.assert_array_equal(scored.truth[2], result.predictions[2])
    assert f'{FRAMES - 2} of {FRAMES} images have no label in labels' in scored.notes[-1]


def test_truth_of_other_joints_or_in_another_frame_is_refused(tmp_path, model, result, capsys):
    hand = HandEstimate(result.predictions[0].astype(np.float32), HAND21.joint_names, np.ones(21, np.float32), 1.0,
                        'right', Cube((0, 0, 0.5), 0.3), 'a')
    for k, (skeleton, frame, message) in enumerate((
            (get_skeleton('msra21'), 'camera', 'has joints of msra21, but the estimator gives those of hand21'),
            (HAND21, 'base_link', "its joints are in frame 'base_link', but the images in 'camera'"))):
        with BagWriter(tmp_path / f'{k}.mcap') as bag:
            bag.write_depth(10**9, 'camera', depth_image(0), CAMERA, codec=None)
            bag.write_hands(10**9, frame, [hand], skeleton, '/truth/joints')
        assert main(arguments(tmp_path / f'{k}.mcap', model, '--ground-truth', '/truth/joints')) == 1
        assert message in capsys.readouterr().err
    for name, hands, message in (('two', [hand, hand], 'has 2 hands at 1000000000 ns'), ('none', [], 'has no hand in')):
        with BagWriter(tmp_path / f'{name}.mcap') as bag:
            bag.write_depth(10**9, 'camera', depth_image(0), CAMERA, codec=None)
            bag.write_hands(10**9, 'camera', hands, HAND21, '/truth/joints')
        assert main(arguments(tmp_path / f'{name}.mcap', model, '--ground-truth', '/truth/joints')) == 1
        assert message in capsys.readouterr().err


def test_truth_that_does_not_fit_is_refused(tmp_path, bag, model, result, capsys, monkeypatch):
    np.savez(tmp_path / 'few.npz', joints=result.predictions[:3])
    np.savez(tmp_path / 'nyu.npz', joints=np.zeros((FRAMES, 14, 3)))
    np.savez(tmp_path / 'late.npz', joints=result.predictions, stamps_ns=result.stamps_ns + 10**12)
    np.savez(tmp_path / 'odd.npz', wrong=np.zeros(3))
    np.savez(tmp_path / 'stamps.npz', joints=result.predictions, stamps_ns=result.stamps_ns[:-1])
    np.savez(tmp_path / 'none.npz', joints=result.predictions[:0], stamps_ns=result.stamps_ns[:0])
    np.savez(tmp_path / 'one.npz', joints=3.0, stamps_ns=result.stamps_ns)
    np.save(tmp_path / 'array.npy', np.zeros(3))
    (tmp_path / 'array.npy').rename(tmp_path / 'array.npz')
    for source, message in (
            (tmp_path / 'few.npz', '3 labels for 12 images'), (tmp_path / 'nyu.npz', r'shape (12, 14, 3)'),
            (tmp_path / 'late.npz', 'no label is within 10 ms'), (tmp_path / 'odd.npz', 'array joints'),
            (tmp_path / 'stamps.npz', 'stamps_ns of shape (11,) for 12 labels'),
            (tmp_path / 'none.npz', 'joints has no labels'), (tmp_path / 'one.npz', 'the truth has the shape ()'),
            (tmp_path / 'array.npz', 'array joints'),
            ('/truth/joints', 'no hand_pose_ros/HandJointsArray on /truth/joints: choose another bag'),
            (bag, 'ball.mcap: this is a bag: give a topic'), ('truth.csv', 'no such file'),
            (tmp_path / 'lost.npz', 'no such file')):
        assert main(arguments(bag, model, '--ground-truth', source)) == 1
        assert message in capsys.readouterr().err
    monkeypatch.setattr(HandPoseEstimator, '__call__', lambda *_, **__: pytest.fail('what is wrong is told first'))
    assert main(arguments(bag, model, '--ground-truth', tmp_path / 'nyu.npz')) == 1
    assert main(arguments(bag, model, '--ground-truth', tmp_path / 'nyu.npz', '--out', tmp_path / 'nyu.npz')) == 1
    assert 'nyu.npz: this is the input, which would be lost' in capsys.readouterr().err
    for option in ('--json', '--out', '--report'):
        assert main(arguments(bag, model, option, tmp_path / 'nyu.npz' / 'a' / 'out.npz')) == 1
        assert 'out.npz' in (said := capsys.readouterr().err) and 'cannot be written' in said


def test_hands_go_into_a_bag_that_plays_beside_the_original(tmp_path, bag, model, result):
    assert main(arguments(bag, model, '--out-bag', tmp_path / 'hands.mcap')) == 0
    hands = read_hands(tmp_path / 'hands.mcap', '/hand/joints')
    assert [message.stamp_ns for message in hands] == result.stamps_ns.tolist()
    assert np.stack([message.joints[0] for message in hands]) == pytest.approx(result.predictions, abs=1e-6)
    with Bag(tmp_path / 'hands.mcap') as written:
        topics = {connection.topic for connection in written.connections}
    assert topics == {'/hand/joints', '/hand/skeleton', '/hand/markers'}


def test_hands_of_other_joints_replace_what_is_left_of_a_bag(tmp_path, bag):
    icvl16 = get_skeleton('icvl16')
    hand = HandEstimate(np.full((16, 3), 0.5, np.float32), icvl16.joint_names, np.ones(16, np.float32), 1.0, 'right',
                        Cube((0, 0, 0.5), 0.3), 'a')
    path = tmp_path / 'hands.mcap'
    path.write_bytes(bag.read_bytes()[:20])
    with DepthBag(bag) as images, HandBag(path, icvl16, {'architecture': 'a', 'version': '1'}) as hands:
        hands.add(next(iter(images)), [hand])
    [recorded] = read_hands(path)
    assert recorded.skeleton == 'icvl16' and recorded.joints.shape == (1, 16, 3)


def test_images_that_cannot_be_decoded_count_as_images_without_a_hand(tmp_path, settings):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        for k in range(3):
            bag.write_depth(10**9 + k, 'camera', depth_image(k)[:120] if k == 1 else depth_image(k), CAMERA, codec=None)
    result = evaluate_bag(path, settings)
    assert np.isnan(result.predictions).all((1, 2)).tolist() == [False, True, False]
    assert '1 of 3 images could not be used' in result.notes[0] and '320x120' in result.notes[0]
    with BagWriter(path) as bag:
        bag.write_depth(10**9, 'camera', depth_image(1)[:120], CAMERA, codec=None)
    with pytest.raises(InputError, match=r'no depth image to evaluate \(image 1: .*320x120'):
        evaluate_bag(path, settings, open_sink=partial(HandBag, tmp_path / 'hands.mcap'))
    assert not (tmp_path / 'hands.mcap').exists()


def test_a_damaged_bag_is_evaluated_up_to_the_damage(tmp_path, bag, model, capsys):
    whole = bag.read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[:int(len(whole) * 0.6)])
    assert main(arguments(cut, model, '--json', tmp_path / 'r.json')) == 1
    got = json.loads((tmp_path / 'r.json').read_text())
    assert got['damaged'] and 0 < got['frames'] < FRAMES
    assert 'cut short' in capsys.readouterr().err and 'before the damage' in got['notes'][0]


def test_a_damaged_bag_is_scored_by_its_own_labels_up_to_the_damage(tmp_path, model, result):
    whole = record(tmp_path / 'bag.mcap', truth=result.predictions).read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[:int(len(whole) * 0.6)])
    assert main(arguments(tmp_path / 'cut.mcap', model, '--ground-truth', '/truth/joints',
                          '--json', tmp_path / 'r.json')) == 1
    got = json.loads((tmp_path / 'r.json').read_text())
    assert got['damaged'] and 0 < got['frames'] < FRAMES and got['mean_mm'] < 0.1


def test_a_label_is_for_one_image(tmp_path, model, settings, capsys):
    """Of images 8 ms apart every other one is labelled: the rest must not be scored by the label of a neighbour."""
    bag = record(tmp_path / 'fast.mcap', step_ns=8_000_000)
    result = evaluate_bag(bag, settings)
    np.savez(tmp_path / 'half.npz', joints=result.predictions[::2], stamps_ns=result.stamps_ns[::2])
    scored = evaluate_bag(bag, replace(settings, ground_truth=str(tmp_path / 'half.npz')))
    assert scored.summary()['frames'] == FRAMES // 2 and scored.summary()['max_mm'] == 0
    assert f'{FRAMES // 2} of {FRAMES} images have no label' in scored.notes[0]
    np.savez(tmp_path / 'zero.npz', joints=result.predictions, stamps_ns=np.zeros(FRAMES, np.int64))
    assert main(arguments(bag, model, '--ground-truth', tmp_path / 'zero.npz')) == 1
    assert 'several labels have the stamp 0 ns' in capsys.readouterr().err


def test_hands_of_one_bag_do_not_become_a_part_of_another(tmp_path, bag, model, capsys):
    (folder := tmp_path / 'recording').mkdir()
    shutil.copy(bag, folder / 'recording_0.mcap')
    assert main(['evaluate', str(folder), *arguments(bag, model, '--out-bag', folder)[1:]]) == 1
    assert 'recording.mcap: this is the input, which would be lost' in capsys.readouterr().err


def test_hands_that_were_estimated_are_no_labels_of_images(tmp_path, bag, model, capsys):
    hands = tmp_path / 'hands.npz'
    assert main(['estimate', *arguments(bag, model)[1:], '--out', str(hands)]) == 0
    assert main(arguments(bag, model, '--ground-truth', hands)) == 1
    assert 'hands.npz: its rows are hands, and not images' in capsys.readouterr().err


def test_labels_at_the_camera_are_none(tmp_path, bag, settings, result):
    truth = result.predictions.copy()
    truth[3], truth[5, 7] = 0, 0
    np.savez(tmp_path / 'truth.npz', joints=truth)
    scored = evaluate_bag(bag, replace(settings, ground_truth=str(tmp_path / 'truth.npz')))
    assert scored.summary()['frames'] == FRAMES - 1 and scored.summary()['max_mm'] == 0


def test_what_is_wrong_with_a_bag_is_said(tmp_path, model, capsys):
    two = tmp_path / 'two.mcap'
    with BagWriter(two) as bag:
        for topic in ('/left/depth', '/right/depth'):
            bag.write_depth(10**9, 'camera', depth_image(0), CAMERA, topic=topic, codec=None)
    (empty := tmp_path / 'empty.mcap').touch()
    (photo := tmp_path / 'photo.jpg').write_bytes(b'\xff\xd8\xff\xe0')
    for bag, more, message in ((empty, (), 'it is empty: record or copy it again'),
                               (photo, (), 'give a .bag, .mcap or .db3 file or the folder of a ROS 2 bag\n'),
                               (two, (), 'choose one with --depth-topic: /left/depth, /right/depth'),
                               (tmp_path / 'none.mcap', (), 'there is no such bag')):
        assert main(arguments(bag, model, *more)) == 1
        assert message in capsys.readouterr().err
    assert main(arguments(two, model, '--depth-topic', '/left/depth')) == 0
    assert main(arguments(two, model, '--depth-topic', '/left/depth', '--out-bag', two)) == 1
    assert 'this is the input, which would be lost' in capsys.readouterr().err
    assert main(arguments(two, model, '--depth-topic', '/left/depth', '--json', two)) == 1
    assert 'this is the input, which would be lost' in capsys.readouterr().err
    for more in (('bag.mcap', '--via-ros', '--out-bag', 'x.mcap'), (str(two), '--out', str(two)),
                 (str(two), '--out', 'result'), (str(two), '--dataset', 'nyu'),
                 (str(two), '--root', '.'), (str(two), '--split', 'val'), ('msra:P1',),
                 *((*more, '--predictions', 'p.txt', '--ground-truth', 'g.txt', '--dataset', 'nyu')
                   for more in (('--model', model), ('--root', '.'), ('bag.mcap',)))):
        with pytest.raises(SystemExit) as caught:
            main(['evaluate', *more])
        assert caught.value.code == 2
    assert DepthBag(two, depth_topic='/left/depth')


def test_real_bags_without_camera_info_need_intrinsics(shared_data, model, capsys):
    for name in ('raw', 'compressedDepth'):
        bag = shared_data / 'bags' / f'{name}.bag'
        assert main(arguments(bag, model)) == 1
        assert 'CameraInfo' in capsys.readouterr().err
        assert main(arguments(bag, model, '--intrinsics', 210, 210, 212, 120)) == 0
        assert 'raw: 1 frame, ' in capsys.readouterr().out.replace(name, 'raw')


def test_many_bags_at_once_and_one_that_fails(tmp_path, bag, model, settings, monkeypatch, capsys):
    reported = []
    monkeypatch.setattr('hand_pose_ros.evaluation.report.write_report',
                        lambda results, folder, read: reported.append((folder.name, *read([0]))) or folder)
    same_name = record(tmp_path / 'other' / 'ball.mcap', frames=4)
    code = main(['evaluate', str(bag), str(tmp_path / 'none.mcap'), str(same_name), '--model', model, '--device', 'cpu',
                 '--detector', 'nearest', '--min-score', '0', '--json', str(tmp_path / 'all.json'),
                 '--out', str(tmp_path / 'out'), '--out-bag', str(tmp_path / 'hands'), '--report', str(tmp_path)])
    captured = capsys.readouterr()
    assert code == 1 and 'none.mcap: there is no such bag' in captured.err and '1 of 3 bags failed' in captured.err
    got = json.loads((tmp_path / 'all.json').read_text())['bags']
    assert list(got) == [str(bag), str(tmp_path / 'none.mcap'), str(same_name)], 'in the order of the command'
    assert [got[str(bag)]['frames'], got[str(same_name)]['frames']] == [FRAMES, 4]
    assert sorted(reported) == sorted((got[str(each)]['name'], 0) for each in (bag, same_name))
    results = sorted((tmp_path / 'out').iterdir())
    assert len(results) == 2 and len(list((tmp_path / 'hands').iterdir())) == 2, 'equal names do not collide'
    alone = evaluate_bag(bag, settings)
    together = next(r for r in map(Result.load, results) if len(r.predictions) == FRAMES)
    assert together.predictions.tobytes() == alone.predictions.tobytes()


def test_a_bag_that_is_given_twice_is_refused_however_it_is_spelled(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for spelling in ('x.mcap', './x.mcap', 'day1/../x.mcap', os.path.abspath('x.mcap')):
        with pytest.raises(SystemExit) as caught:
            main(['evaluate', 'other.mcap', 'x.mcap', spelling])
        assert caught.value.code == 2
        assert f'x.mcap and {spelling} are the same bag: give it once' in capsys.readouterr().err


def test_ctrl_c_begins_no_further_bag(bag, settings, monkeypatch):
    begun = []

    def interrupted(path, *_, **__):
        begun.append(path)
        raise KeyboardInterrupt

    monkeypatch.setattr(bag_evaluation, 'evaluate_bag', interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(evaluate_bags([bag, 'another.mcap'], settings, jobs=1))
    assert begun == [bag]


def test_ctrl_c_loses_no_result(tmp_path, bag, model, monkeypatch):
    def interrupted(path, *more, **options):
        if path == 'another.mcap':
            raise KeyboardInterrupt
        return evaluate_bag(path, *more, **options)

    monkeypatch.setattr(bag_evaluation, 'evaluate_bag', interrupted)
    more = ['--jobs', 1, '--json', tmp_path / 'all.json', '--out', tmp_path / 'out']
    command, first, *options = arguments(bag, model, *more)
    assert main([command, first, 'another.mcap', *options]) == 1
    assert list(json.loads((tmp_path / 'all.json').read_text())['bags']) == [str(bag)]
    assert (tmp_path / 'out' / 'ball.npz').exists()


def test_processes_of_torchrun_share_the_bags(tmp_path, bag, model):
    """Two processes that find each other as torchrun's do: each reads its share, the first has all results."""
    other = record(tmp_path / 'other.mcap', frames=5)
    store = TCPStore('127.0.0.1', 0, is_master=True, wait_for_workers=False)  # at a port that nobody else can take
    processes = [subprocess.Popen(
        [sys.executable, '-m', 'hand_pose_ros.cli', 'evaluate', str(bag), str(other), '--model', model, '--device',
         'cpu', '--min-score', '0', '--json', str(tmp_path / f'{rank}.json')],
        env={**os.environ, 'RANK': str(rank), 'WORLD_SIZE': '2', 'LOCAL_WORLD_SIZE': '2', 'MASTER_ADDR': '127.0.0.1',
             'MASTER_PORT': str(store.port), 'TORCHELASTIC_USE_AGENT_STORE': 'True',
             'TORCHELASTIC_RESTART_COUNT': '0'}) for rank in range(2)]
    assert [process.wait(timeout=250) for process in processes] == [0, 0]
    assert not (tmp_path / '1.json').exists()
    got = json.loads((tmp_path / '0.json').read_text())['bags']
    assert {name: one['frames'] for name, one in got.items()} == {str(bag): FRAMES, str(other): 5}


@pytest.mark.parametrize('asked, usable, taken', [('auto', True, 'cuda:1'), ('cuda', True, 'cuda:1'),
                                                  ('auto', False, 'auto'), ('cpu', True, 'cpu'),
                                                  ('cuda:0', True, 'cuda:0')])
def test_each_process_of_torchrun_works_on_a_gpu_of_its_own(settings, monkeypatch, asked, usable, taken):
    def check(device):
        if not usable:
            raise HandPoseError(f'{device} is too old')

    devices = []
    monkeypatch.setattr(bag_evaluation, 'evaluate_bag', lambda _, settings, **__: devices.append(settings.device))
    monkeypatch.setattr(bag_evaluation, 'check_device', check)
    monkeypatch.setattr('torch.cuda.is_available', lambda: True)
    monkeypatch.setattr('torch.cuda.device_count', lambda: 2)
    monkeypatch.setenv('LOCAL_RANK', '3')  # there are more processes than GPUs
    list(evaluate_bags(['a.mcap'], replace(settings, device=asked)))
    assert devices == [taken]


def test_the_live_node_answers_what_the_estimator_says(ros_domain, tmp_path, model, settings):
    pytest.importorskip('rclpy', reason='ROS is not installed')
    bag = record(tmp_path / 'slow.mcap', frames=8, step_ns=200_000_000)
    model = str(shutil.copy(model, tmp_path / "a: b's #1, [x] {y}.safetensors"))  # as YAML many things, but not a name
    given = 250.0, 245.0, 150.0, 125.0  # instead of the camera_info
    assert main(arguments(bag, model, '--via-ros', '--json', tmp_path / 'r.json', '--out', tmp_path / 'r.npz',
                          '--intrinsics', *given)) == 0
    got, live = json.loads((tmp_path / 'r.json').read_text()), Result.load(tmp_path / 'r.npz').predictions
    answered = np.isfinite(live).all((1, 2))
    assert answered.sum() == 8 - got['dropped'] > 4, 'a busy machine may drop an image'
    until = int(np.argmin(answered)) if got['dropped'] else 8
    expected = evaluate_bag(bag, replace(settings, bag={'intrinsics': given})).predictions
    assert live[:until] == pytest.approx(expected[:until], abs=1e-5)
    assert 0 < got['latency_ms']['image to joints']['p50'] < 2000


def test_the_live_node_is_shown_a_damaged_bag_as_far_as_it_goes(ros_domain, tmp_path, model, capsys):
    pytest.importorskip('rclpy', reason='ROS is not installed')
    whole = record(tmp_path / 'bag.mcap', step_ns=200_000_000).read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[:int(len(whole) * 0.6)])
    # With intrinsics it needs no camera_info.
    assert main(arguments(tmp_path / 'cut.mcap', model, '--via-ros', '--json', tmp_path / 'r.json', '--intrinsics',
                          240, 240, 159.5, 119.5, '--camera-info-topic', '/none')) == 1
    got = json.loads((tmp_path / 'r.json').read_text())
    assert got['damaged'] and got['dropped'] < got['frames_total'] < FRAMES
    assert 'before the damage' in capsys.readouterr().err


def test_images_of_one_stamp_are_not_played_through_the_node(tmp_path, model, capsys):
    pytest.importorskip('rclpy', reason='ROS is not installed')
    bag = record(tmp_path / 'still.mcap', frames=2, step_ns=0)
    assert main(arguments(bag, model)) == 0
    assert main(arguments(bag, model, '--via-ros')) == 1
    assert 'still.mcap: 2 images have the stamp 1000000000 ns' in capsys.readouterr().err


@pytest.mark.skipif(not Path('/proc/self/task').exists(), reason='looks for processes in /proc')
@pytest.mark.timeout(600)
@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_processes_that_evaluate_end_with_the_one_that_started_them_and_leave_nothing(number, tmp_path):
    bag = tmp_path / 'long.mcap'
    with Bag(record(tmp_path / 'one.mcap', frames=1)) as one, BagWriter(bag) as writer:
        messages = list(one.messages(one.connections))
        for k in range(1500):
            for connection, time_ns, data in messages:
                writer.write_serialized(connection.topic, connection.msgtype, data, time_ns + k * STEP_NS)
    bags = [tmp_path / f'{k}.mcap' for k in range(4)]  # so that more are waiting
    for each in bags:
        each.symlink_to(bag)
    whole = subprocess.Popen([sys.executable, '-m', 'hand_pose_ros.cli', 'evaluate', *map(str, bags), '--device', 'cpu',
                              '--jobs', '2', '--out-bag', str(tmp_path / 'hands')], stderr=subprocess.PIPE, text=True,
                             start_new_session=True)

    def children():
        return Path(f'/proc/{whole.pid}/task/{whole.pid}/children').read_text().split()

    def runs(process):
        with suppress(OSError):  # no longer there
            return Path(f'/proc/{process}/cmdline').read_bytes() != b''  # as of who has ended, but was not waited for

    def wait(until):
        end = time.monotonic() + 200
        while not until() and time.monotonic() < end:
            time.sleep(0.05)
        return until()

    assert wait(lambda: len([*tmp_path.glob('hands/.*/*')]) == 2), 'both are at work'
    started = children()
    assert len(started) >= 3, 'two workers and what watches over their resources'
    # Terminals and service managers send a signal to all of them, and the one that started them passes it on.
    (os.kill if number == signal.SIGKILL else os.killpg)(whole.pid, number)
    assert 'Traceback' not in whole.communicate(timeout=200)[1]
    assert wait(lambda: not any(map(runs, started)))
    assert [*tmp_path.glob('hands/*'), *tmp_path.glob('hands/.*')] == []


def test_answers_of_the_live_node_are_scored_by_their_stamps(tmp_path, monkeypatch, capsys):
    """Without the node: what it is asked for, and what its answers become."""
    pytest.importorskip('rclpy', reason='ROS is not installed')
    from hand_pose_ros.ros.live import Answers
    icvl16, stamps = get_skeleton('icvl16'), [10**9 + k * STEP_NS for k in range(5)]
    truth = np.random.default_rng(0).uniform(0.4, 0.6, (5, 16, 3))
    save_checkpoint(tmp_path / 'icvl.safetensors', build('shallow', joints=16),
                    {'skeleton': 'icvl16', 'cube_side': 0.25})
    for frame in ('camera', 'base_link'):
        with BagWriter(tmp_path / f'{frame}.mcap') as bag:
            for k, stamp in enumerate(stamps):
                rows = 120 if k == 0 or (frame == 'base_link' and k < 4) else 240  # too few for this camera
                for topic in ('/depth/image_rect', '/other/image_rect'):
                    bag.write_depth(stamp, 'camera', depth_image(k)[:rows], CAMERA, topic=topic, codec=None)
                hand = HandEstimate(truth[k].astype(np.float32), icvl16.joint_names, np.ones(16, np.float32), 1.0,
                                    'right', Cube((0, 0, 0.5), 0.3), 'a')
                bag.write_hands(stamp, frame, [hand], icvl16, '/truth/joints')

    def hands(number, k):
        points = [SimpleNamespace(x=x, y=y, z=z) for x, y, z in truth[k] + [0.006, 0, 0.008]]  # 10 mm off
        return SimpleNamespace(hands=[SimpleNamespace(id=number, joints=points)])

    def play(bag, *given):
        asked.append((bag.depth_topic, *given))
        return Answers('icvl16', {stamps[1]: hands('1', 1), stamps[2]: hands('2', 2),
                                  stamps[3]: SimpleNamespace(hands=[])},
                       {stamps[1]: 0.010, stamps[2]: 0.020, stamps[3]: 0.030})

    asked = []
    monkeypatch.setattr('hand_pose_ros.ros.live.play_through_node', play)
    more = ('--via-ros', '--depth-topic', '/other/image_rect', '--ground-truth', '/truth/joints',
            '--json', tmp_path / 'r.json')
    model = str(tmp_path / 'icvl.safetensors')
    assert main(arguments(tmp_path / 'camera.mcap', model, *more, '--camera-info-topic', '/depth/camera_info', '--side',
                          'left', '--cube-size', '0.2', '--depth-scale', '0.002')) == 0
    parameters = {'model': model, 'device': 'cpu', 'side': 'left', 'detector': 'nearest', 'cube_size': 0.2,
                  'min_score': 0.0, 'depth_scale': 0.002, 'max_hands': 1}
    assert asked.pop() == ('/other/image_rect', '/depth/camera_info', parameters)
    got, said = json.loads((tmp_path / 'r.json').read_text()), capsys.readouterr()
    assert [got[key] for key in ('name', 'frames', 'dropped', 'missed_frames', 'tracks', 'damaged', 'model')] == [
        'camera', 5, 2, 3, 2, False, model]
    assert got['mean_mm'] == pytest.approx(10, abs=1e-3) and got['max_mm'] == pytest.approx(10, abs=1e-3)
    assert got['latency_ms']['image to joints']['mean'] == pytest.approx(20)
    assert got['notes'] == ['2 of 5 images got no answer from the node and count as images without a hand.']
    assert 'camera: 5 frames, 40.0 % with a hand, 2 tracks, 2 dropped' in said.out
    assert main(arguments(tmp_path / 'base_link.mcap', model, *more)) == 1
    assert "in frame 'base_link', but the images in 'camera'" in capsys.readouterr().err
    assert asked.pop()[1:] == (None, {name: value for name, value in parameters.items() if name != 'cube_size'}
                               | {'side': 'auto', 'depth_scale': 0.001})


def test_a_bag_without_an_image_that_can_be_decoded_is_not_played(tmp_path, model, monkeypatch, capsys):
    pytest.importorskip('rclpy', reason='ROS is not installed')
    monkeypatch.setattr('hand_pose_ros.ros.live.play_through_node', lambda *_: pytest.fail('it is played'))
    with BagWriter(tmp_path / 'half.mcap') as bag:
        bag.write_depth(10**9, 'camera', depth_image(0)[:120], CAMERA, codec=None)
    assert main(arguments(tmp_path / 'half.mcap', model, '--via-ros')) == 1
    assert 'half.mcap: there is no depth image that can be decoded' in capsys.readouterr().err


def test_a_bag_is_compared_with_an_earlier_result(tmp_path, bag, model, result, monkeypatch, capsys):
    earlier = replace(result, truth=result.predictions - [0.006, 0, 0.008], notes=('it was dark.',))
    earlier.save(tmp_path / 'before.npz')
    replace(earlier, skeleton=replace(HAND21, name='other')).save(tmp_path / 'other.npz')
    np.savez(tmp_path / 'truth.npz', joints=result.predictions)
    reported = []
    monkeypatch.setattr('hand_pose_ros.evaluation.report.write_report',
                        lambda *given: reported.append(given) or 'out/report.html')
    more = ('--ground-truth', tmp_path / 'truth.npz', '--report', tmp_path / 'out', '--compare')
    assert main(arguments(bag, model, *more, tmp_path / 'before.npz')) == 0
    said = capsys.readouterr()
    _, now, before, *latency = said.out.splitlines()
    assert now.split()[:5] == ['ball', '12', '0', '0.000', '0.000']
    assert before.split()[:5] == ['before', '12', '0', '10.000', '10.000']
    assert latency[0].startswith('ball: 12 frames, 100.0 % with a hand, 1 track, ')
    assert sum(line.startswith('total ') for line in latency) == 2 and latency[-1] == 'report: out/report.html'
    assert said.err == 'NOTE: before: it was dark.\n'
    (results, folder, read_depths), = reported
    assert [one.name for one in results] == ['ball', 'before'] and folder == str(tmp_path / 'out')
    assert read_depths([3])[3] == pytest.approx(depth_image(3), abs=1e-3)
    assert main(arguments(bag, model, *more, tmp_path / 'other.npz')) == 1
    assert '--compare: all results must have the joints of hand21' in capsys.readouterr().err
    monkeypatch.setattr(HandPoseEstimator, '__call__', lambda *_, **__: pytest.fail('what is wrong is told first'))
    assert main(arguments(bag, model, *more, tmp_path / 'none.npz')) == 1
    assert 'none.npz: the file cannot be read' in capsys.readouterr().err


def test_the_default_weights_have_one_name_with_and_without_the_node(tmp_path, bag, monkeypatch):
    pytest.importorskip('rclpy', reason='ROS is not installed')
    from hand_pose_ros.ros.live import Answers
    monkeypatch.setattr('hand_pose_ros.ros.live.play_through_node', lambda *_: Answers('hand21', {}, {}))
    for more in ((), ('--via-ros',)):
        assert main(['evaluate', str(bag), '--device', 'cpu', '--json', str(tmp_path / 'r.json'), *more]) == 0
        assert json.loads((tmp_path / 'r.json').read_text())['model'] == 'hand_dense'


def test_bags_of_one_name_get_names_of_their_own():
    bags = ['x.mcap', '../x.mcap', 'a/b/x.mcap', 'a_b/x.mcap', 'y.mcap']
    names = _names(bags)
    assert names['y.mcap'] == 'y' and len(set(names.values())) == len(bags)
