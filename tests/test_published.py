"""Published results: the numbers of the field come out exactly, and files that do not fit are refused with a reason."""

import gzip
import json
import os
import subprocess
import sys
from contextlib import suppress

import cv2
import numpy as np
import pytest

from hand_pose_ros.cli import main
from hand_pose_ros.datasets.nyu import PALM
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.evaluation import tompson
from hand_pose_ros.evaluation.published import DATASETS, load_published, load_result, read_text
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import SKELETONS

NYU, ICVL = DATASETS['nyu'], DATASETS['icvl']

# mean, median, max, mean of the worst joints in mm; frames within 20, 30, 40, 50, 80 mm in per cent.
KNOWN = {
    'nyu/DeepPrior': (20.750, 14.854, 169.0, 44.781, 16.27, 36.22, 49.24, 62.08, 91.19),
    'nyu/DeepPrior-ORRef': (19.726, 12.882, 194.4, 44.708, 23.65, 39.57, 52.02, 62.60, 88.15),
    'nyu/DeepModel': (17.036, 12.209, 147.9, 39.576, 18.97, 41.93, 58.20, 71.78, 95.07),
    'nyu/DeepPriorPP': (12.238, 9.031, 135.5, 26.544, 44.72, 70.31, 83.53, 90.97, 97.95),
    'icvl/LRF': (12.578, 9.561, 106.1, 33.736, 20.74, 50.38, 70.86, 85.78, 97.49),
    'icvl/DeepPrior': (10.427, 8.152, 89.2, 24.005, 47.44, 72.93, 87.61, 94.30, 99.00),
    'icvl/DeepPrior-ORRef': (9.426, 7.572, 89.1, 22.217, 57.69, 79.34, 90.46, 94.87, 98.58),
}
SUBJECTS = {'nyu/DeepPrior': (12.067, 24.395), 'nyu/DeepPrior-ORRef': (10.201, 23.724),
            'nyu/DeepModel': (10.154, 19.925), 'nyu/DeepPriorPP': (6.930, 14.467), 'icvl/LRF': (12.629, 12.537)}


@pytest.mark.parametrize('name', KNOWN)
def test_published_results_give_the_published_numbers(shared_data, tmp_path, name, capsys):
    folder, dataset = shared_data / 'published', name.split('/')[0]
    code = main(['evaluate', '--predictions', str(folder / f'{name}.txt.gz'), '--dataset', dataset,
                 '--ground-truth', str(folder / dataset / 'groundtruth.txt.gz'), '--json', str(tmp_path / 'r.json')])
    assert code == 0
    got = json.loads((tmp_path / 'r.json').read_text())
    mean, median, largest, worst, *within = KNOWN[name]
    assert got['mean_mm'] == pytest.approx(mean, abs=6e-4) and got['median_mm'] == pytest.approx(median, abs=6e-4)
    assert got['max_mm'] == pytest.approx(largest, abs=0.06) and got['mean_worst_mm'] == pytest.approx(worst, abs=6e-4)
    assert [100 * got['within_mm'][d] for d in ('20', '30', '40', '50', '80')] == pytest.approx(within, abs=6e-3)
    parts = [part['mean_mm'] for part in got.get('parts', {}).values()]
    assert parts == pytest.approx(list(SUBJECTS.get(name, ())), abs=6e-4)
    assert set(got['per_joint_mm']) == set(DATASETS[dataset].skeleton.joint_names)
    assert f'{mean:.3f}' in capsys.readouterr().out


def test_other_intrinsics_shift_the_mean_as_they_should(shared_data, tmp_path):
    folder = shared_data / 'published' / 'icvl'
    assert main(['evaluate', '--predictions', str(folder / 'LRF.txt.gz'), '--dataset', 'icvl', '--ground-truth',
                 str(folder / 'groundtruth.txt.gz'), '--intrinsics', '241.42', '241.42', '160', '120',
                 '--json', str(tmp_path / 'r.json')]) == 0
    assert json.loads((tmp_path / 'r.json').read_text())['mean_mm'] == pytest.approx(12.564, abs=6e-4)


