"""Draw a slice through a building in layover: phases, Capon's points and reconstructed ones, from one look of 8 passes.

Run as `python docs/draw_stacks.py`, or with the other figures as `make figures`. Writes docs/images/stacks.png.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh

from sarsplat import ImageGrid, ScatteringLaw, Stack, View, reconstruct, simulate_stack
from sarsplat.colours import PHASE, POWER, colormap
from sarsplat.data import Dataset, DatasetEntry
from sarsplat.evaluation.capon import capon_points
from sarsplat.radiometry import to_db

PICTURE = Path(__file__).parent / "images" / "stacks.png"
GRID, VIEW, NOISE = ImageGrid(48, 48, (0.5, 0.5), (0.6, 0.6)), View(0.0, 45.0), 0.1
STACK = Stack(0.031, tuple(0.003875 * (k / 7 - 0.5) for k in range(8)), noise=(NOISE,) * 8)  # 4 m of resolution
DEPTH, WIDTH, HEIGHT = 10.0, 12.0, 10.0
SLICE_M = 2.0


def stacks() -> Dataset:
    """One look at a building on ground."""
    house = trimesh.creation.box((DEPTH, WIDTH, HEIGHT))
    house.apply_translation((0.0, 0.0, HEIGHT / 2))
    law = ScatteringLaw(floor=1.0, lobe=0.0, exponent=1.0)
    signal = simulate_stack(house, VIEW, GRID, STACK, law, ground_gamma0=1.0, noise=NOISE)
    entry = DatasetEntry(VIEW, "train", "one look", stack=STACK)
    return Dataset.of_complex(GRID, (entry,), signal[None], looks=1.0, ground=True, target="building")


def main() -> None:
    dataset = stacks()
    assert dataset.signal is not None
    own = reconstruct(dataset).points
    capon = capon_points(dataset, float(own[:, 2].min()), float(own[:, 2].max()))
    phases = STACK.plane_phases(VIEW, GRID)
    pair = dataset.signal[0] * np.exp(-1j * phases)
    figure, panels = plt.subplots(1, 4, figsize=(15, 4), layout="constrained")
    panels[0].imshow(to_db(dataset.power[0], 1.0), cmap=colormap(POWER), vmin=-15, vmax=10, interpolation="nearest")
    panels[1].imshow(np.angle(pair[4] * pair[3].conj()), cmap=colormap(PHASE), interpolation="nearest")
    for axes, title in zip(panels, ("power: layover, roof, shadow", "phase of one pair, level ground taken out")):
        axes.set(xticks=[], yticks=[], title=title)
    for axes, points, title in zip(panels[2:], (capon, own), ("Capon, 3 × 3 pixels", "sarsplat")):
        inside = np.abs(points[:, 1]) < SLICE_M
        axes.plot([-12, -5, -5, 5, 5, 16], [0, 0, HEIGHT, HEIGHT, 0, 0], color="0.6", linewidth=3)
        axes.scatter(points[inside, 0], points[inside, 2], s=3, color="C3")
        axes.set(
            xlim=(-13, 17), ylim=(-2, 16), aspect="equal", title=title, xlabel="towards the radar, m", ylabel="z, m"
        )
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    main()
