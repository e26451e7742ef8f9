"""What `hand-pose estimate` promises: every usable image answered, in files that hold what the estimator said."""

import os
import shutil
import subprocess
import sys
from itertools import count
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hand_pose_ros.bags import Bag, BagWriter, read_hands
from hand_pose_ros.cli import estimate, main
from hand_pose_ros.drawing import FINGER_COLORS
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.markers import ADD, DELETE, LINE_LIST, SPHERE_LIST
from hand_pose_ros.skeleton import FINGERS, HAND21

CAMERA = Intrinsics(140.0, 140.0, 80.0, 60.0, 160, 120)
INTRINSICS = ['--intrinsics', '140', '140', '80', '60']
STAMPS = [1_700_000_000_000_000_001 + i * 33_000_000 for i in range(6)]


@pytest.fixture(scope='module')
def depths():
    """Something of the size of a hand that comes nearer, before a far wall; whole millimetres, as cameras give them."""
    v, u = np.mgrid[:120, :160]
    images = []
    for i in range(len(STAMPS)):
        z = 700 - 20 * i
        disc = np.hypot(u - 60 - 4 * i, v - 60) < 0.06 * 140 / (z / 1000)
        images.append(np.where(disc, z, 3000).astype(np.uint16) * np.float32(0.001))
    return images


@pytest.fixture
def folder(tmp_path, depths):
    """Names that only sort right as numbers."""
    path = tmp_path / 'frames'
    path.mkdir()
    for i, depth in enumerate(depths):
        cv2.imwrite(str(path / f'{8 + i}.png'), np.rint(depth * 1000).astype(np.uint16))
    return path


@pytest.fixture
def bag(tmp_path, depths):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as writer:
        for stamp, depth in zip(STAMPS, depths, strict=True):
            writer.write_depth(stamp, 'camera_optical', depth, CAMERA)
    return path


@pytest.fixture
def command(weights):
    """Run `hand-pose estimate` with weights that are there; every hand counts, and to them everything is a hand."""
    return lambda *args: main(['estimate', *map(str, args), '--model', str(weights), '--min-score', '0',
                               '--max-hands', '1', '--detector', 'nearest'])


@pytest.fixture
def expected(weights, depths):
    """What the estimator itself says about the sequence."""
    estimator = HandPoseEstimator.from_pretrained(weights, min_score=0, detector='nearest')
    return [estimator(depth, CAMERA) for depth in depths]


def test_pictures_beside_those_of_other_images_are_told(tmp_path, folder, command, capsys):
    pictures = '--overlay', tmp_path / 'new' / 'pictures'
    assert command(folder / '8.png', *INTRINSICS, *pictures) == 0
    assert 'holds pictures already' not in capsys.readouterr().err
    assert command(folder / '9.png', *INTRINSICS, *pictures) == 0
    assert f'NOTE: {pictures[1]} holds pictures already' in capsys.readouterr().err


def test_a_folder_of_pngs_into_arrays_and_pictures(tmp_path, folder, command, expected, capsys):
    assert command(folder, *INTRINSICS, '--out', tmp_path / 'joints.npz', '--overlay', tmp_path / 'pictures') == 0
    result = np.load(tmp_path / 'joints.npz')
    assert result['names'].tolist() == ['8', '9', '10', '11', '12', '13']
    assert result['frame'].tolist() == [i for i, hands in enumerate(expected) for _ in hands] == list(range(6))
    hands = [hand for hands in expected for hand in hands]
    # Not bit by bit: a network that runs on several threads may add up in another order each time.
    np.testing.assert_allclose(result['joints'], [hand.joints for hand in hands], atol=1e-6)
    np.testing.assert_allclose(result['confidence'], [hand.confidence for hand in hands], atol=1e-4)
    np.testing.assert_allclose(result['cube_center'], [hand.cube.center for hand in hands], atol=1e-6)
    np.testing.assert_allclose(result['cube_side'], [hand.cube.side for hand in hands], atol=1e-6)
    np.testing.assert_allclose(result['score'], [hand.score for hand in hands], atol=1e-4)
    assert result['stamp_ns'].tolist() == [33_333_333 * i for i in range(6)], '30 Hz'
    assert result['side'].tolist() == [hand.side for hand in hands] and set(result['id']) == {'hand_1'}
    assert tuple(result['joint_names']) == HAND21.joint_names and str(result['skeleton']) == 'hand21'
    assert sorted(path.stem for path in (tmp_path / 'pictures').iterdir()) == sorted(result['names'])
    for name in result['names']:
        picture = cv2.imread(str(tmp_path / 'pictures' / f'{name}.png'))
        assert any((picture == FINGER_COLORS[finger][::-1]).all(-1).any() for finger in FINGERS), 'joints are drawn'
    said = capsys.readouterr().out
    assert '6 images, 6 with a hand, 0 that could not be used' in said
    assert f'wrote {tmp_path / "joints.npz"} and {tmp_path / "pictures"}' in said


