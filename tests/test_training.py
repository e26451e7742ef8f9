"""Training learns, can be stopped and continued anywhere, and gives the same result on any number of processes."""

import copy
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from test_augmentation import CAMERA

from hand_pose_ros.bags import BagWriter
from hand_pose_ros.cli import main
from hand_pose_ros.datasets import Batch, Dataset, icvl
from hand_pose_ros.datasets.shards import MemoryShards
from hand_pose_ros.errors import CheckpointError, HandPoseError, TrainingError
from hand_pose_ros.geometry import Cube
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.skeleton import HAND21, Skeleton, get_skeleton
from hand_pose_ros.training.folder import RunFolder
from hand_pose_ros.training.gradients import Gradients
from hand_pose_ros.training.loop import Machine, Run
from hand_pose_ros.training.optimizers import learning_rate
from hand_pose_ros.training.recipes import get_recipe, recipe_from_dict
from hand_pose_ros.training.state import load_progress, save_tensors
from hand_pose_ros.training.stream import SampleStream
from hand_pose_ros.training.validation import some_samples

pytestmark = pytest.mark.usefixtures('one_thread')

TINY = ('dataset=icvl', 'network=shallow', 'options.bottleneck=8', 'batch_size=4', 'shard_size=4', 'val_every=40',
        'samples=96')


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """A small dataset in ICVL's format, whose joints are discs in space."""
    root = tmp_path_factory.mktemp('icvl')
    rng = np.random.default_rng(0)
    lines = []
    for i in range(26):
        sequence = '201403121135' if i < 16 else '201405151126' if i < 20 else 'test_seq_1' if i < 23 else 'test_seq_2'
        name = f'{sequence}/image_{i:04d}.png'
        joints = np.array([0, 0, 0.4]) + rng.uniform(-0.06, 0.06, (16, 3))
        v, u = np.mgrid[:240, :320]
        depth = np.zeros((240, 320))
        for x, y, z in sorted(joints.tolist(), key=lambda joint: -joint[2]):
            inside = (u - 160 - 241.42 * x / z) ** 2 + (v - 120 - 241.42 * y / z) ** 2 < 36
            depth[inside] = 1000 * z
        (root / 'Depth' / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / 'Depth' / name), depth.round().astype(np.uint16))
        uv = icvl.INTRINSICS.project(joints)
        lines.append(name + ''.join(f' {a:.4f} {b:.4f} {1000 * z:.4f}' for (a, b), z in
                                    zip(uv, joints[:, 2], strict=True)))
    for file, part in (('labels', slice(20)), ('test_seq_1', slice(20, 23)), ('test_seq_2', slice(23, 26))):
        (root / f'{file}.txt').write_text('\n'.join(lines[part]))
    return root


def tiny(folder: Path, *overrides: str, recipe: str = 'paper', out: Path, **machine) -> Run:
    recipe_ = get_recipe(recipe, [*TINY, f'root={folder}', *overrides])
    return Run(out, recipe_, Machine(folder / 'cache', workers=0, **machine))


# What a step sees

class Numbered(Dataset):
    """Samples that hold their own number."""

    name, skeleton, fingerprint = 'numbered', HAND21, 'numbered'

    def __init__(self, size: int | None) -> None:
        self.size = size

    def batch(self, indices: torch.Tensor) -> Batch:
        return {'patch': torch.zeros(len(indices), 1), 'joints': indices.float()}


@pytest.mark.parametrize('size', [None, 37])
def test_every_sample_is_used_equally_often_and_a_step_is_a_function_of_its_number(size):
    def stream(**options):
        return SampleStream(MemoryShards(Numbered(size), 8), 8, seed=3, reuse=4, **options)
    whole = stream()
    steps = [whole.batch(step)[0]['joints'].int().tolist() for step in range(37)]
    counts = np.bincount(np.concatenate(steps))
    if size is None:  # but for the last shards, which later stages go on with
        assert (counts[:6 * 8] == 4).all() and counts.max() == 4
    else:
        assert (counts == 8).all() and len(counts) == size  # 8 epochs
    for step in (20, 3, 36):  # on its own, in any order
        assert stream().batch(step)[0]['joints'].int().tolist() == steps[step]

    def numbered(rank: int, world: int) -> dict[int, int]:
        batch, numbers = stream(part=(rank, world)).batch(5)
        return dict(zip(numbers.tolist(), batch['joints'].int().tolist(), strict=True))
    assert numbered(0, 2) | numbered(1, 2) == numbered(0, 1)  # which augments them alike
    later = stream(first=2)
    assert min(later.batch(0)[0]['joints']) >= 16


