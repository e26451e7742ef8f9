"""Every engine gives the joints of plain PyTorch, for any number of hands, and leaves what it was given alone."""

import copy
import functools
import json
import logging

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from hand_pose_ros.cli import main
from hand_pose_ros.datasets import open_dataset
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.estimator import HandPoseEstimator
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.models.dense import HandDense
from hand_pose_ros.runtime import cuda_engine, default_threads, make_engine, timing
from hand_pose_ros.runtime.cuda_engine import LARGEST, CudaEngine, _Captured, exact_convolutions
from hand_pose_ros.runtime.engine import Pipeline, TorchEngine
from hand_pose_ros.runtime.fused import fuse
from hand_pose_ros.runtime.lanes import PairedConvolution, fill_lanes

MM_PER_UNIT = 150
"""A cube of 0.30 m has 150 mm from its centre to a face."""
ARCHITECTURES = ('shallow', 'deep', 'deep_prior', 'multi_scale', 'resnet', 'hand_dense', 'two_looks')


def hand_patches(count: int, seed: int = 0) -> np.ndarray:
    """Patches with a sloping noisy disc, like a palm, before the background."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(*[np.linspace(-1, 1, 128)] * 2, indexing='ij')
    patches = np.ones((count, 1, 128, 128))
    for patch in patches:
        inside = (x - rng.uniform(-0.2, 0.2)) ** 2 + (y - rng.uniform(-0.2, 0.2)) ** 2 < 0.4
        patch[0, inside] = (rng.uniform(-0.5, 0.5) * x + rng.normal(0, 0.02, x.shape))[inside]
    return patches.astype(np.float32).clip(-1, 1)


@functools.cache
def trained(architecture: str) -> torch.nn.Module:
    """A network that answers as a trained one does: normalised inside, joints inside the cube."""
    torch.manual_seed(0)
    options = {'resnet': {'last_stride': 2, 'blocks': 2}, 'two_looks': {'bottleneck': 30, 'refined': True}}
    network = build(architecture, **options.get(architecture, {})).requires_grad_(False)
    patches = torch.from_numpy(hand_patches(8))
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.momentum = None  # the statistics are those of the next call
            module.train()
    network(patches)
    network.eval()
    scale = network(patches).abs().max()
    if architecture in ('hand_dense', 'two_looks'):
        for dense in (module for module in network.modules() if isinstance(module, HandDense)):
            dense.maps.weight.mul_(2)
            if dense.refinement is not None:
                nn.init.normal_(dense.refinement.output.weight, std=0.002)  # moved 5 mm, as in use
    else:
        for layer in (network.head.reconstruction or network.head.output,):
            layer.weight.mul_(0.7 / scale)
    return network


def trained_refiner(architecture: str) -> torch.nn.Module:
    torch.manual_seed(1)
    refiner = build(architecture).eval().requires_grad_(False)
    refiner.weights[-1].mul_(12)
    return refiner


def assert_equal_in_half_precision(answer: np.ndarray, expected: np.ndarray, architecture: str) -> None:
    """To 0.5 mm. Deep networks amplify rounding when their weights are random, at single joints; there, on average."""
    error_mm = np.abs(answer - expected) * MM_PER_UNIT
    assert error_mm.mean() <= 0.2
    if architecture not in ('resnet', 'hand_dense', 'two_looks'):
        assert error_mm.max() <= 0.5


@pytest.mark.parametrize('architecture', ARCHITECTURES)
def test_the_cpu_engine_equals_plain_pytorch(architecture):
    network = trained(architecture)
    plain, engine = TorchEngine(Pipeline(network)), make_engine(network, 'cpu', num_threads=2)
    for count in (1, 2, 5):
        patches = hand_patches(count, seed=count)
        expected = plain.run(patches)
        answer = engine.run(patches)
        assert answer.shape == (count, 21, 3)
        assert answer.dtype == np.float32
        assert 0.05 < np.abs(expected).max() < 2
        assert np.abs(answer - expected).max() * MM_PER_UNIT <= 0.05


@pytest.mark.parametrize('refiner', ['std_ref', 'or_ref'])
@pytest.mark.parametrize('architecture', ['deep_prior', 'hand_dense'])
def test_the_cpu_engine_refines_as_plain_pytorch_does(architecture, refiner):
    network, second = trained(architecture), trained_refiner(refiner)
    engine = make_engine(network, 'cpu', num_threads=1, refiner=second)
    for count in (1, 3):
        patches = hand_patches(count, seed=count)
        with torch.inference_mode():
            first = network(torch.from_numpy(patches))
            expected = second(torch.from_numpy(patches), first).numpy()
        assert np.abs(expected - first.numpy()).max() > 0.02
        assert np.abs(engine.run(patches) - expected).max() * MM_PER_UNIT <= 0.05


@pytest.mark.parametrize(('channels', 'kernel', 'pool', 'size'), [
    (8, 5, 4, 128), (8, 5, 2, 31), (3, 3, 2, 16), (8, 4, 2, 9)])
@pytest.mark.parametrize('bias', [True, False])
def test_two_pixels_at_a_time_give_the_same(channels, kernel, pool, size, bias):
    torch.manual_seed(0)
    block = nn.Sequential(nn.Conv2d(2, channels, kernel, bias=bias), nn.MaxPool2d(pool), nn.ReLU())
    patches = torch.randn(3, 2, size, size)
    expected = block(patches)
    fill_lanes(block)
    assert isinstance(block[0], PairedConvolution)
    torch.testing.assert_close(block(patches), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize('block', [
    [nn.Conv2d(1, 12, 3), nn.MaxPool2d(2), nn.ReLU()], [nn.Conv2d(1, 8, 3), nn.MaxPool2d(3), nn.ReLU()],
    [nn.Conv2d(1, 8, 3), nn.ReLU()], [nn.Conv2d(1, 8, 3), nn.MaxPool2d(2)],
    [nn.Conv2d(1, 8, 3, padding=1), nn.MaxPool2d(2), nn.ReLU()],
    [nn.Conv2d(2, 8, 3, groups=2), nn.MaxPool2d(2), nn.ReLU()],
    [nn.Conv2d(1, 8, 3, stride=2), nn.MaxPool2d(2), nn.ReLU()],
    [nn.Conv2d(1, 8, 3, dilation=2), nn.MaxPool2d(2), nn.ReLU()],
    [nn.Conv2d(1, 8, 3), nn.MaxPool2d(2, stride=1), nn.ReLU()],
    [nn.Conv2d(1, 8, 3), nn.MaxPool2d(2, padding=1), nn.ReLU()],
    [nn.Conv2d(1, 8, 3), nn.MaxPool2d(2, ceil_mode=True), nn.ReLU()]])
def test_what_would_not_gain_or_not_be_equal_stays(block):
    network = nn.Sequential(*block)
    fill_lanes(network)
    assert list(network) == block


def test_hands_do_not_influence_each_other():
    engine = make_engine(trained('deep_prior'), 'cpu', refiner=trained_refiner('or_ref'))
    patches = hand_patches(4)
    alone = np.concatenate([engine.run(patches[i:i + 1]) for i in range(4)])
    np.testing.assert_allclose(engine.run(patches), alone, atol=1e-5)


@pytest.mark.parametrize('architecture', ['shallow', 'hand_dense', 'two_looks'])
def test_no_hands_get_an_empty_answer(architecture):
    network = trained(architecture)
    refiner = None if hasattr(network, 'outputs') else trained_refiner('or_ref')
    nothing = np.zeros((0, 1, 128, 128), np.float32)
    answer = make_engine(network, 'cpu', refiner=refiner).run_full(nothing)
    expected = TorchEngine(Pipeline(network, refiner)).run_full(nothing)
    assert {name: array.shape for name, array in answer.items()} == {
        name: array.shape for name, array in expected.items()}
    assert answer['joints'].shape == (0, 21, 3)


def test_everything_the_network_says_comes_through():
    network = trained('hand_dense')
    patches = hand_patches(2)
    answer = make_engine(network, 'cpu').run_full(patches)
    expected = network.forward_full(torch.from_numpy(patches))
    assert set(answer) == {'joints', 'confidence', 'hand', 'side', 'size'}
    for name, array in answer.items():
        assert array.shape == tuple(expected[name].shape)
        np.testing.assert_allclose(array, expected[name], atol=1e-3)
    assert set(make_engine(trained('shallow'), 'cpu').run_full(patches)) == {'joints'}


def test_views_and_mirrored_patches_are_taken_as_they_are():
    """The estimator shows a left hand in the mirror: an array with a negative stride."""
    engine, patches = make_engine(trained('deep_prior'), 'cpu'), hand_patches(2)
    mirrored = patches[..., ::-1]
    np.testing.assert_array_equal(engine.run(mirrored), engine.run(mirrored.copy()))
    plain = TorchEngine(Pipeline(trained('deep_prior')))
    np.testing.assert_array_equal(plain.run(mirrored), plain.run(mirrored.copy()))


def test_an_answer_is_kept_when_the_next_image_comes():
    engine = make_engine(trained('deep_prior'), 'cpu')
    first = engine.run(hand_patches(1, seed=1))
    copy = first.copy()
    engine.run(hand_patches(1, seed=2))
    np.testing.assert_array_equal(first, copy)


def test_the_network_given_stays_as_it_is():
    network, refiner = build('deep_prior'), build('or_ref')
    make_engine(network, 'cpu', refiner=refiner)
    for module in (network, refiner):
        assert module.training
        assert all(p.requires_grad for p in module.parameters())


@pytest.mark.parametrize('patches', [
    np.zeros((1, 128, 128), np.float32), np.zeros((1, 1, 64, 64), np.float32), np.zeros((1, 1, 128, 128))])
def test_other_patches_are_refused(patches):
    with pytest.raises(InputError, match='patches must be'):
        make_engine(trained('shallow'), 'cpu').run(patches)


def test_the_choice_is_logged_with_its_reason(caplog):
    network = build('shallow')
    with caplog.at_level(logging.INFO, 'hand_pose_ros.runtime'):
        engine = make_engine(network, num_threads=1)
    assert engine.name in caplog.text
    assert 'no GPU was found; 1 of 1 threads' in caplog.text or 'a GPU was found' in caplog.text


def test_a_device_that_is_not_there_is_named():
    network = build('shallow')
    with pytest.raises(HandPoseError, match="device 'quantum' cannot be used here"):
        make_engine(network, 'quantum')
    for part in ('center_refiner', 'or_ref'):
        with pytest.raises(HandPoseError, match=f'weights of {part} give no joints'):
            make_engine(build(part), 'cpu')
    with pytest.raises(HandPoseError, match='num_threads is 0'):
        make_engine(network, 'cpu', num_threads=0)
    if not torch.cuda.is_available():
        with pytest.raises(HandPoseError, match='finds no GPU'):
            make_engine(network, 'cuda')


def unusable_gpu(monkeypatch):
    """One that PyTorch finds, but has no kernels for."""
    def zeros(*size, device='cpu', of=torch.zeros, **options):
        if str(device).startswith('cuda'):
            raise RuntimeError('CUDA error: no kernel image is available\nand more')
        return of(*size, device=device, **options)

    monkeypatch.setattr('torch.cuda.is_available', lambda: True)
    monkeypatch.setattr('torch.zeros', zeros)


def test_a_gpu_that_cannot_be_used_is_left_alone_unless_it_is_asked_for(monkeypatch, caplog):
    network = build('shallow')
    unusable_gpu(monkeypatch)
    assert make_engine(network).name == 'onnxruntime'
    assert "on the CPU: device 'cuda' cannot be used here (CUDA error: no kernel image is available)" in caplog.text
    with pytest.raises(HandPoseError, match=r"no kernel image is available\): use 'cpu', or a PyTorch for this GPU$"):
        make_engine(network, 'cuda')


@pytest.mark.parametrize(('cores', 'threads'), [(1, 1), (2, 2), (4, 3), (8, 4), (64, 4)])
def test_threads_leave_room_for_the_rest(cores, threads, monkeypatch):
    monkeypatch.setattr('os.sched_getaffinity', lambda pid: set(range(cores)), raising=False)
    assert default_threads() == threads


@pytest.mark.parametrize(('seconds', 'threads'), [((1.0, 0.5), 2), ((1.0, 0.95), 1), ((1.0, 2.0), 1)])
def test_a_hand_gets_several_threads_where_they_are_faster(seconds, threads, monkeypatch):
    monkeypatch.setattr('hand_pose_ros.runtime.onnx_engine._medians', lambda alone, several: seconds)
    network, patches = trained('deep_prior'), hand_patches(1)
    engine = make_engine(network, 'cpu', num_threads=2)
    assert engine.threads == threads
    assert np.array_equal(engine.run(patches), make_engine(network, 'cpu', num_threads=1).run(patches))


@pytest.mark.parametrize('count', [0, 1, LARGEST, 3 * LARGEST + 5])
def test_many_hands_run_by_turns_in_graphs_that_none_overwrites_too_soon(count, monkeypatch):
    """With graphs that do their work when they are waited for, at the latest possible time."""
    streams = []

    class Late:
        def __init__(self, size: int) -> None:
            self.patches, self.joints = torch.zeros(size, 1, 128, 128), torch.zeros(size, 21, 3)

        def replay(self) -> None:
            self.pending = True

        def record(self, stream: str) -> None:
            assert self.pending and streams[-1] == stream

        def synchronize(self) -> None:
            self.joints.copy_(self.patches[:, 0, 0, 0, None, None].expand_as(self.joints))

    def capture(engine: CudaEngine, size: int, stream: str) -> _Captured:
        late = Late(size)
        return _Captured(late, late.patches, (late.joints,), stream, late)

    monkeypatch.setattr(CudaEngine, '_capture', capture)
    monkeypatch.setattr('torch.cuda.current_stream', lambda: 'own')
    monkeypatch.setattr('torch.cuda.set_stream', streams.append)
    names = iter(('even', 'odd'))
    monkeypatch.setattr('torch.cuda.Stream', lambda device: next(names))
    engine = CudaEngine(Pipeline(build('shallow')), 'cpu', None)
    assert list(engine._captured) == [(1, 0)], 'the first image does not wait'
    assert engine.pipeline.precision == torch.float16
    patches = np.zeros((count, 1, 128, 128), np.float32)[..., ::-1]  # in the mirror, as left hands are
    patches[:, 0, 0, 0] = np.arange(count)
    joints = engine.run(patches)
    assert joints.shape == (count, 21, 3)
    np.testing.assert_array_equal(joints[:, 0, 0], np.arange(count))
    assert len(engine._captured) <= 4
    assert streams == ['even', 'own', 'odd', 'own', 'even', 'own', 'odd', 'own'][:2 * max(1, -(-count // LARGEST))]
    sizes = {0: {1}, 1: {1}, LARGEST: {1, LARGEST}}.get(count, {1, LARGEST, 8})  # the next larger powers of two
    assert {size for size, _ in engine._captured} == sizes


@pytest.mark.parametrize('name', ['deep_prior', 'hand_dense'])
@pytest.mark.parametrize(('moved', 'used', 'said'), [
    ({'own': 0.001}, 'own', ''),
    ({'none': 0.001}, 'none', 'as kernels of our own cannot be used on cuda: AssertionError'),
    ({'own': np.nan, 'none': 0.001}, 'none', 'as kernels of our own cannot be used on cuda: the joints'),
    ({'own': 0.1, 'none': 0.1}, 'pytorch', 'as CUDA graphs cannot be used on cuda: the joints are not those'),
    ({}, 'pytorch', 'as CUDA graphs cannot be used on cuda: no kernel image')])
def test_what_is_wrong_or_fails_on_a_gpu_is_done_without(name, moved, used, said, monkeypatch, caplog):
    """As its kernels are compiled where no test has been; here with a stand-in."""
    class Stranger(TorchEngine):
        def __init__(self, pipeline: Pipeline, device: str, kernels: object) -> None:
            self.name = 'own' if kernels else 'none'
            super().__init__(copy.deepcopy(pipeline))
            for weight in pipeline.parameters():  # they become other weights
                weight.zero_()
            if self.name not in moved:
                raise AssertionError if kernels else ValueError('\nno kernel image\nand more')  # as NVRTC's begin

        def run(self, patches: np.ndarray) -> np.ndarray:
            return super().run(patches) + np.float32(moved[self.name])

    monkeypatch.setattr('torch.cuda.is_available', lambda: True)
    monkeypatch.setattr('hand_pose_ros.runtime.check_device', lambda device: None)
    monkeypatch.setattr('hand_pose_ros.runtime.cuda_engine._own_kernels', lambda: copy if moved else None)  # any module
    monkeypatch.setattr('hand_pose_ros.runtime.cuda_engine.CudaEngine', Stranger)
    monkeypatch.setattr('hand_pose_ros.runtime.cuda_engine.TorchEngine', lambda pipeline, _='': TorchEngine(pipeline))
    network = load_checkpoint(name).network
    engine = make_engine(network, 'cuda')
    assert engine.name == used
    assert said in caplog.text and bool(said) == ('a hand takes longer' in caplog.text)
    assert len(set(caplog.messages)) == len(caplog.messages)
    if used == 'pytorch':
        patches = hand_patches(1)
        np.testing.assert_array_equal(engine.run(patches), TorchEngine(Pipeline(network).eval()).run(patches))


@pytest.mark.skipif(not hasattr(torch.backends.cudnn, 'conv'), reason='PyTorch knows these settings since 2.9')
@pytest.mark.parametrize(('all_of_it', 'convolutions'), [('none', 'tf32'), ('none', 'ieee'), ('tf32', 'tf32')])
def test_convolutions_are_exact_whatever_a_program_has_chosen_which_stays(all_of_it, convolutions):
    backends, conv = torch.backends, torch.backends.cudnn.conv
    before = backends.fp32_precision, conv.fp32_precision
    backends.fp32_precision, conv.fp32_precision = all_of_it, convolutions
    try:
        with pytest.raises(ValueError, match='a capture'), exact_convolutions():
            assert conv.fp32_precision == 'ieee'
            assert not backends.cudnn.allow_tf32  # nor does reading it, as convolutions do, find the two at odds
            raise ValueError('a capture that fails')
        assert (backends.fp32_precision, conv.fp32_precision) == (all_of_it, convolutions)
    finally:
        backends.fp32_precision, conv.fp32_precision = before


@pytest.mark.skipif(not torch.cuda.is_available(), reason='needs a CUDA GPU')
@pytest.mark.parametrize('refiner', [None, 'or_ref'])
@pytest.mark.parametrize('architecture', ARCHITECTURES)
def test_the_gpu_engine_equals_plain_pytorch(architecture, refiner, caplog):
    network = trained(architecture)
    second = trained_refiner(refiner) if refiner else None
    engine = make_engine(network, 'cuda', refiner=second)
    assert engine.name == 'cuda graph' and 'takes longer' not in caplog.text
    plain = TorchEngine(Pipeline(network, second))
    many = [LARGEST + 3] if architecture == 'deep_prior' else []
    for count in [1, 3, 2, 9, *many]:  # graphs of 1, 4, 2 and 16, and of the largest
        patches = hand_patches(count, seed=count)
        assert_equal_in_half_precision(engine.run(patches), plain.run(patches), architecture)


@pytest.mark.parametrize('refiner', [None, 'or_ref'])
@pytest.mark.parametrize('architecture', ARCHITECTURES)
def test_half_precision_changes_no_joint_by_half_a_millimetre(architecture, refiner):
    """What the GPU engine computes, as far as arithmetic goes, for machines without a GPU."""
    second = trained_refiner(refiner) if refiner else None
    expected, answer = in_both_precisions(trained(architecture), second, hand_patches(3))
    assert_equal_in_half_precision(answer, expected, architecture)


def in_both_precisions(network: nn.Module, refiner: nn.Module | None, patches: np.ndarray) -> tuple[np.ndarray, ...]:
    pipeline = Pipeline(network, refiner).requires_grad_(False).eval()
    halved = copy.deepcopy(pipeline)
    fuse(halved.network)
    with torch.inference_mode():
        expected, answer = (each(torch.from_numpy(patches))[0] for each in (pipeline, halved.reduce_precision()))
    assert answer.dtype == torch.float32
    return expected.numpy(), answer.numpy()


@pytest.fixture(scope='module')
def hands():
    return open_dataset('synthetic', 'val').batch(torch.arange(24))


@pytest.mark.parametrize('name', ['deep_prior', 'deep_prior_orref', 'hand_dense'])
def test_weights_that_ship_are_as_good_in_half_precision(name, hands):
    """On hands: what grows in training may be more than a half can hold, and random weights do not show it."""
    checkpoint = load_checkpoint(name)
    expected, answer = in_both_precisions(checkpoint.network, checkpoint.refiner, hands['patch'].numpy())
    moved_mm = np.linalg.norm(answer - expected, axis=-1)[hands['hand_present'].numpy()] * MM_PER_UNIT
    assert moved_mm.mean() < 0.1
    # A view of the second look that is rounded another way is another view, and may tell another millimetre.
    assert (moved_mm.max(axis=1) < 0.5).mean() > 0.95


@pytest.mark.parametrize('name', ['deep_prior', 'deep_prior_orref', 'hand_dense'])
def test_rounding_alone_is_not_taken_for_an_engine_that_is_wrong(name, monkeypatch):
    checkpoint = load_checkpoint(name)
    pipeline = Pipeline(checkpoint.network, checkpoint.refiner).requires_grad_(False).eval()
    halved = copy.deepcopy(pipeline)
    fuse(halved.network)
    monkeypatch.setattr(cuda_engine, 'ROUNDING', cuda_engine.ROUNDING / 2)
    assert cuda_engine._agree(TorchEngine(halved.reduce_precision()), TorchEngine(pipeline))


class OnGpu(torch.Tensor):
    """A stand-in."""

    is_cuda = True


@pytest.mark.parametrize('cudnn', ['', 'can', 'cannot'])
def test_fused_layers_give_what_the_layers_give(cudnn, monkeypatch):
    """Also on a GPU, with a cuDNN that fuses them and with one that does not; here with stand-ins."""
    asked = []

    def convolution_relu(x, *sizes, added=0):
        asked.append(x)
        if cudnn == 'cannot':
            raise RuntimeError('no engine')
        return F.relu(F.conv2d(x, *sizes) + added)

    def convolution_add_relu(x, weight, added, alpha, *sizes):
        assert added.shape[1] == weight.shape[0] and alpha == 1
        return convolution_relu(x, weight, *sizes, added=added)

    monkeypatch.setattr(torch, 'cudnn_convolution_relu', convolution_relu)
    monkeypatch.setattr(torch, 'cudnn_convolution_add_relu', convolution_add_relu)
    network = trained('two_looks')
    fused, patches = copy.deepcopy(network), torch.from_numpy(hand_patches(3))
    fuse(fused)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in fused.modules())
    with torch.inference_mode():
        shown = patches.as_subclass(OnGpu) if cudnn else patches
        for _ in range(2):  # what cannot be is asked for once
            torch.testing.assert_close(torch.Tensor(fused(shown)), network(patches), atol=1e-4, rtol=0)
    once = 2 * (1 + 8 + 1)  # the stem, two in each of four blocks, and what fuses their maps, of two looks
    assert len(asked) == {'': 0, 'can': 2 * once, 'cannot': once}[cudnn]


@pytest.fixture
def groups(monkeypatch):
    """What is measured together: the answers of the calls, and their times."""
    measured, measure = [], timing.measure

    def kept(calls, rounds):
        answers = {}
        times = measure({name: functools.partial(lambda name: answers.update({name: calls[name]()}), name)
                         for name in calls}, rounds)
        measured.append((answers, times))
        return times

    monkeypatch.setattr(timing, 'measure', kept)
    return measured


@pytest.mark.timeout(300)  # nine seconds of CPU time, whatever else the machine does
def test_bench_measures_every_kind_of_row(tmp_path, capsys, monkeypatch, weights, groups):
    hands, estimate = set(), HandPoseEstimator.__call__

    def noted(estimator, depth, intrinsics):
        found = estimate(estimator, depth, intrinsics)
        hands.add((depth.shape, len(found)))
        return found

    monkeypatch.setattr(HandPoseEstimator, '__call__', noted)
    file = tmp_path / 'speed.json'
    assert main(['bench', '--quick', '--threads', '1', '--model', str(weights), '--json', str(file)]) == 0
    told = json.loads(file.read_text())
    rows = told['rows']
    assert told['machine']['threads'] == torch.get_num_threads() == 1
    lines = capsys.readouterr().out.splitlines()
    columns = ['p50_ms', 'p99_ms', 'min_ms', 'cpu_ms']
    assert lines[1].split() == columns
    for line, (name, row) in zip(lines[2:], rows.items(), strict=True):
        numbers = [f'{row[column]:.3f}' if column in row else '-' for column in columns]
        assert line.split() == [*name.split(), *numbers]
        assert 0 < row['min_ms'] <= row['p50_ms'] <= row['p99_ms'] and row.get('calls', 10) == 10
    frames = ('deep_prior', 'deep_prior_orref', 'hand_dense', 'deep_prior, searching', 'hand_dense, searching', weights)
    assert {f'frame {name}' for name in frames} | {
        f'stage {name}: {stage}' for name in frames for stage in ('decode', 'detect', 'crop', 'predict', 'uncrop')
    } | {f'network {name}: {how}' for name in ('deep_prior', 'hand_dense')
         for how in ('engine', 'pytorch', 'onnxruntime, bare, spinning', 'engine, 8 hands', 'floor')} | {
        f'refine or_ref x2: {how}' for how in ('engine', 'pytorch, all joints at once', 'pytorch, joint by joint',
                                               'floor')} <= set(rows)
    assert not any('compile' in name for name in rows)
    assert hands == {((480, 640), 1)}, 'in every frame there is one hand'
    # A frame is the sum of its stages, but for what lies between them.
    stages = sum(rows[f'stage deep_prior: {stage}']['min_ms'] for stage in ('decode', 'detect', 'crop', 'predict'))
    assert stages <= rows['frame deep_prior']['p99_ms']
    # Each is another way to the same joints.
    for answers in groups[0][0], groups[2][0], groups[4][0]:
        eight, expected = answers.pop('engine, 8 hands', None), answers['engine']
        for how, answer in answers.items():
            answer = answer[0] if isinstance(answer, list) else answer
            assert np.asarray(answer) == pytest.approx(expected, abs=1e-4), how
        assert eight is None or eight == pytest.approx(expected.repeat(8, 0), abs=1e-4)
    # Counted by hand: 6.4 million multiply-adds, 2.08 million weights.
    floor = rows['network deep_prior: floor']
    assert floor['operations'] == pytest.approx(2 * 6.4e6, rel=0.05)
    assert floor['weights'] == 2_076_959
    for name, (answers, times), reads in (('network deep_prior', groups[1], 1), ('refine or_ref x2', groups[5], 2)):
        floor = rows[f'{name}: floor']
        assert 512 * answers['read'].numel() == pytest.approx(floor['weights'], abs=512)
        assert floor['memory_ms'] == pytest.approx(reads * times['read']['min_ms'])
        multiply_adds = 512 ** 3 / times['multiply']['min_ms'] * floor['compute_ms']
        assert floor['operations'] == pytest.approx(2 * multiply_adds)
        assert floor['p50_ms'] == max(floor['memory_ms'], floor['compute_ms'])


def test_bench_tells_what_is_wrong_before_it_measures(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(timing, 'measure', lambda *_, **__: pytest.fail('it measured'))
    for option, value, message in (('--model', 'lost.safetensors', 'lost.safetensors'),
                                   ('--json', tmp_path, 'is a folder')):
        assert main(['bench', '--quick', option, str(value)]) == 1
        assert message in capsys.readouterr().err
