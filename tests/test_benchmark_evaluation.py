"""Weights on the synthetic benchmark and on datasets: every number is there and follows from the answers."""

import json

import numpy as np
import pytest
import torch
from test_training import folder  # noqa: F401 (a fixture)

from hand_pose_ros.cli import main
from hand_pose_ros.datasets import joints_in_metres, open_dataset
from hand_pose_ros.evaluation import benchmark_evaluation
from hand_pose_ros.evaluation.benchmark_evaluation import _self_knowledge, evaluate_benchmark
from hand_pose_ros.evaluation.dataset_evaluation import evaluate_dataset
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import load_checkpoint, save_checkpoint
from hand_pose_ros.runtime.engine import Pipeline, TorchEngine
from hand_pose_ros.synthetic import benchmark
from hand_pose_ros.synthetic.generator import LEFT

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)


def test_a_network_is_scored_on_the_frames_with_a_hand(tmp_path):
    torch.manual_seed(0)
    weights = tmp_path / 'net.safetensors'
    save_checkpoint(weights, build('hand_dense', width=4), {'skeleton': 'hand21', 'cube_side': 0.3})
    totals = []
    result = evaluate_benchmark(str(weights), device='cpu', frames=60,
                                progress=lambda items, total: totals.append(total) or items)
    assert totals == [len(list(benchmark.frames(60, batch=50)))]
    present = int(sum(batch['hand_present'].sum() for batch in benchmark.frames(60)))
    summary = result.summary()
    assert summary['frames'] == present < 60
    assert np.isfinite(summary['mean_mm']) and summary['mean_mm'] > 10  # it has learned nothing
    assert summary['error_jitter_mm'] is summary['bone_drift_mm'] is None, 'no frame follows another'
    assert sum(row['joints'] for row in summary['calibration_20_mm']) == 21 * present
    parts = [summary['visible_joints'], summary['hidden_joints']]
    assert sum(part['joints'] for part in parts) == 21 * present
    assert sum(part['joints'] * part['mean_mm'] for part in parts) / (21 * present) == pytest.approx(
        summary['mean_mm'], abs=0.01)
    rows = summary['frames_by_visible_joints']
    assert [row['visible'] for row in rows] == [[0, 7], [8, 14], [15, 21]]
    assert sum(row['frames'] for row in rows) == present
    assert sum(row['frames'] * row['mean_mm'] for row in rows) / present == pytest.approx(summary['mean_mm'], abs=0.01)


def test_errors_are_those_of_the_scene_also_of_left_hands(tmp_path):
    torch.manual_seed(0)
    weights = tmp_path / 'net.safetensors'
    save_checkpoint(weights, build('hand_dense', width=4), {'skeleton': 'hand21', 'cube_side': 0.3})
    result = evaluate_benchmark(str(weights), device='cpu', frames=50)
    scene = next(iter(benchmark.frames(50, batch=50)))
    present, left = scene['hand_present'], scene['side'] == LEFT
    assert (left & present).any() and (~left & present).any()
    expected = scene['joints_m'].clone()
    expected[left, :, 0] *= -1
    np.testing.assert_allclose(result.truth, expected[present], atol=1e-6)


def test_joints_are_told_apart_by_what_the_camera_sees(tmp_path, monkeypatch):
    weights = tmp_path / 'net.safetensors'
    save_checkpoint(weights, build('hand_dense', width=4), {'skeleton': 'hand21', 'cube_side': 0.3},
                    build('or_ref'))
    scene = next(iter(benchmark.frames(50, batch=50)))

    class Knowing:
        """Right but for 30 mm of depth of what is hidden, and sure of the side of what it is shown."""

        name = 'knowing'

        def run_full(self, patches):
            mirrored = not np.array_equal(patches, scene['patch'])
            np.testing.assert_array_equal(patches, scene['patch'].flip(-1) if mirrored else scene['patch'])
            joints = scene['joints'].clone()
            joints[..., 2] += ~scene['visible'] * 0.060 / scene['cube_side'][:, None]
            return {'joints': joints.numpy(), 'confidence': np.zeros((50, 21)), 'hand': np.zeros(50),
                    'side': np.full(50, -1.0 - mirrored)}

    asked = {}
    monkeypatch.setattr(benchmark_evaluation, 'make_engine', lambda _, **options: asked.update(options) or Knowing())
    info = evaluate_benchmark(str(weights), device='cpu', frames=50).info
    assert asked['device'] == 'cpu' and asked['refiner'] is not None
    assert info['visible_joints']['mean_mm'] < 0.01 and info['hidden_joints']['median_mm'] == pytest.approx(30, rel=0.1)
    [row] = info['calibration_20_mm']
    assert row['right'] == pytest.approx(info['visible_joints']['joints'] / row['joints'], abs=1e-3)
    assert info['side_found'] == 1
    for row in info['frames_by_visible_joints']:
        most, least = (30 * (21 - visible) / 21 for visible in row['visible'])
        assert 0.9 * least <= row['mean_mm'] <= 1.1 * most