@pytest.mark.parametrize(('size', 'count', 'expected'), [
    (None, 10, range(10)), (37, 5, (0, 9, 18, 27, 36)), (37, 37, range(37)), (37, 99, range(37)), (37, 1, (0,))])
def test_validation_is_on_samples_from_all_of_a_recording(size, count, expected):
    batches = some_samples(MemoryShards(Numbered(size), 8), count)
    assert torch.cat([batch['joints'] for batch in batches]).tolist() == list(expected)


# Runs

def test_training_learns_and_leaves_a_folder_that_tells_all(folder, tmp_path, monkeypatch):
    run = tiny(folder, 'network=deep', 'optimizer=adamw', 'learning_rate=0.002', 'samples=960', 'batch_size=16',
               'val_every=480', 'options.dropout=0.0', recipe='paper', out=tmp_path)
    monkeypatch.setattr('hand_pose_ros.training.loop.time', SimpleNamespace(monotonic=lambda: 2 * run.step))
    first = run.train()
    # Twelve frames do not tell where scattered balls are in a new one, but those it was shown it knows.
    shown = load_checkpoint(tmp_path / 'last.safetensors')
    batch = run.shards.read(0)
    with torch.no_grad():
        error = (shown.network(batch['patch'].float()) - batch['joints']).norm(dim=-1).mean() * 125
    assert error < 25 < first['val_mm'] / 1.5
    assert {key: shown.metadata[key] for key in ('skeleton', 'cube_side', 'training_data')} == {
        'skeleton': 'icvl16', 'cube_side': 0.25, 'training_data': 'icvl-train'}
    lines = [json.loads(line) for line in (tmp_path / 'metrics.jsonl').read_text().splitlines()]
    assert [line['samples'] for line in lines if 'val_mm' in line] == [480, 960]
    assert [(line['step'], line['rate']) for line in lines if 'joints' in line] == [(50, 8), (60, 8)]
    config = json.loads((tmp_path / 'config.json').read_text())
    assert recipe_from_dict(config['recipe']) == run.recipe and 'git' in config
    assert (tmp_path / 'best.safetensors').exists()
    told = (tmp_path / 'log.txt').read_text().count(' of 960 samples, ')  # how it goes, where no terminal shows a bar
    assert told == 1, 'a line a minute'
    with pytest.raises(TrainingError, match='holds a run already'):
        tiny(folder, out=tmp_path).train()


def test_a_run_that_is_there_is_not_trained_over(tmp_path, capsys):
    (tmp_path / 'state.safetensors').touch()
    assert main(['train', 'paper', '--out', str(tmp_path), '--cache', str(tmp_path / 'cache')]) == 1
    assert f'{tmp_path} holds a run already' in capsys.readouterr().err
    assert not (tmp_path / 'cache').exists(), 'samples were made for nothing'


def same_state(a: Path, b: Path) -> bool:
    one, two = load_file(a / 'state.safetensors'), load_file(b / 'state.safetensors')
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)


MODERN = ('network=hand_dense', 'options={}', 'options.width=8')


