"""How fast a CUDA GPU runs the weights that ship: `python benchmarks/gpu.py` takes one minute.

Each network is timed in four ways, in turn: the engine from array to array, its CUDA graph with the copies to and from
pinned memory, the graph alone (without copies, the mean of many replays in a row), and plain PyTorch on the GPU. Large
batches follow, in hands per second, from float32 patches in host memory to joints there.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable
from pathlib import Path

import torch

from hand_pose_ros.files import write_json
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.runtime import make_engine
from hand_pose_ros.runtime.cuda_engine import WARM_UP, CudaEngine, exact_convolutions
from hand_pose_ros.runtime.engine import Pipeline, TorchEngine
from hand_pose_ros.runtime.timing import measure, some_patches

NAMES = ('deep_prior', 'deep_prior_orref', 'hand_dense')
BATCHES = (64, 1024, 4096)


def graph_alone(engine: CudaEngine, replays: int = 500) -> float:
    """Milliseconds of a replay whose input and output stay on the GPU."""
    source, stream = some_patches(1).to(engine.device, engine.pipeline.precision), engine.streams[0]
    with torch.inference_mode(), torch.cuda.stream(stream), exact_convolutions():
        for _ in range(WARM_UP):
            engine.pipeline(source)
        stream.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream):
            engine.pipeline(source)
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        graph.replay()
        start.record()
        for _ in range(replays):
            graph.replay()
        end.record()
        end.synchronize()
    return start.elapsed_time(end) / replays


def with_copies(engine: CudaEngine) -> Callable[[], None]:
    """A replay as the engine does it. The input is already in pinned memory."""
    captured = engine.captured_for(1)

    def call() -> None:
        captured.start()
        captured.done.synchronize()
    return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the rows there too')
    args = parser.parse_args()
    rows: dict[str, dict[str, float]] = {}
    one, many = some_patches(1).numpy(), {f'{count} hands': some_patches(count).numpy() for count in BATCHES}
    for name in NAMES:
        checkpoint = load_checkpoint(name)
        engine = make_engine(checkpoint.network, 'cuda', refiner=checkpoint.refiner)
        assert isinstance(engine, CudaEngine)
        plain = TorchEngine(Pipeline(checkpoint.network, checkpoint.refiner), 'cuda')
        made = measure({'engine': lambda engine=engine: engine.run(one), 'graph with copies': with_copies(engine),
                        'pytorch': lambda plain=plain: plain.run(one)}, rounds=30)
        made['graph alone'] = {'p50_ms': graph_alone(engine)}
        batches = measure({how: lambda engine=engine, hands=hands: engine.run(hands) for how, hands in many.items()},
                          rounds=1)
        made |= {how: {**row, 'hands_per_s': 1000 * len(many[how]) / row['p50_ms']} for how, row in batches.items()}
        rows |= {f'{name}: {how}': row for how, row in made.items()}
    machine = {'gpu': torch.cuda.get_device_name(), 'torch': torch.__version__, 'python': platform.python_version()}
    print(', '.join(f'{key} {value}' for key, value in machine.items()))
    for name, row in rows.items():
        print(f'{name:38s}' + '  '.join(f'{key} {value:.3f}' for key, value in row.items() if key != 'cpu_ms'))
    if args.json:
        write_json(args.json, {'machine': machine, 'rows': rows})


if __name__ == '__main__':
    main()
