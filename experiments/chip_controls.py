"""Test chips in front of other clutter: what a network knows of places instead of targets does not help it there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from chip_arms import ENCODING
from chip_draws import Draw, Measured, middle, runs
from chip_statistics import CLUTTER, apart

from sarsplat import View
from sarsplat.scenes.scattering import ResponseSpeckle


def new_clutter(measured: Measured, which: np.ndarray, draw: Draw, work: Path) -> np.ndarray:
    """Chips with speckle of the same level in place of their clutter, by masks of a draw's runs; made once.

    Chips of unknown azimuth stay as they are. uint8 [n, SIDE, SIDE].
    """
    path = work / draw.name.replace(" ", "-") / "new-clutter.npy"
    if not path.exists():
        made = measured.pixels[which].copy()
        for number, run in enumerate(runs(measured, draw, work)):
            speckle = ResponseSpeckle(run.grid)
            own = (measured.of_class[which] == number) & np.isfinite(measured.azimuth_deg[which])
            views = [
                View(-azimuth % 360, grazing)
                for azimuth, grazing in zip(
                    measured.azimuth_deg[which][own], measured.grazing_deg[which][own], strict=True
                )
            ]
            clutter = middle(apart(run.masks(views))) == CLUTTER
            for place, mask in zip(np.flatnonzero(own), clutter, strict=True):
                made[place] = _replaced(made[place], mask, speckle, np.random.default_rng([number, int(place)]))
        unfinished = path.with_suffix(".tmp.npy")
        np.save(unfinished, made)
        unfinished.replace(path)
    return np.load(path)


def _replaced(
    pixels: np.ndarray, clutter: np.ndarray, speckle: ResponseSpeckle, chance: np.random.Generator
) -> np.ndarray:
    """With speckle where there is clutter, of the same median, and compressed as it was."""
    drawn = np.abs(middle(speckle.draw(chance)))
    level = np.median(pixels[clutter]) / np.median(drawn[clutter])
    mixed = np.where(clutter, level * drawn, pixels).clip(0, 255)
    return ENCODING.stored(mixed.astype(np.complex64), float(mixed.max()) ** 2)
