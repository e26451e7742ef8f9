"""Draws failures_NAME.webp: what a network makes of synthetic-test-v1, from good to bad frames.

    python docs/images/failures.py hand_dense deep_prior
"""

import argparse
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hand_pose_ros.datasets import open_dataset
from hand_pose_ros.evaluation.benchmark_evaluation import evaluate_benchmark
from hand_pose_ros.training.figures import qualitative

FRAMES = 1000
SHARES = (0.25, 0.5, 0.75, 0.9, 0.97, 1.0)
"""Of the frames, as many are no worse than the one that is shown."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('models', nargs='+', metavar='NAME', help='of weights that ship')
    models, hands = parser.parse_args().models, open_dataset('synthetic', 'test')
    batches = [hands.batch(numbers) for numbers in torch.arange(FRAMES).split(hands.chunk)]
    for model in models:
        result = evaluate_benchmark(model, 'cpu', FRAMES)
        order = np.argsort(result.errors_mm.mean(axis=1))
        figure = qualitative(result, batches, order[[round(share * (len(order) - 1)) for share in SHARES]])
        png = BytesIO()
        figure.savefig(png, dpi=80)
        Image.open(png).convert('RGB').save(Path(__file__).with_name(f'failures_{model}.webp'), quality=80)


if __name__ == '__main__':
    main()
