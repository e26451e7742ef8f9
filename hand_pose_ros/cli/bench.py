"""`hand-pose bench`: how fast this machine runs networks, refinement, every stage and whole frames."""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_pose_ros.cli.arguments import count

if TYPE_CHECKING:
    from torch import Tensor, nn

    from hand_pose_ros.estimator import HandPoseEstimator
    from hand_pose_ros.runtime.engine import Pipeline

DESCRIPTION = 'Measure how fast this machine runs the networks, the refinement, every stage and whole frames.'

EXAMPLES = """examples:
  hand-pose bench
  hand-pose bench --json speed.json --threads 1
  hand-pose bench --model my.safetensors --quick

Networks and frames are those of the weights that ship. All rows of a group run in turn, round by round, so that
other work on the machine affects them equally. floor is the larger of two times, both measured in the same run: the
operations at the rate of a large matrix product, and the weights read once by a matrix-vector product. cpu_ms is the
CPU time of a call in all threads; with --threads 1 it is what the call takes when nothing else runs.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('--json', type=Path, metavar='FILE', help='also write the rows to this file')
    parser.add_argument('--model', help='also measure whole frames with these weights (a name or a path)')
    parser.add_argument('--threads', type=count, metavar='N', help='threads for the networks (by the number of cores)')
    parser.add_argument('--rounds', type=count, default=20, metavar='N',
                        help='rounds of 10 calls for each row (%(default)s)')
    parser.add_argument('--quick', action='store_true',
                        help='one round, and without torch.compile, which takes a minute')


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, write the JSON."""
    import onnxruntime
    import torch

    from hand_pose_ros import __version__
    from hand_pose_ros.evaluation.tables import number, text_table
    from hand_pose_ros.files import check_writable, write_json
    from hand_pose_ros.models.checkpoints import load_checkpoint
    from hand_pose_ros.runtime import default_threads, make_engine

    if args.json:  # now, not after minutes of work
        check_writable(args.json)
    if args.model:
        make_engine(load_checkpoint(args.model).network, 'cpu', 1)
    threads = args.threads or default_threads()
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    rounds = 1 if args.quick else args.rounds
    rows: dict[str, dict[str, float]] = {}
    with torch.inference_mode():
        for name in ('deep_prior', 'hand_dense'):
            rows |= _network_rows(name, threads, rounds, compiled=not args.quick)
        rows |= _refiner_rows('or_ref', threads, rounds)
        rows |= _frame_rows(args.model, threads, rounds)
    machine = {
        'cpu': _cpu_name(), 'cores': os.cpu_count(), 'threads': threads, 'python': platform.python_version(),
        'torch': torch.__version__, 'onnxruntime': onnxruntime.__version__, 'hand_pose_ros': __version__}
    print(', '.join(f'{key} {value}' for key, value in machine.items()))
    columns = ('p50_ms', 'p99_ms', 'min_ms', 'cpu_ms')
    print(text_table(('', *columns), [(name, *(number(row.get(column), 3) for column in columns))
                                      for name, row in rows.items()]))
    if args.json:
        write_json(args.json, {'machine': machine, 'rows': rows})
    return 0


def _network_rows(name: str, threads: int, rounds: int, compiled: bool) -> dict[str, dict[str, float]]:
    """One network on one patch, in every way to run it."""
    import numpy as np
    import torch

    from hand_pose_ros.models.checkpoints import load_checkpoint
    from hand_pose_ros.runtime import make_engine
    from hand_pose_ros.runtime.engine import Pipeline, TorchEngine
    from hand_pose_ros.runtime.timing import measure, some_patches

    pipeline = Pipeline(load_checkpoint(name).network).eval()  # the export restores the mode of the whole
    patch = some_patches(1)
    array = patch.numpy()
    engine = make_engine(pipeline.network, 'cpu', threads)
    eight = np.repeat(array, 8, axis=0)
    plain = TorchEngine(pipeline)
    calls: dict[str, Callable[[], Any]] = {
        'engine': lambda: engine.run(array),
        'pytorch': lambda: plain.run(array),
        **_references(pipeline, array, threads),
    }
    if compiled:
        fast = torch.compile(pipeline)
        try:
            fast(patch)
            calls['torch.compile'] = lambda: fast(patch)
        except Exception as error:  # a missing or old compiler can cause any error
            print(f'torch.compile does not work here: {str(error).splitlines()[0]}')
    calls['engine, 8 hands'] = lambda: engine.run(eight)
    rows = {**measure(calls, rounds), 'floor': _floor(pipeline, (patch,))}
    return {f'network {name}: {how}': row for how, row in rows.items()}


def _references(pipeline: Pipeline, array: Any, threads: int) -> dict[str, Callable[[], Any]]:
    """The same graph in ONNX Runtime with its own defaults, and in OpenVINO if it is installed."""
    import onnxruntime

    from hand_pose_ros.runtime.onnx_engine import export

    model = export(pipeline)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model, options, providers=['CPUExecutionProvider'])
    calls: dict[str, Callable[[], Any]] = {'onnxruntime, bare, spinning': lambda: session.run(None, {'patches': array})}
    try:
        import openvino
    except ImportError:
        return calls
    core = openvino.Core()
    compiled = core.compile_model(core.read_model(model, b''), 'CPU', {
        'INFERENCE_NUM_THREADS': threads, 'PERFORMANCE_HINT': 'LATENCY'})
    calls['openvino'] = lambda: compiled(array)
    return calls