def test_names_of_pngs_may_be_in_capitals_and_hold_any_digit(tmp_path, folder, command):
    (capitals := tmp_path / 'capitals').mkdir()
    for name in ('9', '10', '²1'):
        (capitals / f'{name}.PNG').write_bytes((folder / '9.png').read_bytes())
    for given, names in ((capitals, ['9', '10', '²1']), (capitals / '9.PNG', ['9'])):
        assert command(given, *INTRINSICS, '--out', tmp_path / 'joints.npz') == 0
        assert np.load(tmp_path / 'joints.npz')['names'].tolist() == names


def test_a_bag_into_a_bag(tmp_path, bag, command, expected):
    assert command(bag, '--out', tmp_path / 'joints.mcap', '--overlay', tmp_path / 'pictures') == 0
    assert sorted(path.name for path in (tmp_path / 'pictures').iterdir()) == [f'{i:06d}.png' for i in range(6)]
    recorded = read_hands(tmp_path / 'joints.mcap')
    assert [record.stamp_ns for record in recorded] == STAMPS
    assert {record.frame_id for record in recorded} == {'camera_optical'}
    for record, hands in zip(recorded, expected, strict=True):
        np.testing.assert_allclose(record.joints, [hand.joints for hand in hands], atol=1e-6)
    with Bag(tmp_path / 'joints.mcap') as result:
        counts = {connection.topic: connection.msgcount for connection in result.connections}
    assert counts['/hand/joints'] == 6 and counts['/hand/skeleton'] == 1


def test_as_many_hands_of_an_image_as_are_asked_for(tmp_path, weights, capsys):
    v, u = np.mgrid[:120, :160]
    discs = np.minimum(np.hypot(u - 30, v - 60), np.hypot(u - 130, v - 60)) < 12
    cv2.imwrite(str(tmp_path / '0.png'), np.where(discs, 700, 3000).astype(np.uint16))
    for number in 1, 2:
        assert main(['estimate', str(tmp_path / '0.png'), *INTRINSICS, '--out', str(tmp_path / 'joints.npz'), '--model',
                     str(weights), '--min-score', '0', '--detector', 'nearest', '--max-hands', str(number)]) == 0
        assert np.load(tmp_path / 'joints.npz')['frame'].tolist() == [0] * number
        assert '1 image, 1 with a hand' in capsys.readouterr().out


def test_what_is_said_of_hand_and_camera_is_taken(tmp_path, depths, command):
    other = Intrinsics(200.0, 200.0, 70.0, 50.0, 160, 120)
    with BagWriter(tmp_path / 'two.mcap') as writer:
        for name, camera in (('a', CAMERA), ('b', other)):
            writer.write_depth(STAMPS[0], 'camera', depths[0], camera, topic=f'/{name}/depth', codec=None)
    results = []
    for camera in (('--camera-info-topic', '/b/camera_info'), ('--intrinsics', '200', '200', '70', '50'), ()):
        assert command(tmp_path / 'two.mcap', '--depth-topic', '/a/depth', *camera, '--side', 'left', '--cube-size',
                       '0.2', '--out', tmp_path / 'joints.npz') == 0
        results.append(dict(np.load(tmp_path / 'joints.npz')))
    topic, numbers, own = results
    np.testing.assert_allclose(topic['joints'], numbers['joints'], atol=1e-6)
    assert np.abs(topic['joints'] - own['joints']).max() > 0.01
    assert own['side'].tolist() == ['left'] and own['cube_side'] == pytest.approx([0.2])