@pytest.mark.parametrize('recipe', ['paper', 'original-code', 'modern'])
def test_a_stopped_run_continues_bit_for_bit(folder, tmp_path, recipe):
    overrides = ('samples=40', *(MODERN if recipe == 'modern' else ()))
    tiny(folder, *overrides, recipe=recipe, out=tmp_path / 'whole').train()
    run = tiny(folder, *overrides, recipe=recipe, out=tmp_path / 'stopped')
    step, train_step = [], run._train_step

    def stopping(module):
        step.append(1)
        if len(step) == 7:  # in the middle of an epoch
            os.kill(os.getpid(), signal.SIGTERM)
        return train_step(module)
    run._train_step = stopping
    with pytest.raises(TrainingError, match=r'after 28 samples, with .*last.safetensors; .* --resume goes on'):
        run.train()
    facts = load_checkpoint(tmp_path / 'stopped' / 'last.safetensors').metadata  # weights to use
    assert (facts['samples'], facts['validation']) == (28, {})
    metrics = tmp_path / 'stopped' / 'metrics.jsonl'  # as a process that was killed long after its last state leaves it
    metrics.write_bytes(b'{"step": 3, "samples": 12}\n{"step": 4, "sam\xab": 16\nnull\n{"step": 8, "samples": 32}\n'
                        b'{"step": 9, "sam')
    again = tiny(folder, *overrides, recipe=recipe, out=tmp_path / 'stopped')
    again.train(resume=True)
    assert same_state(tmp_path / 'whole', tmp_path / 'stopped')
    *rows, last, _ = map(json.loads, metrics.read_text().splitlines())
    assert [row['step'] for row in rows] == [3] and last['step'] == 10
    assert last['learning_rate'] == learning_rate(run.recipe, 9 / 10)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_what_is_validated_and_shipped_is_the_average_of_the_weights_and_of_what_norms_have_seen(folder, tmp_path):
    run = tiny(folder, *MODERN, 'samples=11', 'learning_rate=0.1', 'warmup=0', 'average=0.15', recipe='modern',
               out=tmp_path)
    expected, train_step = copy.deepcopy(run.objective.network.state_dict()), run._train_step

    def watched(gradients):
        terms, decay = train_step(gradients), (0.1, 0.15, 0.15)[run.step - 1]  # the random start is forgotten soon
        for name, value in run.objective.network.state_dict().items():
            last = expected[name]
            expected[name] = decay * last + (1 - decay) * value if value.is_floating_point() else value.clone()
            torch.testing.assert_close(run.averaged.network.state_dict()[name], expected[name], atol=1e-6, rtol=1e-6)
        return terms
    run._train_step = watched
    run.train()
    assert run.step == 3, 'samples are asked for, at least so many'
    shipped = load_checkpoint(tmp_path / 'last.safetensors').network.state_dict()
    last = run.objective.network.state_dict()
    for name, value in expected.items():
        torch.testing.assert_close(shipped[name], value, atol=1e-3, rtol=1e-3)
    assert (last['maps.weight'] - expected['maps.weight']).abs().max() > 0.005


@pytest.mark.parametrize(('whole', 'damaged'), [
    (rb'\"step\"', rb'\"stop\"'), (b'optimizer.0', b'optimizer.x'), (b'"trained.network.', b'"trained.netwerk.')])
def test_a_damaged_state_is_named_in_one_line(folder, tmp_path, whole, damaged):
    tiny(folder, 'samples=8', out=tmp_path).train()
    state = tmp_path / 'state.safetensors'
    data = state.read_bytes()
    assert whole in data
    state.write_bytes(data.replace(whole, damaged, 1))
    with pytest.raises(CheckpointError, match=r'state.safetensors cannot be resumed from: .') as caught:
        tiny(folder, 'samples=8', out=tmp_path).train(resume=True)
    assert '\n' not in str(caught.value)


def command(folder: Path, out: Path, *overrides: str) -> list[str]:
    sets = [part for item in (*TINY, f'root={folder}', *overrides) for part in ('--set', item)]
    return ['train', 'paper', '--out', str(out), '--cache', str(folder / 'cache'), '--threads', '1', *sets]


