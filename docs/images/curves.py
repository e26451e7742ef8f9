"""Draws curves.webp: mean error in validation over the last stages of hand_dense, from curves.json.

    python docs/images/curves.py

curves.json holds, for each look and each of its stages, what `metrics.jsonl` of the run says: samples and val_mm. A
stage begins with what the network had that it goes on from.
"""

import argparse
import json
from io import BytesIO
from pathlib import Path

from matplotlib import pyplot
from PIL import Image


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    looks = json.loads(Path(__file__).with_suffix('.json').read_text())
    figure, panels = pyplot.subplots(1, len(looks), figsize=(11, 3), layout='constrained')
    for panel, (look, stages) in zip(panels, looks.items(), strict=True):
        for stage, points in stages.items():
            samples, errors = zip(*points, strict=True)
            panel.plot([count / 1e6 for count in samples], errors, marker='.', label=stage)
        panel.set(title=look, xlabel='million samples', ylabel='mm in validation')
        panel.grid(alpha=0.3)
        panel.legend()
    png = BytesIO()
    figure.savefig(png, dpi=90)
    Image.open(png).convert('RGB').save(Path(__file__).with_suffix('.webp'), quality=85)


if __name__ == '__main__':
    main()