def _refiner_rows(architecture: str, threads: int, rounds: int) -> dict[str, dict[str, float]]:
    """21 joints, 2 iterations, without the network that gives the first estimate."""
    import torch
    from torch import nn

    from hand_pose_ros.models import build
    from hand_pose_ros.runtime import make_engine
    from hand_pose_ros.runtime.engine import Pipeline, TorchEngine
    from hand_pose_ros.runtime.timing import measure, some_patches

    class Still(nn.Module):
        """Estimates that cost nothing."""

        def forward(self, patches: Tensor) -> Tensor:
            return patches[:, 0, ::6, :3][:, :21] * 0.3

    refiner = build(architecture).eval()
    alone = [refiner.for_joint(joint) for joint in range(21)]  # type: ignore[operator]
    patch = some_patches(1)
    array, joints = patch.numpy(), Still()(patch)
    plain, engine = TorchEngine(Pipeline(Still(), refiner)), make_engine(Still(), 'cpu', threads, refiner)

    def joint_by_joint() -> Tensor:
        return torch.cat([network(patch, joints[:, j:j + 1]) for j, network in enumerate(alone)], dim=1)

    rows = measure({'engine': lambda: engine.run(array), 'pytorch, all joints at once': lambda: plain.run(array),
                    'pytorch, joint by joint': joint_by_joint}, rounds)
    rows['floor'] = _floor(refiner, (patch, joints), reads=2)
    return {f'refine {architecture} x2: {name}': row for name, row in rows.items()}


def _frame_rows(model: str | None, threads: int, rounds: int) -> dict[str, dict[str, float]]:
    """Whole frames and their stages, from a VGA image of 16-bit integers to joints in metres.

    The hand is tracked, except in the rows `searching`.
    """
    from hand_pose_ros.depth import to_metres, to_units
    from hand_pose_ros.estimator import HandPoseEstimator
    from hand_pose_ros.runtime.timing import WARM_UP, measure, summary

    depth, intrinsics = _vga_frame()
    units = to_units(depth)

    def estimator(name: str, **options: Any) -> HandPoseEstimator:
        return HandPoseEstimator.from_pretrained(name, device='cpu', num_threads=threads, side='right', min_score=-1,
                                                 **options)

    estimators = {name: estimator(name) for name in ('deep_prior', 'deep_prior_orref', 'hand_dense')} | {
        'deep_prior, searching': estimator('deep_prior', tracking=False, detector='nearest'),
        'hand_dense, searching': estimator('hand_dense', tracking=False)}
    if model:
        estimators[model] = estimator(model)
    stages: dict[str, list[float]] = {}

    def frame(name: str) -> Callable[[], None]:
        def call() -> None:
            start = time.perf_counter()
            metres = to_metres(units)
            decoded = time.perf_counter() - start
            estimators[name](metres, intrinsics)
            for stage, seconds in {'decode': decoded, **estimators[name].timings}.items():
                stages.setdefault(f'stage {name}: {stage}', []).append(seconds)
        return call

    rows = measure({f'frame {name}': frame(name) for name in estimators}, rounds)
    for name, seconds in stages.items():
        rows[name] = summary(seconds[WARM_UP:])
    return rows


def _floor(module: nn.Module, inputs: tuple[Tensor, ...], reads: int = 1) -> dict[str, float]:
    """A row with the least time that the operations and the weights of a module need here, and with both parts."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    from hand_pose_ros.runtime.timing import measure

    with FlopCounterMode(display=False) as counter:
        module(*inputs)
    operations, weights = counter.get_total_flops(), sum(p.numel() for p in module.parameters())
    side = 512
    square, matrix = torch.rand(side, side), torch.rand(-(-weights // side), side)
    times = measure({'multiply': lambda: square @ square, 'read': lambda: matrix @ square[0]}, rounds=3)
    # The minimum, because nothing is faster than a floor.
    compute = times['multiply']['min_ms'] * operations / (2 * side ** 3)
    memory = times['read']['min_ms'] * reads
    floor = max(compute, memory)
    return {'p50_ms': floor, 'p99_ms': floor, 'min_ms': floor, 'compute_ms': compute, 'memory_ms': memory,
            'operations': operations, 'weights': weights}


def _vga_frame() -> tuple[Any, Any]:
    """A rendered hand before a room, 640 x 480, in metres, and the intrinsics."""
    import itertools

    from hand_pose_ros.detection import detect
    from hand_pose_ros.synthetic.generator import SyntheticHands

    hands = SyntheticHands('train')
    frames = (hands.full_frame(index) for index in itertools.count())
    return next((depth, intrinsics) for depth, intrinsics, _, side in frames
                if depth.shape == (480, 640) and side != 'none' and detect(depth, intrinsics))


def _cpu_name() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
        return next(line.split(': ')[1] for line in lines if line.startswith('model name'))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
