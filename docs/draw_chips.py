"""Draw measured chips that were left out of training, and below each a generated one from the same side.

Run as `python docs/draw_chips.py RUN … --chips FOLDER --labels TABLE`, with runs of datasets that `import mstar` has
made of these chips. Writes docs/images/chips.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sarsplat import Run, View
from sarsplat.colours import POWER, colormap
from sarsplat.importers.mstar_chips import Chip, read_chips
from sarsplat.samples import Encoding

PICTURE = Path(__file__).parent / "images" / "chips.png"
AZIMUTHS = (15, 75, 135, 225, 315)
"""Azimuths of the target, degrees: half-way between training chips, each replaced by that of the nearest chip."""
SIDE, INCHES, DPI = 80, 0.8, 100
BLOCKS = 2
"""Number of blocks of runs beside each other."""


def main() -> None:
    """Read the command line, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--chips", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--labels", type=Path, required=True, metavar="TABLE")
    parser.add_argument("--out", type=Path, default=PICTURE, metavar="FILE")
    arguments = parser.parse_args()
    every = [drawn(Run.load(run), arguments.chips, arguments.labels) for run in arguments.runs]
    lines, wide = 2 * -(-len(every) // BLOCKS), len(AZIMUTHS)
    size = (INCHES * BLOCKS * wide, INCHES * lines)
    figure, axes = plt.subplots(lines, BLOCKS * wide, figsize=size, squeeze=False)
    for place in axes.flat:
        place.axis("off")
    for number, (title, pairs) in enumerate(every):
        block, line = divmod(number, lines // 2)
        for column, pair in enumerate(pairs):
            for below, image in enumerate(pair):
                place = axes[2 * line + below, block * wide + column]
                place.imshow(np.sqrt(image / 255), cmap=colormap(POWER), vmin=0, vmax=1, interpolation="nearest")
        axes[2 * line, block * wide].text(3, 10, title, color="white", fontsize=8)
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1, wspace=0.02, hspace=0.02)
    figure.savefig(arguments.out, dpi=DPI)


def drawn(run: Run, folder: Path, labels: Path) -> tuple[str, list[tuple[np.ndarray, np.ndarray]]]:
    """The class, and pairs of a measured and a generated chip: digital numbers, near range at the bottom."""
    dataset = run.dataset
    trained, depressions = {entry.name for entry in dataset.entries}, dataset.source["train_depression_deg"]
    every = read_chips(folder, labels, dataset.target)
    left_out = [chip for chip in every if chip.depression in depressions and chip.name not in trained]
    chosen = [min(left_out, key=lambda chip: away(chip, azimuth)) for azimuth in AZIMUTHS]
    encoding, pairs = Encoding(crop=SIDE), []
    for seed, chip in enumerate(chosen):
        measured = middle(chip.magnitude)
        sample = run.sample(View(-chip.target_az_deg % 360, chip.grazing_deg), seed)
        pairs.append((255 / measured.max() * measured, encoding.stored(sample, run.brightest)))
    return dataset.target, pairs


def away(chip: Chip, azimuth_deg: float) -> float:
    """Degrees between a chip's azimuth and another."""
    return abs((chip.target_az_deg - azimuth_deg + 180) % 360 - 180)


def middle(image: np.ndarray) -> np.ndarray:
    """Central square of an image."""
    top, left = ((size - SIDE) // 2 for size in image.shape)
    return image[top : top + SIDE, left : left + SIDE]


if __name__ == "__main__":
    main()
