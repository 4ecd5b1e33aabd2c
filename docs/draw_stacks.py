"""Reconstruct a building in layover from single looks: a table of three seeds beside Capon's method, and a slice.

Run as `python docs/draw_stacks.py`, or with the other figures as `make figures`; minutes. Writes the table of
docs/concepts/stacks.md and docs/images/stacks.png.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from fill_block import fill_block
from scipy.spatial import cKDTree

from sarsplat import ImageGrid, ScatteringLaw, Stack, View, preset, reconstruct, simulate_stack
from sarsplat.colours import PHASE, POWER, colormap
from sarsplat.data import Dataset, DatasetEntry
from sarsplat.evaluation.capon import capon_points
from sarsplat.evaluation.points import Yardstick, point_metrics
from sarsplat.evaluation.surface import VisibleSurface, imaged_alone, of_stacks, visible_surface
from sarsplat.radiometry import to_db

DOCS = Path(__file__).parent
GRID, NOISE = ImageGrid(48, 48, (0.5, 0.5), (0.6, 0.6)), 0.1
SPAN = 0.003875  # b/R: 4 m of resolution in elevation
EVEN, RULER = tuple(k / 7 - 0.5 for k in range(8)), tuple(k / 11 - 0.5 for k in (0, 1, 4, 9, 11))
SCENES = {"8 passes of one heading": (1, EVEN), "5 uneven passes of four headings": (4, RULER)}
SEEDS = (0, 1, 2)
HOUSE_M = (10.0, 12.0, 10.0)
YARDSTICK = Yardstick(0.75)  # m; its second threshold is 0.5
SLICE_M = 2.0


def house() -> trimesh.Trimesh:
    mesh = trimesh.creation.box(HOUSE_M)
    mesh.apply_translation((0.0, 0.0, HOUSE_M[2] / 2))
    return mesh


def stacks(headings: int, passes: tuple[float, ...], seed: int) -> Dataset:
    """One look of each pass at a building on ground."""
    stack = Stack(0.031, tuple(SPAN * offset for offset in passes), noise=(NOISE,) * len(passes))
    views = [View(360.0 / headings * k, 45.0) for k in range(headings)]
    law = ScatteringLaw(floor=1.0, lobe=0.0, exponent=1.0)
    signals = [
        simulate_stack(house(), view, GRID, stack, law, ground_gamma0=1.0, noise=NOISE, seed=100 * seed + k)
        for k, view in enumerate(views)
    ]
    entries = tuple(DatasetEntry(view, "train", f"{k}", stack=stack) for k, view in enumerate(views))
    return Dataset.of_complex(GRID, entries, np.stack(signals), looks=1.0, ground=True, target="building")


def true_surface(dataset: Dataset) -> VisibleSurface:
    mesh = of_stacks(house(), dataset)
    return imaged_alone(visible_surface(mesh, dataset.views, YARDSTICK.ray_spacing_m, samples=100_000), dataset)


def scores(points: np.ndarray, surface: VisibleSurface) -> tuple[float, float, float, float]:
    """F1 within 0.5 m, recall of walls, recall of the roof, and F1 within 0.75 m."""
    found = point_metrics(points, surface.triangles, surface.samples, YARDSTICK)
    far, near = YARDSTICK.thresholds_m[:2]
    height, distance = surface.samples[:, 2], cKDTree(points).query(surface.samples)[0]
    roof = height > HOUSE_M[2] - 1e-2
    wall = (height > near) & ~roof
    return found.f1[near], np.mean(distance[wall] <= near), np.mean(distance[roof] <= near), found.f1[far]


def main() -> None:
    rows, drawn = [], None
    for name, (headings, passes) in SCENES.items():
        of_seeds: dict[str, list[tuple[float, ...]]] = {"sarsplat": [], "Capon": []}
        for seed in SEEDS:
            dataset = stacks(headings, passes, seed)
            surface = true_surface(dataset)
            own = reconstruct(dataset, replace(preset("stack"), seed=seed), quiet=True).points
            capon = capon_points(dataset, float(own[:, 2].min()), float(own[:, 2].max()))
            of_seeds["sarsplat"].append(scores(own, surface))
            of_seeds["Capon"].append(scores(capon, surface))
            print(name, seed, of_seeds["sarsplat"][-1], of_seeds["Capon"][-1], flush=True)
            drawn = drawn or (dataset, capon, own)
        for method, values in of_seeds.items():
            cells = [" ".join(f"{value:.3f}" for value in column) for column in zip(*values, strict=True)]
            rows.append(f"| {name} | {method} | {' | '.join(cells)} |\n")
    head = "\n| | | F1, 0.5 m | walls found | roof found | F1, 0.75 m |\n|---|---|---|---|---|---|\n"
    fill_block(DOCS / "concepts" / "stacks.md", "stacks", head + "".join(rows) + "\n")
    assert drawn is not None
    draw(*drawn)


def draw(dataset: Dataset, capon: np.ndarray, own: np.ndarray) -> None:
    assert dataset.signal is not None
    ((stack, view),) = zip(dataset.stacks, dataset.views, strict=True)
    pair = dataset.signal[0] * np.exp(-1j * stack.plane_phases(view, GRID))
    figure, panels = plt.subplots(1, 4, figsize=(15, 4), layout="constrained")
    panels[0].imshow(to_db(dataset.power[0], 1.0), cmap=colormap(POWER), vmin=-15, vmax=10, interpolation="nearest")
    panels[1].imshow(np.angle(pair[4] * pair[3].conj()), cmap=colormap(PHASE), interpolation="nearest")
    for axes, title in zip(panels, ("power: layover, roof, shadow", "phase of one pair, level ground taken out")):
        axes.set(xticks=[], yticks=[], title=title)
    front, top = HOUSE_M[0] / 2, HOUSE_M[2]
    for axes, points, title in zip(panels[2:], (capon, own), ("Capon, 3 × 3 pixels", "sarsplat")):
        inside = np.abs(points[:, 1]) < SLICE_M
        axes.plot([-12, -front, -front, front, front, 16], [0, 0, top, top, 0, 0], color="0.6", linewidth=3)
        axes.scatter(points[inside, 0], points[inside, 2], s=3, color="C3")
        axes.set(
            xlim=(-13, 17), ylim=(-2, 16), aspect="equal", title=title, xlabel="towards the radar, m", ylabel="z, m"
        )
    figure.savefig(DOCS / "images" / "stacks.png", dpi=100)


if __name__ == "__main__":
    main()