@pytest.mark.timeout(600)
def test_a_killed_run_continues_bit_for_bit(folder, tmp_path):
    """SIGKILL at any moment, with samples made by another process, which must not outlive the run."""
    script = ('import sys, hand_pose_ros.training.loop as loop; from functools import partial;'
              'loop.Machine = partial(loop.Machine, save_every_s=0);'
              'from hand_pose_ros.cli import main; sys.exit(main(sys.argv[1:]))')
    long = ('samples=40_000', 'val_every=100_000')
    arguments = command(folder, tmp_path, *long)
    process = subprocess.Popen([sys.executable, '-c', script, *arguments], stderr=subprocess.PIPE)
    state = tmp_path / 'state.safetensors'
    while not state.exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(0.5)
    process.kill()
    process.communicate(timeout=60)  # which ends when no child holds its end of the pipe any more
    stopped_at = int(load_progress(state)['step'])
    assert 0 < stopped_at < 10_000
    again = Run(tmp_path, get_recipe('paper', [*TINY, f'root={folder}', *long]), Machine(folder / 'cache', workers=0))
    whole = tiny(folder, *long, out=tmp_path / 'whole')
    for run, resume in ((again, True), (whole, False)):
        stop_after(run, stopped_at + 5)
        with pytest.raises(TrainingError, match='--resume goes on'):
            run.train(resume)
    assert same_state(tmp_path, tmp_path / 'whole')


@pytest.mark.parametrize('width', ['8', 'none'])  # waits for the poses of its prior, or for the samples of a step
def test_ctrl_c_before_the_first_step_ends_a_run_at_once(tmp_path, width):
    """As in a terminal, where every process gets it; once more while it ends. The samples would take an hour."""
    sets = [part for item in ('shard_size=200_000', f'options.bottleneck={width}') for part in ('--set', item)]
    process = subprocess.Popen([sys.executable, '-m', 'hand_pose_ros.cli', 'train', 'paper', '--threads', '1', '--out',
                                str(tmp_path / 'run'), '--cache', str(tmp_path / 'cache'), *sets],
                               stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        for awaited in ('making samples of synthetic-train', 'hand-pose train: interrupted'):
            while awaited not in (line := process.stderr.readline()):
                assert line and 'Traceback' not in line
            os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=60)  # which ends when no child holds its end of the pipe any more
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode != 0 and not list((tmp_path / 'cache').rglob('*.*'))


def test_a_signal_does_not_wait_for_samples_and_the_run_continues_bit_for_bit(folder, tmp_path):
    overrides = ('samples=40', 'val_every=28')
    tiny(folder, *overrides, out=tmp_path / 'whole').train()
    run = tiny(folder, *overrides, out=tmp_path / 'stopped')
    batch = run.stream.batch

    def endless(step):
        if step == 7:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(600)
        return batch(step)
    run.stream.batch = endless
    with pytest.raises(TrainingError, match=r'after 28 samples, with .*last.safetensors; .* --resume goes on'):
        run.train()
    assert 'val_mm' in load_checkpoint(tmp_path / 'stopped' / 'last.safetensors').metadata['validation']
    tiny(folder, *overrides, out=tmp_path / 'stopped').train(resume=True)
    assert same_state(tmp_path / 'whole', tmp_path / 'stopped')
    assert validations(tmp_path / 'stopped') == validations(tmp_path / 'whole')
    logs = [(tmp_path / name / 'log.txt').read_text() for name in ('whole', 'stopped')]
    assert [log.count('the recipe is in') for log in logs] == [1, 2], 'each has a log of its own'


def test_the_state_is_saved_now_and_then_and_around_a_validation(folder, tmp_path, monkeypatch):
    run, saved = None, []
    monkeypatch.setattr('hand_pose_ros.training.loop.time', SimpleNamespace(monotonic=lambda: run.step if run else 0))
    monkeypatch.setattr('hand_pose_ros.training.loop.save_state', lambda *_: saved.append(run.step))
    run = tiny(folder, 'samples=40', out=tmp_path, save_every_s=3)
    run.train()
    assert saved == [4, 8, 10, 10]


def test_what_a_killed_run_left_half_written_goes_with_the_next(tmp_path):
    left = tmp_path / '.state.safetensors.1234567.part'
    left.write_bytes(b'half of it')
    run = RunFolder(tmp_path)
    run.lock()
    run.close()
    assert not left.exists()