@pytest.mark.parametrize('verb', [('estimate', '--out'), ('evaluate', '--out-bag')])
def test_hands_are_recorded_when_their_image_was(tmp_path, depths, weights, verb):
    """So that they play beside it, whatever the stamps are: some drivers leave them 0."""
    with BagWriter(tmp_path / 'stamped.mcap') as writer:
        writer.write_depth(0, 'camera', depths[0], CAMERA)
    with Bag(tmp_path / 'stamped.mcap') as source, BagWriter(tmp_path / 'bag.mcap') as writer:
        for stamp in STAMPS:
            for connection, _, data in source.messages(source.connections):
                writer.write_serialized(connection.topic, connection.msgtype, data, stamp)
    bag, out = str(tmp_path / 'bag.mcap'), str(tmp_path / 'out.mcap')
    assert main([verb[0], bag, '--model', str(weights), verb[1], out]) == 0
    assert [record.stamp_ns for record in read_hands(tmp_path / 'out.mcap')] == [0] * len(STAMPS)
    with Bag(tmp_path / 'out.mcap') as result:
        times = {(c.topic, time_ns) for c, time_ns, _ in result.messages(result.connections)}
    assert times == {('/hand/skeleton', STAMPS[0]), *((f'/hand/{name}', stamp) for name in ('joints', 'markers')
                                                      for stamp in STAMPS)}


def test_markers_are_in_the_bag_without_ros(tmp_path, depths, weights, monkeypatch):
    for name in ('rclpy', 'visualization_msgs', 'hand_pose_ros.msg', 'hand_pose_ros.ros'):
        monkeypatch.setitem(sys.modules, name, None)  # importing it fails
    with BagWriter(tmp_path / 'some.mcap') as writer:
        for stamp, depth in zip(STAMPS, [*depths[:2], np.full_like(depths[0], 3)], strict=False):
            writer.write_depth(stamp, 'camera_optical', depth, CAMERA)
    out = tmp_path / 'joints.mcap'
    assert main(['estimate', str(tmp_path / 'some.mcap'), '--model', str(weights), '--min-score', '0', '--out',
                 str(out)]) == 0
    with Bag(out) as result:
        [connection] = [c for c in result.connections if c.topic == '/hand/markers']
        assert connection.msgtype == 'visualization_msgs/msg/MarkerArray'
        first, second, third = (result.deserialize(connection, data).markers
                                for _, _, data in result.messages([connection]))
    parts = {'hand_1/joints': (SPHERE_LIST, 21), 'hand_1/bones': (LINE_LIST, 40), 'hand_1/cube': (LINE_LIST, 24)}
    for markers in (first, second):
        assert {m.ns: (m.type, len(m.points)) for m in markers} == parts
        assert all(m.action == ADD and len(m.colors) == len(m.points) and m.pose.orientation.w == 1 and
                   m.header.frame_id == 'camera_optical' for m in markers)
    assert {m.ns for m in third} == set(parts) and all(m.action == DELETE for m in third)
    [joints] = [m for m in first if m.ns == 'hand_1/joints']
    np.testing.assert_array_equal([(p.x, p.y, p.z) for p in joints.points], read_hands(out)[0].joints[0])
    assert joints.scale.x == joints.scale.z > 0
    tip, color = HAND21.joint_names.index('ring_tip'), np.array(FINGER_COLORS['ring']) / 255
    np.testing.assert_allclose((joints.colors[tip].r, joints.colors[tip].g, joints.colors[tip].b), color, atol=1e-6)


def test_images_without_a_hand_are_answered_too(tmp_path, bag, weights, capsys):
    args = ['estimate', str(bag), '--model', str(weights), '--min-score', '1']
    assert main([*args, '--out', str(tmp_path / 'a.mcap')]) == main([*args, '--out', str(tmp_path / 'a.npz')]) == 0
    assert 'nothing had a score of 1 or more, which networks' in capsys.readouterr().err
    assert main([*args, '--side', 'left', '--out', str(tmp_path / 'a.npz')]) == 0
    said = capsys.readouterr().err
    assert 'as a left hand: if it may be the other hand, leave out --side; --min-score 0 shows' in said
    assert [len(record.joints) for record in read_hands(tmp_path / 'a.mcap')] == [0] * 6
    result = np.load(tmp_path / 'a.npz')
    assert result['joints'].shape == (0, 21, 3) and result['stamp_ns'].tolist() == STAMPS


