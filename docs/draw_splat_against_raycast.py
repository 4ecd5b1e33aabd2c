"""Image one mesh through both forward models, and measure what separates them.

Run as `python docs/draw_splat_against_raycast.py`, or with the other figures as `make figures`. Writes
figures/splat-against-raycast.png, prints the tables and fills them into docs/reference/forward-model.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from fill_block import fill_block

from sarsplat import Gaussians, RayGrid, ScatteringLaw, View, paper_grid, render, simulate_raycast, target_mesh
from sarsplat.colours import HEIGHT, colormap
from sarsplat.radiometry import brighter
from sarsplat.scenes import law_scattering, surface_gaussians

HERE = Path(__file__).parent
FIGURES, PAGE = HERE.parent / "figures", HERE / "reference" / "forward-model.md"

MESH, LAW, GRID = target_mesh("t72"), ScatteringLaw(), paper_grid()
VIEWS = (View(0.0, 15.0), View(30.0, 45.0), View(90.0, 75.0), View(135.0, 45.0))
TRUTH_RAYS = 0.005  # m
SIZES = (0.4, 0.2, 0.1, 0.05, 0.025)  # longest edges of the pieces that become Gaussians, m
RAYS = (0.075, 0.0375, 0.02, 0.01, 0.005)  # m
STUDIED = (0.05, 0.01)  # size and rays at which one thing at a time is changed, m
WIDENING, SHEET_DEPTH = 1.2, 7.0  # of `surface_gaussians`


def psnr(truth: np.ndarray, image: np.ndarray) -> float:
    """PSNR of the amplitude, dB; its peak is the truth's largest, its pixels those whose β⁰ is above −30 dB of that."""
    truth, image = np.sqrt(truth.astype(np.float64)), np.sqrt(image.astype(np.float64))
    mask = brighter(truth, -15)
    return -10 * math.log10(np.mean((image - truth)[mask] ** 2) / truth.max() ** 2)


def raycast(spacing: float, offset: tuple[float, float] = (0.5, 0.5)) -> list[np.ndarray]:
    """β⁰ of every view by ray casting."""
    return [simulate_raycast(MESH, view, GRID, LAW, ray_spacing=spacing, ray_offset=offset) for view in VIEWS]


def splat(gaussians: Gaussians, faces: np.ndarray, spacing: float, farther: float = 0.0) -> np.ndarray:
    """β⁰ of every view by the renderer, with the image moved away from the radar by `farther` metres."""
    scattering = torch.from_numpy(law_scattering(MESH.face_normals, VIEWS, LAW)[:, faces, None]).float()
    shift = torch.tensor([[0.0, farther]] * len(VIEWS))
    rays = RayGrid((spacing, spacing))
    with torch.no_grad():
        return render(gaussians, VIEWS, GRID, rays=rays, amplitudes=scattering, shift=shift).channel(0).numpy()


def scores(truth: Iterable[np.ndarray], images: Iterable[np.ndarray]) -> np.ndarray:
    """PSNR of every view, dB."""
    return np.array([psnr(a, b) for a, b in zip(truth, images, strict=True)])


def isotropic(gaussians: Gaussians) -> Gaussians:
    """Balls instead of discs, of the same area."""
    radius = (gaussians.scales[:, 1] * gaussians.scales[:, 2]).sqrt()
    return replace(gaussians, scales=radius[:, None].repeat(1, 3))


def respread(gaussians: Gaussians, widening: float, depth: float) -> Gaussians:
    """Discs of another width, whose surface has another mean optical depth."""
    wider = widening / WIDENING
    return replace(
        gaussians,
        scales=gaussians.scales * torch.tensor([1.0, wider, wider]),
        optical_depth=gaussians.optical_depth * (depth / SHEET_DEPTH) / wider**2,
    )


def inset(gaussians: Gaussians, faces: np.ndarray, depth: float) -> Gaussians:
    """Gaussians moved inwards by `depth` metres."""
    return replace(gaussians, means=gaussians.means - depth * torch.from_numpy(MESH.face_normals[faces]).float())


def sweep(truth: Sequence[np.ndarray]) -> tuple[np.ndarray, list[tuple[int, float]]]:
    """PSNR [sizes, rays, views]; number and median standard deviation (m) of the Gaussians of each size."""
    table, kinds = [], []
    for size in SIZES:
        gaussians, faces = surface_gaussians(MESH, size)
        table.append([scores(truth, splat(gaussians, faces, spacing)) for spacing in RAYS])
        kinds.append((len(gaussians), float(gaussians.scales[:, 1:].median())))
    return np.array(table), kinds