def test_one_folder_is_trained_in_by_one_process_at_a_time(folder, tmp_path):
    first = tiny(folder, 'samples=8', out=tmp_path / 'run')
    first.folder.lock()
    for resume in (False, True):
        with pytest.raises(TrainingError, match=r'run: another process trains in this folder'):
            tiny(folder, 'samples=8', 'seed=5', out=tmp_path / 'run').train(resume)
    first.train()  # in which it may lock once more
    assert json.loads((tmp_path / 'run' / 'config.json').read_text())['recipe']['seed'] == first.recipe.seed


def test_a_run_goes_on_from_another_folder(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder.parent)
    recipe = get_recipe('paper', [f'root={folder.name}', 'base=hand_dense', 'first=nothing/here'])
    assert (recipe.root, recipe.base, recipe.first) == (str(folder.resolve()), 'hand_dense', 'nothing/here')


def test_tensorboard_forgets_what_a_killed_run_showed_after_its_state(tmp_path):
    pytest.importorskip('tensorboard')
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    for step, shown in ((0, (4, 8, 12)), (2, (12, 16))):  # killed after 12 samples, with the state of 8
        run = RunFolder(tmp_path)
        run.open(step, 4 * step)
        for samples in shown:
            run.write({'step': samples // 4, 'samples': samples, 'loss': float(step)})
        run.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert [(one.step, one.value) for one in events.Scalars('loss')] == [(4, 0), (8, 0), (12, 2), (16, 2)]


def test_a_full_disk_is_told_of_with_the_file(tmp_path, monkeypatch):
    def full(*_, **__):
        raise SafetensorError('Error while serializing: I/O error: No space left on device (os error 28)')

    monkeypatch.setattr('hand_pose_ros.training.state.save_file', full)
    with pytest.raises(HandPoseError, match=r'x\.safetensors: cannot be written, for the disk is full: make room'):
        save_tensors(tmp_path / 'x.safetensors', {'a': torch.zeros(1)}, {})
    assert not list(tmp_path.iterdir())


def test_a_run_that_was_stopped_in_its_last_validation_does_it_when_resumed(folder, tmp_path):
    whole = tiny(folder, 'samples=40', out=tmp_path / 'whole')
    stop_after(whole, 10)  # in its last step: nothing is left to stop
    expected = whole.train()
    run = tiny(folder, 'samples=40', out=tmp_path / 'stopped')

    def stopped():
        raise KeyboardInterrupt
    run._validate = stopped
    with pytest.raises(TrainingError, match='after 40 samples'):
        run.train()
    assert not (tmp_path / 'stopped' / 'best.safetensors').exists()
    assert tiny(folder, 'samples=40', out=tmp_path / 'stopped').train(resume=True) == expected
    assert (tmp_path / 'stopped' / 'best.safetensors').exists()
    assert tiny(folder, 'samples=40', out=tmp_path / 'stopped').train(resume=True) == expected  # finished already
    assert len(validations(tmp_path / 'stopped')) == 1


def test_a_validation_that_fails_costs_no_training_and_is_made_up_for(folder, tmp_path):
    tiny(folder, out=tmp_path / 'whole').train()
    run = tiny(folder, out=tmp_path / 'failed')

    def full(*_):
        raise HandPoseError('the disk is full')
    run._save_checkpoint = full
    with pytest.raises(HandPoseError, match='disk is full'):
        run.train()
    assert load_progress(run.folder.state)['step'] == 10
    tiny(folder, out=tmp_path / 'failed').train(resume=True)
    assert same_state(tmp_path / 'whole', tmp_path / 'failed')
    assert validations(tmp_path / 'failed') == validations(tmp_path / 'whole')


def test_a_run_that_goes_on_keeps_its_best_weights_and_tells_of_other_data(folder, tmp_path, monkeypatch, caplog):
    errors = iter((0.009, 0.019))

    def validate(*_) -> tuple[torch.Tensor, torch.Tensor]:
        error = next(errors)  # and of one joint more, as of the worst
        return torch.tensor([[[error, 0, 0]] * 15 + [[error + 0.016, 0, 0]]]), torch.zeros(1, 16, 3)
    monkeypatch.setattr('hand_pose_ros.training.loop.estimate', validate)
    first, again = (tiny(folder, 'samples=80', out=tmp_path) for _ in range(2))
    stop_after(first, 15)
    with pytest.raises(TrainingError, match='after 60 samples'):
        first.train()
    again.shards.dataset.fingerprint = 'another'
    again.train(resume=True)
    assert 'the training data, or the code that makes them, have changed since step 15' in caplog.text
    for name, samples, *told in (('best', 40, 10, 0, 1, 1), ('last', 80, 20, 0, 0, 1)):
        facts = load_checkpoint(tmp_path / f'{name}.safetensors').metadata
        assert facts['samples'] == samples
        assert facts['validation'] == dict(zip(('val_mm', 'val_within_20', 'val_within_30', 'val_within_40'), told,
                                               strict=True))
    caplog.clear()
    tiny(folder, 'samples=80', out=tmp_path).train(resume=True)
    assert f'the run in {tmp_path} is finished already' in caplog.text


def validations(run: Path) -> list[dict]:
    return [row for row in map(json.loads, (run / 'metrics.jsonl').open()) if 'val_mm' in row]


def record_hand(folder: Path, skeleton: Skeleton = HAND21, camera: object = CAMERA) -> None:
    joints = np.array([0, 0, 0.5]) + np.random.default_rng(0).uniform(-0.05, 0.05, (len(skeleton), 3))
    hand = SimpleNamespace(id='0', side='right', score=1.0, joints=joints, confidence=np.ones(len(skeleton)),
                           cube=Cube((0.0, 0.0, 0.5), 0.3))
    with BagWriter(folder / 'hand.mcap') as file:
        file.write_depth(0, 'camera', np.full((480, 640), 0.5, np.float32), camera)
        file.write_hands(0, 'camera', [hand], skeleton)


def test_validation_data_that_cannot_be_used_are_told_before_the_training(tmp_path):
    def run() -> Run:
        recipe = get_recipe('paper', ['dataset=bags', f'root={tmp_path}', 'options.bottleneck=none'])
        return Run(tmp_path / 'run', recipe, Machine(tmp_path / 'cache', workers=0))
    record_hand(tmp_path / 'train')
    with pytest.raises(HandPoseError, match='val holds no bags'):
        run()
    record_hand(tmp_path / 'val', get_skeleton('icvl16'))
    with pytest.raises(TrainingError, match='bags-val has joints of icvl16, but bags-train those of hand21'):
        run()
    record_hand(tmp_path / 'val')
    run()


def stop_after(run: Run, step: int) -> None:
    train_step = run._train_step

    def stopping(module):
        run._stop = run.step + 1 >= step
        return train_step(module)
    run._train_step = stopping


def test_a_bag_without_intrinsics_is_told_without_options_that_training_lacks(tmp_path, capsys):
    for split in ('train', 'val'):
        record_hand(tmp_path / split, camera=SimpleNamespace(fx=0.0, fy=0.0, cx=0.0, cy=0.0, width=640, height=480))
    sets = [part for item in ('dataset=bags', f'root={tmp_path}') for part in ('--set', item)]
    assert main(['train', 'paper', '--out', str(tmp_path / 'run'), '--cache', str(tmp_path / 'cache'), '--threads', '1',
                 '--workers', '0', *sets]) == 1
    assert 'or give --intrinsics FX FY CX CY (0 of 1 depth images were read); training has no such option: write ' \
        'the bag again' in capsys.readouterr().err


@pytest.mark.timeout(600)
def test_two_processes_give_the_result_of_one(folder, tmp_path):
    overrides = ('samples=40', 'network=multi_scale', 'options.dropout=0.0', 'augmentation=modern')
    script = 'import sys; from hand_pose_ros.cli import main; sys.exit(main(sys.argv[1:]))'
    torchrun = [sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', '2']
    arguments = [*command(folder, tmp_path / 'two', *overrides), '--workers', '0']
    result = subprocess.run([*torchrun, '--no-python', sys.executable, '-c', script, *arguments], timeout=550,
                            text=True, capture_output=True, env={**os.environ, 'OMP_NUM_THREADS': '1'})
    assert result.returncode == 0, result.stderr
    assert result.stdout.count('best.safetensors') == result.stderr.count('the prior keeps') == 1  # told by one of them
    assert main([*command(folder, tmp_path / 'one', *overrides), '--workers', '0']) == 0
    one, two = (load_file(tmp_path / name / 'state.safetensors') for name in ('one', 'two'))
    for key, value in one.items():
        torch.testing.assert_close(two[key], value, atol=1e-5, rtol=1e-4)


def test_a_batch_that_cannot_be_shared_is_refused(folder, tmp_path, monkeypatch):
    monkeypatch.setenv('WORLD_SIZE', '3')
    with pytest.raises(TrainingError, match='a batch of 4 cannot be shared equally by 3 processes'):
        tiny(folder, out=tmp_path)


def test_epochs_are_of_the_samples_and_threads_as_many_as_asked(folder, tmp_path):
    run = tiny(folder, 'samples=none', 'epochs=3', out=tmp_path, threads=2)
    assert run.budget == 3 * 16 and torch.get_num_threads() == 2
    torch.set_num_threads(1)


def test_a_device_that_is_not_there_is_told_before_the_work(folder, tmp_path):
    with pytest.raises(HandPoseError, match="device 'quantum' cannot be used here"):
        tiny(folder, out=tmp_path, device='quantum')


@pytest.mark.parametrize('device', ['cuda', 'cuda:0'])
def test_a_process_of_torchrun_without_a_gpu_says_so(folder, tmp_path, device, monkeypatch, capsys):
    for name, value in {'RANK': 0, 'WORLD_SIZE': 99, 'LOCAL_RANK': 98}.items():
        monkeypatch.setenv(name, str(value))
    assert main([*command(folder, tmp_path / 'run'), '--device', device]) == 1
    assert "device 'cuda:98' " in capsys.readouterr().err


def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_batch(folder, tmp_path):
    run = tiny(folder, 'learning_rate=1e30', out=tmp_path)
    with pytest.raises(TrainingError, match=r'step \d+ is not finite .* learning_rate below 1e\+30'):
        run.train()
    assert not list(tmp_path.glob('state*')) and not list(tmp_path.glob('last*'))  # spoilt
    (saved,) = tmp_path.glob('failed_batch_*.safetensors')
    assert load_file(saved)['patch'].shape == (4, 1, 128, 128)


@pytest.mark.skipif(not torch.cuda.is_available(), reason='needs a CUDA GPU')
@pytest.mark.parametrize('network', [MODERN, ('network=deep', 'options.dropout=0.0')])
def test_a_cuda_graph_trains_as_its_kernels_do(folder, tmp_path, network, monkeypatch):
    def weights(run):
        return torch.cat([parameter.detach().flatten() for parameter in run.objective.parameters()])

    def trained(out, captured):
        monkeypatch.setattr('hand_pose_ros.training.loop.Gradients',
                            lambda module, precision, **_: Gradients(module, precision, captured))
        run = tiny(folder, *network, 'samples=40', 'precision=float32', recipe='modern', out=out, device='cuda')
        start = weights(run).clone()
        run.train()
        return start, weights(run)

    start, graph = trained(tmp_path / 'graph', captured=True)
    _, kernels = trained(tmp_path / 'kernels', captured=False)
    assert (graph - kernels).norm() < 0.1 * (kernels - start).norm()


def test_arguments_of_train_that_cannot_be_are_refused(tmp_path, folder, capsys):
    assert main(['train', 'papers', '--out', str(tmp_path)]) == 1
    assert "unknown recipe 'papers'" in capsys.readouterr().err
    assert main(['train', '--resume', '--out', str(tmp_path)]) == 1
    assert 'give the folder of a run, or begin one without --resume' in capsys.readouterr().err
    (tmp_path / 'config.json').write_text('{}')
    assert main(['train', '--resume', '--out', str(tmp_path)]) == 1
    assert 'begin another run in another folder' in capsys.readouterr().err
    for wrong in (['train', '--out', str(tmp_path)], ['train', 'paper', '--out', str(tmp_path), '--resume']):
        with pytest.raises(SystemExit) as error:
            main(wrong)
        assert error.value.code == 2