def test_calibration_counts_what_was_right():
    confidence = np.array([[4.0, -4.0], [4.0, 99.0], [9.0, 9.0]], np.float32)
    right = np.array([[True, False], [True, False], [True, True]])
    known = _self_knowledge(confidence, right, np.array([3.0, -1.0, 2.0], np.float32), np.array([True, False, True]),
                            np.array([True, True, False]))
    low, high = known['calibration_20_mm']
    assert low == {'confidence': [0.0, 0.1], 'joints': 1, 'right': 0.0}
    assert high == {'confidence': [0.9, 1.0], 'joints': 3, 'right': pytest.approx(2 / 3, abs=1e-3)}
    assert known['side_found'] == 0.5
    # Of the hands one is sure of half of its joints, 0.95 * 0.5; the other is likely none, 0.27 * 0.98.
    assert known['hands_reported'] == 0.5 and known['no_hands_reported'] == 1.0


def test_weights_for_other_joints_are_refused(tmp_path, capsys):
    weights = tmp_path / 'nyu.safetensors'
    save_checkpoint(weights, build('hand_dense', joints=14, width=4), {'skeleton': 'nyu14', 'cube_side': 0.3})
    assert main(['evaluate', 'synthetic-test-v1', '--model', str(weights)]) == 1
    assert 'those of hand21, not of nyu14' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(['evaluate', 'synthetic-test-v1', '--side', 'left'])
    assert '--side is for bags' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(['evaluate', 'synthetic-test-v1', '--depth-scale', '0.0001'])
    assert '--depth-scale is for bags' in capsys.readouterr().err


def test_a_network_is_scored_on_the_test_frames_of_its_dataset(folder, tmp_path, capsys):
    weights, json_file = tmp_path / 'own.safetensors', tmp_path / 'result.json'
    save_checkpoint(weights, build('shallow', joints=16), {'skeleton': 'icvl16', 'cube_side': 0.25},
                    build('or_ref', joints=16))
    arguments = ['evaluate', 'icvl', '--root', str(folder), '--device', 'cpu']
    for split, frames in ((['--split', 'test_1'], 3), ([], 6)):
        assert main([*arguments, *split, '--model', str(weights), '--json', str(json_file),
                     '--out', str(tmp_path / f'{frames}.npz')]) == 0
        summary = json.loads(json_file.read_text())
        assert summary['frames'] == frames
    capsys.readouterr()
    assert main([*arguments, '--model', str(weights), '--compare', f'before={tmp_path / "6.npz"}']) == 0
    _, now, before = (line.split()[-12:] for line in capsys.readouterr().out.splitlines())
    assert now == before
    batch = open_dataset('icvl', 'test', folder).batch(torch.arange(6))
    cube = batch['cube_center'], batch['cube_side']
    checkpoint = load_checkpoint(weights)
    joints = torch.from_numpy(TorchEngine(Pipeline(checkpoint.network, checkpoint.refiner)).run(batch['patch'].numpy()))
    predictions, truth = joints_in_metres(joints, *cube), joints_in_metres(batch['joints'], *cube)
    assert summary['mean_mm'] == pytest.approx(1000 * float((predictions - truth).norm(dim=-1).mean()), abs=0.01)
    assert summary['error_jitter_mm'] is summary['bone_drift_mm'] is None, 'no frame follows another'
    result = evaluate_dataset('icvl', folder, str(weights), device='cpu')
    np.testing.assert_allclose(result.predictions, predictions, atol=1e-5)
    np.testing.assert_allclose(result.truth, truth, atol=1e-6)

    assert main([*arguments, '--model', 'hand_dense']) == 1
    assert 'its joints are those of hand21, but icvl has those of icvl16' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(['evaluate', 'icvl'])
    assert 'give its folder with --root' in capsys.readouterr().err