def test_a_bad_file_is_reported_and_the_rest_goes_on(tmp_path, folder, command, capsys):
    cv2.imwrite(str(folder / '9.png'), np.zeros((120, 160), np.uint8))
    (folder / '11.png').write_text('no picture')
    cv2.imwrite(str(folder / '12.png'), np.full((120, 160), 3000, np.uint16))  # no hand
    assert command(folder, *INTRINSICS, '--out', tmp_path / 'joints.npz') == 1
    assert np.load(tmp_path / 'joints.npz')['names'].tolist() == ['8', '10', '12', '13']
    said = capsys.readouterr()
    assert '9.png: the PNG has 8 bits' in said.err and '11.png: ' in said.err
    assert '4 images, 3 with a hand, 2 that could not be used' in said.out
    assert 'nothing had a score' not in said.err and 'of the depth is' not in said.err, 'there are hands'


@pytest.mark.skipif(not os.path.exists('/dev/full'), reason='only Linux has /dev/full')
@pytest.mark.parametrize('name', ['joints.npz', 'joints.mcap'])
def test_a_summary_that_cannot_be_printed_loses_no_joints(name, tmp_path, folder, command, monkeypatch):
    with open('/dev/full', 'w', buffering=1) as full:  # each line at once, as with PYTHONUNBUFFERED
        monkeypatch.setattr(sys, 'stdout', full)
        assert command(folder / '8.png', *INTRINSICS, '--out', tmp_path / name) == 1
    assert (tmp_path / name).stat().st_size