def test_a_file_of_one_sequence_is_matched_to_it_and_says_so(shared_data, capsys):
    folder = shared_data / 'published' / 'icvl'
    whole = load_published(folder / 'DeepPrior.txt.gz', folder / 'groundtruth.txt.gz', ICVL)
    assert len(whole.predictions) == 702 and 'sequence 1' in whole.notes[0]
    assert 'rows 1-702 of groundtruth.txt.gz; the other 894' in whole.notes[0]
    assert whole.name == 'DeepPrior' and whole.info == {
        'predictions': str(folder / 'DeepPrior.txt.gz'), 'ground_truth': str(folder / 'groundtruth.txt.gz'),
        'dataset': 'icvl', 'intrinsics': 'fx 240.99, fy 240.96, cx 160, cy 120'}
    main(['evaluate', '--predictions', str(folder / 'DeepPrior.txt.gz'), '--dataset', 'icvl',
          '--ground-truth', str(folder / 'groundtruth.txt.gz')])
    assert 'NOTE: DeepPrior.txt.gz has 702 frames, as many as sequence 1' in capsys.readouterr().err
    exact = load_published(folder / 'DeepPrior.txt.gz', folder / 'test_seq_1.txt.gz', ICVL)
    assert not exact.notes and np.array_equal(exact.truth, whole.truth) and exact.in_time
    second = load_published(folder / 'LRF.txt.gz', folder / 'test_seq_2.txt.gz', ICVL)
    assert second.summary()['mean_mm'] == pytest.approx(12.537, abs=6e-4), 'the truth may be the shorter one'
    assert 'test_seq_2.txt.gz has 894 frames' in second.notes[0] and 'rows 703-1596 of LRF.txt.gz' in second.notes[0]
    with pytest.raises(InputError, match=r'702 frames but .* 894'):
        load_published(folder / 'DeepPrior.txt.gz', folder / 'test_seq_2.txt.gz', ICVL)


def write_uvd(path, uvd, names=None):
    lines = [' '.join(f'{x:.3f}' for x in frame.ravel()) for frame in uvd]
    text = '\n'.join(f'{name} {line}' for name, line in zip(names, lines, strict=True)) if names else '\n'.join(lines)
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == '.gz' else text.encode())
    return path


@pytest.fixture
def uvd():
    rng = np.random.default_rng(0)
    return np.concatenate([rng.uniform(100, 300, (5, 14, 2)), rng.uniform(400, 900, (5, 14, 1))], axis=-1)


@pytest.mark.parametrize('suffix', ['.txt', '.txt.gz'])
@pytest.mark.parametrize('named', [False, True])
def test_text_files_are_read_in_every_form(tmp_path, uvd, suffix, named):
    names = [f'seq/image_{k}.png' for k in range(5)] if named else None
    labels = read_text(write_uvd(tmp_path / f'p{suffix}', uvd, names), NYU.skeleton)
    assert labels.uvd == pytest.approx(uvd, abs=1e-3) and labels.names == tuple(names or ())
    points = labels.points(NYU.intrinsics)
    assert NYU.intrinsics.project(points) == pytest.approx(uvd[..., :2], abs=1e-3)
    assert points[..., 2] == pytest.approx(uvd[..., 2] / 1000, abs=1e-6)


