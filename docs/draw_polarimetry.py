"""Reconstruct four kinds of scattering from single looks in three polarisations: a table of three seeds, and a picture.

Run as `python docs/draw_polarimetry.py`, or with the other figures as `make figures`; minutes. Writes the table of
docs/how-to/polarimetry.md and docs/images/polarimetry.png.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from fill_block import fill_block

from sarsplat import ImageGrid, Mechanisms, Run, ScatteringLaw, Stack, View, preset, reconstruct, simulate_stack
from sarsplat.data import Dataset, DatasetEntry
from sarsplat.report.stacks import averaged, pauli

DOCS = Path(__file__).parent
GRID, NOISE, NAMES = ImageGrid(44, 44, (0.5, 0.5), (0.6, 0.6)), 0.05, ("HH", "HV", "VV")
VIEWS = [View(45.0 * k, 45.0) for k in range(8)]
SEEDS = (3, 4, 5)  # settings were chosen with others
BOXES = {"trihedral": ((-5.5, -5.5, 0.0), 3.0), "dihedral": ((3.0, -4.0, 0.0), 3.0), "volume": ((-1.5, 3.0, 1.5), 4.0)}
MATRICES = {  # E[y yᴴ] up to a factor: 2 HV² is the power of both cross-polarised channels
    "trihedral": [[0.5, 0, 0.48], [0, 0.01, 0], [0.48, 0, 0.5]],
    "dihedral": [[0.55, 0, -0.45], [0, 0.015, 0], [-0.45, 0, 0.42]],
    "volume": [[3 / 8, 0, 1 / 8], [0, 1 / 8, 0], [1 / 8, 0, 3 / 8]],
    "ground": [[0.45, 0, 0.35], [0, 0.025, 0], [0.35, 0, 0.5]],
}
OPEN = (((-9.0, -9.0), (9.0, -7.0)), ((-9.0, -7.0), (-7.0, 9.0)), ((7.5, -7.0), (9.0, 9.0)))
"""Corners of open ground, x and y."""
NEAR_M, LOW_M = 0.4, 0.5
"""Gaussians count within NEAR_M of a box, and higher than NEAR_M; those of open ground within LOW_M of z = 0."""


def dataset(seed: int) -> Dataset:
    """One look of eight headings, L band."""
    parts = [trimesh.creation.box((side,) * 3) for _, side in BOXES.values()]
    for part, (corner, side) in zip(parts, BOXES.values(), strict=True):
        part.apply_translation(np.array(corner) + side / 2)
    kinds = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    mechanisms = Mechanisms(kinds, len(parts), np.array([*MATRICES.values()], np.complex128), NAMES)
    stack = Stack(0.24, (0.0,) * 3, noise=(NOISE,) * 3, polarisations=NAMES)
    mesh, law = cast("trimesh.Trimesh", trimesh.util.concatenate(parts)), ScatteringLaw(2.0, 0.0, 1.0)
    signals = [
        simulate_stack(
            mesh, view, GRID, stack, law, ground_gamma0=0.7, mechanisms=mechanisms, noise=NOISE, seed=100 * seed + k
        )
        for k, view in enumerate(VIEWS)
    ]
    entries = tuple(DatasetEntry(view, "train", f"{k}", stack=stack) for k, view in enumerate(VIEWS))
    box = ((-13.0, -13.0, -1.5), (13.0, 13.0, 8.0))
    return Dataset.of_complex(
        GRID, entries, np.stack(signals), looks=1.0, ground=True, target="boxes", target_box_m=box
    )


def error(run: Run, name: str) -> float:
    """Relative error of the normalised mean matrix, HV counted twice: norm of the difference over that of the truth."""
    twice = np.diag([1.0, 2**0.5, 1.0])
    found, true = (twice @ matrix @ twice for matrix in (within(run, name), np.array(MATRICES[name])))
    found, true = (matrix / np.trace(matrix) for matrix in (found, true))
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def within(run: Run, name: str) -> np.ndarray:
    if name == "ground":
        return np.sum([run.covariance_within(((*low, -LOW_M), (*high, LOW_M))) for low, high in OPEN], axis=0)
    corner, side = BOXES[name]
    low, high = np.array(corner) - NEAR_M, np.array(corner) + side + NEAR_M
    low[2] = max(low[2], NEAR_M)  # lower Gaussians may be ground
    return run.covariance_within((tuple(low.tolist()), tuple(high.tolist())))


def draw(run: Run) -> None:
    data = run.dataset
    stack = data.stacks[0]
    assert data.signal is not None  # it is complex
    samples = data.signal[:, :, None] * data.signal[:, None].conj()
    shown = (0, 1, 3)
    figure, axes = plt.subplots(1, 2 * len(shown), figsize=(13, 2.7), sharey=True, layout="constrained")
    measured = [averaged(pauli(samples[k], NAMES), 3) for k in shown]
    peak = np.quantile(measured, 0.99)
    for place, (k, truth) in enumerate(zip(shown, measured, strict=True)):
        rendered = pauli(run.render_covariances([VIEWS[k]], stack)[0], NAMES)
        for ax, title, image in zip(
            axes[2 * place : 2 * place + 2], ("measured", "rendered"), (truth, rendered), strict=True
        ):
            colours = np.sqrt(np.clip(image / peak, 0, 1))
            ax.imshow(np.moveaxis(colours, 0, -1), extent=GRID.extent_m, interpolation="nearest")
            ax.set_title(f"{title}, azimuth {VIEWS[k].azimuth_deg:g}°", fontsize=9)
            ax.set_xlabel("azimuth, m", fontsize=8)
    axes[0].set_ylabel("slant range, m", fontsize=8)
    figure.savefig(DOCS / "images" / "polarimetry.png", dpi=110)


def main() -> None:
    rows = {name: list[float]() for name in MATRICES}
    for seed in SEEDS:
        run = reconstruct(dataset(seed), replace(preset("polarimetric"), seed=seed))
        for name, errors in rows.items():
            errors.append(error(run, name))
        if seed == SEEDS[0]:
            draw(run)
    table = ["\n| | " + " | ".join(f"seed {seed}" for seed in SEEDS) + " | mean |", "|---" * (len(SEEDS) + 2) + "|"]
    for name, errors in rows.items():
        cells = [*(f"{100 * each:.1f} %" for each in errors), f"**{100 * np.mean(errors):.1f} %**"]
        table.append(f"| {name} | " + " | ".join(cells) + " |")
    text = "\n".join([*table, "", ""])
    print(text)
    fill_block(DOCS / "how-to" / "polarimetry.md", "polarimetry", text)


if __name__ == "__main__":
    main()