def test_what_comes_before_the_damage_of_a_bag_counts(tmp_path, bag, command, capsys):
    with BagWriter(tmp_path / 'long.mcap') as writer:
        noise = np.random.default_rng(0).integers(500, 4000, (120, 160), np.uint16) * np.float32(0.001)
        for i in range(60):
            writer.write_depth(STAMPS[0] + i, 'camera', noise, CAMERA, codec=None)
    data = (tmp_path / 'long.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(data[:int(len(data) * 0.9)])
    assert command(tmp_path / 'cut.mcap', '--out', tmp_path / 'joints.npz') == 1
    assert 0 < len(np.load(tmp_path / 'joints.npz')['names']) < 60
    assert 'cut.mcap: the bag was cut short' in capsys.readouterr().err


def test_the_folder_of_a_bag_may_lack_its_metadata(tmp_path, bag, command, capsys):
    (tmp_path / 'recording').mkdir()
    shutil.copy(bag, tmp_path / 'recording' / 'recording_0.mcap')
    assert command(tmp_path / 'recording', '--out', tmp_path / 'joints.npz') == 0
    (tmp_path / 'empty').mkdir()
    assert command(tmp_path / 'empty', '--out', tmp_path / 'never.npz') == 1
    assert 'neither 16-bit depth .png files nor a bag' in capsys.readouterr().err
    for name, told in (('metadata.yaml', ''), ('recording_0.db3', '/recording_0.db3')):  # also what is damaged is a bag
        (damaged := tmp_path / f'with {name}').mkdir()
        (damaged / name).write_text('x')
        assert command(damaged, '--out', tmp_path / 'never.npz') == 1
        assert f'{damaged}{told}: the bag cannot be opened' in capsys.readouterr().err


def test_nothing_usable_writes_nothing(tmp_path, command, capsys):
    (tmp_path / 'frames').mkdir()
    (tmp_path / 'frames/0.png').write_text('no picture')
    assert command(tmp_path / 'frames', *INTRINSICS, '--out', tmp_path / 'joints.mcap') == 1
    assert not (tmp_path / 'joints.mcap').exists()
    assert 'none of the images (1) could be used' in capsys.readouterr().err


@pytest.mark.parametrize('args', [
    ('--out', 'joints.npz'), INTRINSICS, (*INTRINSICS, '--out', 'joints.csv'), ('--intrinsics', '1', '2', '3'),
    *((*INTRINSICS, '--out', 'joints.npz', name, value) for name, value in (
        ('--max-hands', '0'), ('--min-score', '7'), ('--min-score', '-1'), ('--cube-size', '300'),
        ('--cube-size', '-0.3'), ('--depth-scale', '-0.001'), ('--depth-scale', '0'),
        ('--depth-scale', '1000'), ('--detector', 'nose')))])
def test_bad_arguments_exit_with_2(folder, command, args):
    with pytest.raises(SystemExit) as leaving:
        command(folder, *args)
    assert leaving.value.code == 2


def test_what_is_wrong_with_several_images_is_said_once(tmp_path, command, capsys):
    with BagWriter(tmp_path / 'bag.mcap') as writer:
        for i, stamp in enumerate(STAMPS):
            writer.write_depth(stamp, 'camera', np.ones((120 - 60 * (i // 3), 160), np.float32),
                               Intrinsics(140, 140, 8000, 60, 160, 120))
    assert command(tmp_path / 'bag.mcap', '--out', tmp_path / 'joints.npz') == 1
    said = capsys.readouterr().err
    assert said.count('those of no camera') == said.count('the depth image has 160x60 pixels') == 1
    assert f'none of the images ({len(STAMPS)})' in said


def test_the_time_of_the_median_image_is_told(bag, tmp_path, command, capsys, monkeypatch):
    monkeypatch.setattr(estimate, 'time', SimpleNamespace(perf_counter=count(0, 0.25).__next__))
    assert command(bag, '--out', tmp_path / 'joints.npz') == 0
    assert '; 250.0 ms for the median image' in capsys.readouterr().out


def test_intrinsics_that_cannot_be_are_refused_at_once(folder, tmp_path, command, capsys):
    assert command(folder, '--intrinsics', 0, 140, 80, 60, '--out', tmp_path / 'joints.npz') == 1
    said = capsys.readouterr().err
    assert '--intrinsics: ' in said and 'must be positive' in said


def test_where_nothing_can_be_written_is_said_at_once(tmp_path, folder, command, capsys, monkeypatch):
    monkeypatch.setattr(estimate, 'estimate', lambda *arguments: pytest.fail('it began'))
    (tmp_path / 'file').write_text('')
    for name in 'joints.npz', 'joints.mcap':
        assert command(folder, *INTRINSICS, '--out', tmp_path / 'file' / name) == 1
        assert f'{tmp_path / "file"}' in capsys.readouterr().err
    assert command(folder, *INTRINSICS, '--overlay', tmp_path / 'file') == 1
    assert f'{tmp_path / "file"}: File exists, and a folder is needed: give another name' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['missing.mcap', 'missing.png', 'missing'])
def test_a_missing_input_exits_with_1_and_names_it(tmp_path, command, capsys, name):
    assert command(tmp_path / name, '--overlay', tmp_path / 'pictures') == 1
    assert f'{tmp_path / name}: there is no such bag, PNG or folder' in capsys.readouterr().err
    assert not (tmp_path / 'pictures').exists()


def test_the_wrong_unit_of_depth_is_named(tmp_path, folder, command, capsys):
    out = ('--out', tmp_path / 'joints.npz', '--min-score', '1')
    assert command(folder, *INTRINSICS, *out, '--depth-scale', '0.1') == 0
    said = capsys.readouterr().err
    assert '100% of the depth is outside 0.1 to 1.5 m' in said and 'check depth_scale' in said
    assert command(folder, *INTRINSICS, *out) == 0
    assert 'depth_scale' not in capsys.readouterr().err


def test_depth_scale_and_real_frames(tmp_path, shared_data, command):
    args = ('--intrinsics', 476.007, 476.007, 313.683, 242.755, '--depth-scale', 0.000125, '--out', tmp_path / 'a.npz')
    assert command(shared_data / 'frames/sr305/20210326-230536', *args) == 0
    result = np.load(tmp_path / 'a.npz')
    assert result['names'].tolist() == ['30', '50', '70', '90', '110', '130', '150', '170']
    assert ((result['cube_center'][:, 2] > 0.4) & (result['cube_center'][:, 2] < 0.7)).all()


def test_nothing_is_added_to_the_folder_of_an_interrupted_recording(bag, tmp_path, command, capsys):
    (folder := tmp_path / 'recording').mkdir()
    shutil.copy(bag, folder / 'recording_0.mcap')  # and no metadata.yaml
    assert command(folder, '--out', folder / 'joints.mcap') == 1
    assert 'joints.mcap: this is the input, which would be lost' in capsys.readouterr().err
    assert command(folder, '--out', folder / 'joints.npz') == 0


def test_another_recording_is_not_replaced(bag, tmp_path, command, capsys):
    other = tmp_path / 'other.mcap'
    shutil.copy(bag, other)
    assert command(bag, '--out', other) == 1
    assert 'other.mcap: this is a recording of /' in capsys.readouterr().err
    assert other.read_bytes() == bag.read_bytes()
    assert [command(bag, '--out', tmp_path / 'hands.mcap') for _ in range(2)] == [0, 0]
    os.mkfifo(tmp_path / 'fifo.mcap')  # nobody writes to it: who reads it waits for ever
    assert command(bag, '--out', tmp_path / 'fifo.mcap') == 1
    assert 'fifo.mcap: there is something already' in capsys.readouterr().err


def test_topics_are_for_bags(folder, command, capsys):
    with pytest.raises(SystemExit):
        command(folder, *INTRINSICS, '--depth-topic', '/depth', '--out', folder / 'x.npz')
    assert '--depth-topic is for bags: PNGs have no topics' in capsys.readouterr().err


def test_sigterm_leaves_nothing_half_made(bag, tmp_path, weights):
    out = tmp_path / 'out'
    out.mkdir()
    code = """
import os, signal, sys
from hand_pose_ros.cli import estimate, main
add = estimate.HandBag.add
def stopped(*arguments):
    add(*arguments)
    os.kill(os.getpid(), signal.SIGTERM)
estimate.HandBag.add = stopped
sys.exit(main(sys.argv[1:]))"""
    done = subprocess.run([sys.executable, '-c', code, 'estimate', str(bag), '--model', str(weights), '--out',
                           str(out / 'x.mcap')], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and 'estimate: interrupted' in done.stderr
    assert not list(out.iterdir())


@pytest.mark.parametrize('kind', ['bag', 'folder', 'png'])
def test_what_is_read_is_not_written_over(kind, bag, folder, command, capsys):
    before = {path: path.read_bytes() for path in (bag, *folder.iterdir())}
    output = {'bag': (bag, '--out', bag), 'folder': (folder, *INTRINSICS, '--overlay', folder),
              'png': (folder / '8.png', *INTRINSICS, '--overlay', folder)}[kind]
    assert command(*output) == 1
    assert 'this is the input, which would be lost' in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in (bag, *folder.iterdir())}


@pytest.mark.parametrize('link', [os.symlink, os.link])
def test_pngs_behind_links_are_not_replaced_by_pictures(link, folder, tmp_path, command, capsys):
    (tmp_path / 'chosen').mkdir()
    link(folder / '9.png', tmp_path / 'chosen' / '9.png')
    before = (folder / '9.png').read_bytes()
    assert command(tmp_path / 'chosen', *INTRINSICS, '--overlay', folder) == 1
    assert (folder / '9.png').read_bytes() == before
    assert f'{folder}/9.png: this is the input, which would be lost' in capsys.readouterr().err


def test_names_need_not_be_utf_8(bag, tmp_path, weights):
    folder = tmp_path / os.fsdecode(b'\xff')
    bag = bag.rename(tmp_path / os.fsdecode(b'\xff.mcap'))
    for outputs in (['estimate', '--overlay', folder, '--out', folder / 'joints.npz'],
                    ['evaluate', '--report', folder / 'report']):
        done = subprocess.run([sys.executable, '-m', 'hand_pose_ros.cli', outputs[0], bag, *outputs[1:], '--model',
                               weights, '--min-score', '0'], capture_output=True, text=True,
                              env=os.environ | {'PYTHONIOENCODING': 'utf-8:strict'})
        assert done.returncode == 0, done.stderr
        assert '\\udcff' in done.stdout
    assert (folder / '000000.png').is_file() and (folder / 'report' / 'report.html').is_file()