def test_nan_and_zero_joints_are_missing(tmp_path, uvd):
    broken = uvd.copy()
    broken[0, 3], broken[1, 0, 0], broken[2], broken[4, 1] = 0, np.inf, np.nan, 0
    uvd[4, 1] = 0  # is not labelled either
    result = load_published(write_uvd(tmp_path / 'p.txt', broken), write_uvd(tmp_path / 'g.txt', uvd), NYU)
    summary = result.summary()
    assert '16 joints are missing in p.txt' in result.notes[0]
    assert (summary['missed_frames'], summary['missed_joints'], summary['frames']) == (1, 16, 5)
    assert summary['mean_mm'] == pytest.approx(0, abs=1e-6), 'what was predicted is right'
    assert summary['within_mm']['80'] == pytest.approx(2 / 5) and summary['detection_rate'] == pytest.approx(4 / 5)


def test_the_table_can_be_written_where_there_are_no_signs_but_ascii(tmp_path, uvd):
    for name in ('p.txt', 'g.txt'):
        write_uvd(tmp_path / name, uvd)
    done = subprocess.run([sys.executable, '-m', 'hand_pose_ros.cli', 'evaluate', '--predictions', tmp_path / 'p.txt',
                           '--ground-truth', tmp_path / 'g.txt', '--dataset', 'nyu'],
                          env=os.environ | {'PYTHONIOENCODING': 'ascii'}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert '<=20' in done.stdout


def test_predictions_are_compared_with_others_of_their_dataset(tmp_path, uvd, monkeypatch, capsys):
    for name, moved in (('p', 0), ('q', 10), ('g', 0)):
        write_uvd(tmp_path / f'{name}.txt', uvd + np.array([0, 0, moved]))
    arguments = ['evaluate', '--predictions', str(tmp_path / 'p.txt'), '--ground-truth', str(tmp_path / 'g.txt'),
                 '--dataset', 'nyu', '--compare', f'near={tmp_path / "q.txt"}']
    assert main(arguments) == 0
    _, own, other = capsys.readouterr().out.splitlines()
    assert own.split()[:4] == ['p', '5', '0', '0.000'] and other.split()[:3] == ['near', '5', '0']
    assert 10 < float(other.split()[3]) < 12

    def full(_):
        raise OSError('No space left on device')

    monkeypatch.setattr(sys.stdout, 'write', full)
    assert main([*arguments, '--json', str(tmp_path / 'r.json'), '--out', str(tmp_path / 'r.npz')]) == 1
    assert (tmp_path / 'r.json').exists() and Result.load(tmp_path / 'r.npz'), 'printing may fail, and comes last'
    with pytest.raises(SystemExit):
        main([*arguments[:3], *arguments[5:]])
    assert '--predictions needs --ground-truth and --dataset' in capsys.readouterr().err


def test_names_on_both_sides_decide_what_belongs_together(tmp_path, uvd):
    names = [f'{k}.png' for k in range(5)]
    truth = write_uvd(tmp_path / 'g.txt', uvd, names)
    shuffled = write_uvd(tmp_path / 'p.txt', uvd[[3, 0, 1]], ['3.png', '0.png', '1.png'])
    result = load_published(shuffled, truth, NYU)
    assert result.summary()['max_mm'] == pytest.approx(0, abs=1e-6) and '3 of the 5 frames' in result.notes[0]
    # Rows are those of the dataset, in its order, and what has gaps tells nothing of jitter.
    np.testing.assert_allclose(result.truth, load_published(truth, truth, NYU).truth[[0, 1, 3]])
    assert result.summary()['jitter_mm'] is None
    backwards = load_published(write_uvd(tmp_path / 'b.txt', uvd[::-1], names[::-1]), truth, NYU)
    np.testing.assert_allclose(backwards.predictions, load_published(truth, truth, NYU).predictions)
    assert backwards.in_time and not backwards.notes
    with pytest.raises(InputError, match=r"'9\.png' is not in"):
        load_published(write_uvd(tmp_path / 'q.txt', uvd[:1], ['9.png']), truth, NYU)
    twice = write_uvd(tmp_path / 'q.txt', uvd[:3], ['0.png', '1.png', '1.png'])
    for both in (twice, truth), (truth, twice):
        with pytest.raises(InputError, match=r"q\.txt: the file name '1\.png' stands on two lines"):
            load_published(*both, NYU)


@pytest.mark.parametrize(('change', 'message'), [
    (lambda lines: [lines[0], f'1 {lines[1]}', *lines[2:]], 'line 2 has 43 numbers, but the 14 joints of nyu14'),
    (lambda lines: [lines[0], lines[1].replace(' ', ' 1,5 ', 1), *lines[2:]], 'line 2 has 43 numbers'),
    (lambda lines: [*lines[:4], lines[4].rpartition(' ')[0] + ' 1,5'], "line 5 has '1,5' where a number belongs"),
    (lambda lines: [line.replace(' ', ',') for line in lines], 'line 1 has 0 numbers.*with blanks between them'),
    (lambda lines: ['', ''], 'no line with joints in it: give'),
    (lambda lines: [f'a.png {lines[0]}', *lines[1:]], '1 of 5 lines begin with a file name'),
])
def test_bad_lines_are_named(tmp_path, uvd, change, message):
    path = write_uvd(tmp_path / 'p.txt', uvd)
    path.write_text('\n'.join(change(path.read_text().splitlines())))
    with pytest.raises(InputError, match=message):
        read_text(path, NYU.skeleton)


def test_wrong_counts_joints_and_units_are_refused(tmp_path, uvd, capsys):
    truth = write_uvd(tmp_path / 'g.txt', uvd)
    with pytest.raises(InputError, match=r'4 frames but .* has 5.*2440 \(subject 1\)'):
        load_published(write_uvd(tmp_path / 'p.txt', uvd[:4]), truth, NYU)
    many = np.tile(uvd, (1, 2, 1))[:, :21]
    with pytest.raises(InputError, match=r'give files of the same length$'):  # MSRA has no parts
        load_published(write_uvd(tmp_path / 'p.txt', many[:4]), write_uvd(tmp_path / 'q.txt', many), DATASETS['msra'])
    with pytest.raises(InputError, match='line 1 has 42 numbers, but the 16 joints of icvl16'):
        read_text(truth, ICVL.skeleton)
    with pytest.raises(InputError, match='looks like metres'):
        read_text(write_uvd(tmp_path / 'm.txt', uvd / [1, 1, 1000]), NYU.skeleton)
    few = np.where(np.arange(14)[:, None] < 3, uvd, 0)
    assert read_text(write_uvd(tmp_path / 'few.txt', few), NYU.skeleton).uvd.shape == (5, 14, 3), 'few joints are known'
    whole = gzip.compress(truth.read_bytes())
    for damaged in whole[:-20], whole[:40] + b'damage' + whole[46:], b'\x93NUMPY':
        (tmp_path / 'damaged.txt').write_bytes(damaged)
        with pytest.raises(InputError, match=r'damaged\.txt: this is not text, or a gzip file that was cut short'):
            read_text(tmp_path / 'damaged.txt', NYU.skeleton)
    arguments = ['evaluate', '--predictions', str(tmp_path / 'none.txt'), '--ground-truth', str(truth)]
    assert main([*arguments, '--dataset', 'nyu']) == 1
    assert 'none.txt' in capsys.readouterr().err
    arguments[2] = str(truth)
    assert main([*arguments, '--dataset', 'nyu', '--depth-folder', str(tmp_path)]) == 1
    assert 'all 8252 test frames of NYU' in (said := capsys.readouterr().err) and 'have 5 in common' in said
    for wrong in ([], arguments, [*arguments, '--dataset', 'mano'], ['bag', *arguments]):
        with pytest.raises(SystemExit) as caught:
            main(['evaluate', *wrong[1:]])
        assert caught.value.code == 2


def test_2d_joints_that_are_not_there_are_told_apart_from_a_file_of_another_kind(tmp_path, capsys):
    arguments = ['evaluate', '--predictions', str(tmp_path / 'p.npz'), '--ground-truth', 'truth.txt',
                 '--dataset', 'nyu']
    assert main([*arguments, '--depth-folder', str(tmp_path)]) == 1
    assert 'p.npz: the file cannot be read (No such file or directory)' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(arguments)
    assert 'p.npz: an .npz file holds 2D joints, which need --depth-folder' in capsys.readouterr().err


def test_tompson_protocol_on_the_frame_that_is_there(shared_data, tmp_path):
    folder, results = shared_data / 'published' / 'nyu', {}
    for protocol in ('paper', 'code'):
        result = results[protocol] = tompson.load_tompson(
            folder / 'Tompson_2d.npz', folder / 'groundtruth.txt.gz', shared_data / 'frames' / 'nyu', NYU, protocol)
        assert result.summary()['frames'] == 1 and '1 of 8252 frames' in result.notes[1]
    paper, code = results['paper'].errors_mm[0], results['code'].errors_mm[0]
    beside = paper > 100  # two finger tips are read beside the hand
    assert np.flatnonzero(beside).tolist() == [0, 6]
    assert paper[~beside] == pytest.approx(code[~beside]) and code.max() < 30


def test_the_cube_of_the_second_subject_is_smaller(shared_data, tmp_path):
    for row in (2439, 2440):  # the last of the first subject, the first of the second; nothing is measured
        cv2.imwrite(str(tmp_path / f'depth_1_{row + 1:07d}.png'), np.zeros((480, 640, 3), np.uint8))
    folder = shared_data / 'published' / 'nyu'
    result = tompson.load_tompson(folder / 'Tompson_2d.npz', folder / 'groundtruth.txt.gz', tmp_path, NYU)
    behind = result.predictions[..., 2] - result.truth[:, PALM, None, 2]
    assert behind[2439] == pytest.approx(0.300 / 2) and behind[2440] == pytest.approx(0.249 / 2)
    assert list(result.summary()['parts']) == ['subject 1', 'subject 2']


def test_what_cannot_be_lifted_is_refused(shared_data, tmp_path):
    folder = shared_data / 'published' / 'nyu'
    truth, whole = folder / 'groundtruth.txt.gz', (folder / 'Tompson_2d.npz').read_bytes()
    (tmp_path / 'cut.npz').write_bytes(whole[:len(whole) // 2])
    np.savez(tmp_path / 'other.npz', joints=np.zeros(3))
    np.savez(tmp_path / 'few.npz', uv=np.zeros((5, 14, 2)))
    for name, message in (('cut.npz', 'not an .npz file with 2D joints'), ('other.npz', 'not an .npz file with 2D'),
                          ('few.npz', r'2D joints of shape \(5, 14, 2\)')):
        with pytest.raises(InputError, match=message):
            tompson.load_tompson(tmp_path / name, truth, tmp_path, NYU)
    with pytest.raises(InputError, match=r'none of depth_1_0000001\.png'):
        tompson.load_tompson(folder / 'Tompson_2d.npz', truth, tmp_path, NYU)


def test_lifting_a_hand_worked_case():
    camera = Intrinsics(100, 100, 10, 10, 30, 20)
    depth = np.zeros((20, 30), np.float32)
    depth[10, 10], depth[10, 15], depth[5, 10] = 0.6, 0.82, 0.3  # the hand, what is just behind, something before
    depth[0, 0] = 0.7
    pixels = np.array([[10.4, 9.6], [15, 10], [10, 5], [2, 2], [30, 3], [3, 20], [0, 0]])
    truth = np.array([0.61, 0.79, 0.63, 0.64, 0.65, 0.66, 0.67])
    paper = tompson.lift(pixels, depth, camera, 0.65, 0.3, truth, 'paper')
    assert paper[:, 2] == pytest.approx([0.6, 0.8, 0.8, 0.8, 0.8, 0.8, 0.7]), 'the back face of the cube is at 0.8 m'
    code = tompson.lift(pixels, depth, camera, 0.65, 0.3, truth, 'code')
    assert code[:, 2] == pytest.approx([0.6, 0.79, 0.63, 0.64, 0.65, 0.66, 0.7])
    assert camera.project(paper) == pytest.approx(pixels)


def test_nyu_depth_is_written_in_green_and_blue(tmp_path):
    picture = np.zeros((480, 640, 3), np.uint8)
    picture[0, 0] = 0x21, 0x03, 0  # B, G, R: 0x0321 = 801 mm
    picture[0, 1] = 0xD1, 0x07, 0  # 2001: no data
    picture[1, 1] = 0xD0, 0x07, 0  # 2000 is the last that is
    cv2.imwrite(str(tmp_path / 'depth_1_0000002.png'), picture)
    depths = tompson.read_nyu_depths(tmp_path, [0, 1])
    assert list(depths) == [1] and depths[1][:2, :2] == pytest.approx(np.array([[0.801, 0], [0, 2]]))
    cv2.imwrite(str(tmp_path / 'depth_1_0000004.png'), picture[::2, ::2])
    with pytest.raises(HandPoseError, match=r'depth_1_0000004\.png has 320x240 pixels, .* have 640x480'):
        tompson.read_nyu_depths(tmp_path, [3])
    cv2.imwrite(str(tmp_path / 'depth_1_0000003.png'), np.ones((4, 4), np.uint16))
    with pytest.raises(HandPoseError, match=r'depth_1_0000003\.png is not a depth image'):
        tompson.read_nyu_depths(tmp_path, [2])


def test_results_are_kept_with_all_that_belongs_to_them(tmp_path):
    rng = np.random.default_rng(4)
    result = Result(
        'a result', SKELETONS['hand21'], Intrinsics(400, 401, 160, 120, 320, 240), rng.normal(size=(3, 21, 3)),
        rng.normal(size=(3, 21, 3)), np.array([1, 2, 3]), {'detect': rng.random(3)}, {'part': (0, 2)}, ('a note',),
        {'model': 'x'})
    result.save(tmp_path / 'r.npz')
    again = load_result(f'renamed={tmp_path / "r.npz"}')
    assert again.name == 'renamed' and again.summary() | {'name': ''} == result.summary() | {'name': ''}
    assert np.array_equal(again.predictions, result.predictions) and again.skeleton == result.skeleton
    assert [file.name for file in tmp_path.iterdir()] == ['r.npz'], 'no temporary file is left'
    np.savez(tmp_path / 'other.npz', joints=np.zeros(3))
    (tmp_path / 'broken.npz').write_bytes((tmp_path / 'r.npz').read_bytes()[:300])
    for name in ('other.npz', 'broken.npz'):
        with pytest.raises(InputError, match=f'{name}: not a result'):
            Result.load(tmp_path / name)
    arrays = dict(np.load(tmp_path / 'r.npz'))
    for key, wrong in (('joints', np.zeros((3, 14, 3))), ('truth', np.zeros((4, 21, 3))), ('stamps_ns', np.arange(2)),
                       ('hand_ids', np.array(['a'])), ('seconds_0', np.zeros(2))):
        np.savez(tmp_path / 'odd.npz', **{**arrays, key: wrong})
        with pytest.raises(InputError, match=rf'odd\.npz: the shape of .* is \({len(wrong)},.*, not \(3'):
            Result.load(tmp_path / 'odd.npz')
    with pytest.raises(InputError, match=r'none\.npz: the file cannot be read'):
        Result.load(tmp_path / 'none.npz')
    whole = (tmp_path / 'r.npz').read_bytes()
    for at in range(0, len(whole), len(whole) // 300):  # a bit that fell over is an error or does not matter
        (tmp_path / 'bit.npz').write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1:])
        with suppress(InputError):
            Result.load(tmp_path / 'bit.npz')
