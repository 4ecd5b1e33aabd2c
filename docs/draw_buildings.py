"""Draw the paper's buildings A, B and C, and measure edges and levels in their images against the closed form.

Run as `python docs/draw_buildings.py`, or with the other figures as `make figures`. Writes figures/building-*.png and
docs/images/buildings.png, prints the tables and fills them into docs/reference/forward-model.md.
"""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from fill_block import fill_block
from matplotlib.axes import Axes

from sarsplat import ImageGrid, ScatteringLaw, View
from sarsplat.colours import LIGHT, POWER, TARGET, colormap
from sarsplat.names import Simulator
from sarsplat.scenes import BUILDINGS, Building, BuildingProfile, Gamma0, building_profile
from sarsplat.scenes.simulate import simulate_images

HERE = Path(__file__).parent
FIGURES, PICTURE = HERE.parent / "figures", HERE / "images" / "buildings.png"
PAGE = HERE / "reference" / "forward-model.md"

GRID = ImageGrid(144, 80, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
LAW = ScatteringLaw(floor=1.0, lobe=0.0)  # the same at every angle: the faces' own factor is their γ⁰
GRAZING = (30.0, 45.0, 60.0)
GAMMA0 = {"equal": Gamma0(0.5, 0.5, 0.5), "unequal": Gamma0(wall=0.8, roof=0.3, ground=0.1)}
SOURCES: dict[Simulator, str] = {"splat": "splat renderer", "raycast": "ray caster"}
STYLES: dict[str, dict[str, Any]] = {
    "splat": {"color": LIGHT.train, "marker": "o"},
    "raycast": {"color": LIGHT.test, "marker": "x"},
}
LETTER = {"ground": "SG", "wall": "SW", "roof": "SR"}


def simulated(box: Building, grazing: float, gamma0: Gamma0, source: Simulator) -> np.ndarray:
    """β⁰ of a building seen from azimuth 0."""
    return simulate_images(
        box.mesh(),
        [View(0.0, grazing)],
        GRID,
        source=source,
        law=LAW,
        reflectivity=box.reflectivity(gamma0),
        ground_gamma0=gamma0.ground,
    )[0]


def tables() -> str:
    """Edges and levels of every case, as Markdown."""
    edges = [
        "| building | θ | γ⁰ | edges at ground range (m) | splat: off by (m) | (pixels) | ray cast: (pixels) |",
        "|---|---|---|---|---|---|---|",
    ]
    levels = [
        "| building | θ | γ⁰ | regions | analytic β⁰ | splat: off by (%) | ray cast: (%) |",
        "|---|---|---|---|---|---|---|",
    ]
    for (name, box), grazing, (kind, gamma0) in product(BUILDINGS.items(), GRAZING, GAMMA0.items()):
        splat, rays = (
            building_profile(simulated(box, grazing, gamma0, source), GRID, box, grazing, gamma0) for source in SOURCES
        )
        case = f"| {name[-1].upper()} | {grazing:.0f}° | {kind} |"
        off = [
            ", ".join(f"{edge.error / unit:+.2f}".replace("-0.00", "+0.00") for edge in found.edges)
            for found, unit in ((splat, 1.0), (splat, GRID.spacing_m[1]), (rays, GRID.spacing_m[1]))
        ]
        where = ", ".join(f"{edge.ground_range:.2f}" for edge in splat.edges)
        edges.append(f"{case} {where} | {' | '.join(off)} |")
        regions = [item.region for item in splat.regions]
        seen = ", ".join("+".join(LETTER[part] for part in region.surfaces) or "S" for region in regions)
        analytic = ", ".join(f"{region.beta0:.3f}" for region in regions)
        free = regions[0].beta0
        levels.append(f"{case} {seen} | {analytic} | {percent(splat, free)} | {percent(rays, free)} |")
    return "\n".join([*edges, "", *levels]) + "\n"


def percent(found: BuildingProfile, free: float) -> str:
    """Errors of the levels in per cent; in the shadow, of the free ground's level."""
    return ", ".join(
        "–"
        if item.beta0 is None
        else f"{100 * (item.beta0 - item.region.beta0) / (item.region.beta0 or free):+.2f}".replace("-0.00", "+0.00")
        for item in found.regions
    )


def draw(ax_image: Axes, ax_profile: Axes, name: str, grazing: float = 45.0) -> None:
    """A building's splat image, range to the right, over the profiles along it; all γ⁰ = 1."""
    box, gamma0, cos = BUILDINGS[name], Gamma0(), math.cos(math.radians(grazing))
    images = {source: simulated(box, grazing, gamma0, source) for source in SOURCES}
    ground_range = GRID.range_m / cos
    step = GRID.spacing_m[1] / cos / 2
    limits = (ground_range[0] - step, ground_range[-1] + step)
    sides = (GRID.azimuth_m[0] - GRID.spacing_m[0] / 2, GRID.azimuth_m[-1] + GRID.spacing_m[0] / 2)
    ax_image.imshow(images["splat"].T, cmap=colormap(POWER), vmin=0, vmax=3, extent=(*limits, *sides), origin="lower")
    ax_image.set(title=f"building {name[-1].upper()}: h = {box.height:g} m, w = {box.depth:g} m", xlim=(-18, 22))
    ax_image.set(yticks=[], ylim=(-12, 12), aspect="auto")  # so that both panels share their abscissa

    regions = box.regions(grazing, gamma0)
    fine = np.linspace(*limits, 4000)
    sharp = box.profile(fine * cos, grazing, gamma0, 1e-9)
    ax_profile.fill_between(fine, sharp, color=LIGHT.line, lw=0, label="analytic")
    seen = box.profile(fine * cos, grazing, gamma0, GRID.resolution_m[1])
    ax_profile.plot(fine, seen, color="black", lw=1, label="analytic, 0.3 m resolution")
    for source, label in SOURCES.items():
        found = building_profile(images[source], GRID, box, grazing, gamma0)
        ax_profile.plot(ground_range, found.measured, ls="none", ms=3.5, label=label, **STYLES[source])
    for region in regions:
        if math.isfinite(region.start):
            for ax in (ax_image, ax_profile):
                ax.axvline(region.start, color=TARGET, lw=0.8, ls="--")
        text = "\n".join(LETTER[part] for part in region.surfaces) or "S"
        middle = (max(region.start, -18.0) + min(region.stop, 22.0)) / 2
        halo = {"facecolor": "black", "edgecolor": "none", "pad": 1.5, "alpha": 0.65}
        ax_image.text(middle, 0, text, color="white", ha="center", va="center", fontsize=9, bbox=halo)
    ax_profile.set(xlim=(-18, 22), ylim=(-0.1, 3.5), xlabel="ground range from the near wall (m)")


def figure(names: list[str], path: Path, dpi: int) -> None:
    """Buildings side by side."""
    width = len(names)
    fig, axes = plt.subplots(
        2, width, figsize=(0.6 + 4.4 * width, 5.4), squeeze=False, sharex=True, layout="constrained"
    )
    for name, (above, below) in zip(names, axes.T, strict=True):
        draw(above, below, name)
    axes[0, 0].set_ylabel("azimuth")
    axes[1, 0].set_ylabel("β⁰ / γ⁰ (linear power)")
    axes[1, -1].legend(loc="upper right", fontsize=8, framealpha=0.9)
    fig.savefig(path, dpi=dpi, facecolor="white")
    plt.close(fig)


def main() -> None:
    """Draw all, and fill the tables."""
    FIGURES.mkdir(exist_ok=True)
    for name in BUILDINGS:
        figure([name], FIGURES / f"{name}.png", 150)
    figure(list(BUILDINGS), PICTURE, 80)
    text = tables()
    print(text)
    fill_block(PAGE, "buildings", text)


if __name__ == "__main__":
    main()
