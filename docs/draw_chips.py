"""Draw measured chips that were left out of training, and below each a generated one from the same side.

Run as `python docs/draw_chips.py RUN … --chips FOLDER --labels TABLE`, with runs of datasets that `import mstar` has
made of these chips, which are JPEGs on one scale. Writes docs/images/chips.png.
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
AZIMUTHS = (15, 75, 135, 195, 255, 315)
"""Of the target, degrees, as near as there are chips: half-way between training chips."""
SIDE, PIXELS, DPI = 88, 1.05, 90


def main() -> None:
    """Read the command line, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--chips", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--labels", type=Path, required=True, metavar="TABLE")
    parser.add_argument("--out", type=Path, default=PICTURE, metavar="FILE")
    arguments = parser.parse_args()
    rows = [row for run in arguments.runs for row in drawn(Run.load(run), arguments.chips, arguments.labels)]
    figure, axes = plt.subplots(len(rows), len(AZIMUTHS), figsize=(PIXELS * len(AZIMUTHS), PIXELS * len(rows)))
    for line, (title, images) in zip(axes, rows, strict=True):
        line[0].set_ylabel(title, fontsize=7)
        for place, image in zip(line, images, strict=True):
            place.imshow(np.sqrt(image / 255), cmap=colormap(POWER), vmin=0, vmax=1, interpolation="nearest")
            place.set(xticks=[], yticks=[])
    figure.subplots_adjust(left=0.05, right=1, bottom=0, top=1, wspace=0.03, hspace=0.03)
    figure.savefig(arguments.out, dpi=DPI)


def drawn(run: Run, folder: Path, labels: Path) -> list[tuple[str, list[np.ndarray]]]:
    """A row of measured chips and one of generated ones: digital numbers, near range at the bottom."""
    dataset = run.dataset
    trained, depressions = {entry.name for entry in dataset.entries}, dataset.source["train_depression_deg"]
    every = read_chips(folder, labels, dataset.target)
    left_out = [chip for chip in every if chip.depression in depressions and chip.name not in trained]
    chosen = [min(left_out, key=lambda chip: away(chip, azimuth)) for azimuth in AZIMUTHS]
    measured = [middle(chip.magnitude) for chip in chosen]
    encoding, generated = Encoding(crop=SIDE, scale="fixed"), []
    for seed, chip in enumerate(chosen):
        sample = run.sample(View(-chip.target_az_deg % 360, chip.grazing_deg), seed)
        generated.append(encoding.stored(sample, run.brightest))
    return [(f"{dataset.target}, measured", measured), (f"{dataset.target}, generated", generated)]


def away(chip: Chip, azimuth_deg: float) -> float:
    """Degrees between a chip's azimuth and another."""
    return abs((chip.target_az_deg - azimuth_deg + 180) % 360 - 180)


def middle(image: np.ndarray) -> np.ndarray:
    """What is cut out of an image."""
    top, left = ((size - SIDE) // 2 for size in image.shape)
    return image[top : top + SIDE, left : left + SIDE]


if __name__ == "__main__":
    main()