def changes(truth: Sequence[np.ndarray]) -> tuple[list[tuple[str, np.ndarray]], np.ndarray]:
    """PSNR of every view with one thing changed at a time; and by how much the unchanged images hold too much, %."""
    size, spacing = STUDIED
    gaussians, faces = surface_gaussians(MESH, size)
    plain = splat(gaussians, faces, spacing)
    found = [
        (f"unchanged: discs, widened by {WIDENING:g}, mean depth {SHEET_DEPTH:g}", plain),
        ("balls instead of discs", splat(isotropic(gaussians), faces, spacing)),
    ]
    for widening, depth in ((1.0, 7.0), (1.6, 7.0), (2.2, 7.0), (1.2, 5.0), (1.2, 10.0)):
        images = splat(respread(gaussians, widening, depth), faces, spacing)
        found.append((f"widened by {widening:g}, mean depth {depth:g}", images))
    found += [
        ("image moved away from the radar by 4 mm", splat(gaussians, faces, spacing, farther=0.004)),
        ("discs moved inwards by 2.5 mm", splat(inset(gaussians, faces, 0.0025), faces, spacing)),
    ]
    excess = [100 * (image.sum() / true.sum() - 1) for true, image in zip(truth, plain, strict=True)]
    return [(name, scores(truth, images)) for name, images in found], np.array(excess)


def tables(
    table: np.ndarray,
    kinds: list[tuple[int, float]],
    changed: list[tuple[str, np.ndarray]],
    excess: np.ndarray,
    offsets: np.ndarray,
) -> str:
    """All scores as Markdown."""
    views = " | ".join(f"φ {view.azimuth_deg:.0f}°, θ {view.grazing_deg:.0f}°" for view in VIEWS)
    lines = [
        f"| pieces up to (m) | Gaussians | median s (mm) | {' | '.join(f'rays {1000 * r:g} mm' for r in RAYS)} |",
        f"|---:|---:|---:|{'---:|' * len(RAYS)}",
    ]
    for size, (count, std), row in zip(SIZES, kinds, table.mean(axis=2), strict=True):
        cells = " | ".join(f"{value:.1f}" for value in row)
        lines.append(f"| {size:g} | {count:,} | {1000 * std:.1f} | {cells} |")
    size, spacing = STUDIED
    lines += [
        "",
        f"| pieces up to {size:g} m, rays {1000 * spacing:g} mm | {views} | mean |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    rows = [*changed, ("the ray caster against itself: another offset of its rays", offsets)]
    lines += [f"| {name} | {' | '.join(f'{v:.1f}' for v in found)} | {found.mean():.1f} |" for name, found in rows]
    cells = " | ".join(f"{value:+.1f} %" for value in (*excess, excess.mean()))
    lines.append(f"| *sum of the unchanged image, too much by* | {cells} |")
    return "\n".join(lines) + "\n"


def draw(table: np.ndarray, kinds: list[tuple[int, float]]) -> None:
    """Mean PSNR against the number of Gaussians, a line for each ray spacing."""
    fig, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
    counts = [count for count, _ in kinds]
    for k, spacing in enumerate(RAYS):
        colour = colormap(HEIGHT)(k / len(RAYS))
        ax.semilogx(counts, table[:, k].mean(axis=1), "o-", color=colour, label=f"rays {1000 * spacing:g} mm apart")
    for (count, std), top in zip(kinds, table.mean(axis=2).max(axis=1), strict=True):
        ax.annotate(f"s ≈ {1000 * std:.0f} mm", (count, top), (-4, 7), textcoords="offset points", ha="right")
    ax.axhline(45, color="#c0392b", lw=0.8, ls="--")
    ax.set(xlabel="Gaussians on the surface of the T-72", ylabel="PSNR of amplitude inside the target (dB)")
    ax.set(xlim=(9e3, 3.9e6), ylim=(26, 53))
    ax.set_title("splat renderer against ray caster: mean of four views, 0.3 m pixels", fontsize=10)
    ax.legend(fontsize=9, loc="upper left")
    ax.grid(alpha=0.25)
    fig.savefig(FIGURES / "splat-against-raycast.png", dpi=120, facecolor="white")


def main() -> None:
    """Measure, draw, and fill the tables."""
    FIGURES.mkdir(exist_ok=True)
    truth = raycast(TRUTH_RAYS)
    offsets = scores(truth, raycast(TRUTH_RAYS, (0.1, 0.3)))
    table, kinds = sweep(truth)
    draw(table, kinds)
    text = tables(table, kinds, *changes(truth), offsets)
    print(text)
    fill_block(PAGE, "splat", text)


if __name__ == "__main__":
    main()
