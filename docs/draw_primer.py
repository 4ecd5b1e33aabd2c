"""Draw the six pictures of docs/learn/primer.md: docs/images/primer-*.png.

Run as `python docs/draw_primer.py` (`make primer`). Every radar image is made by the library's ray caster or renderer.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from draw_frames import ANGLE, FAINT, RADAR, WORLD, arrow, label, vehicle_seen_along
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon

from sarsplat.colours import POWER, colormap
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import bright_level, to_db
from sarsplat.renderer import render
from sarsplat.scenes import ScatteringLaw, add_speckle, simulate_raycast, target_mesh
from sarsplat.scenes.buildings import Building

OUTPUT = Path(__file__).parent / "images"
WIDTH = 7.2  # inches; the text is 11 points
DARKEST_DB, GROUND = 25.0, 0.04
LINES = ("#d1495b", "#1f5fa8", "#2a9d5c", "#b8860b")


def grid(side_m: float, spacing_m: float = 0.1, resolution_m: float | None = None) -> ImageGrid:
    """A square image, m."""
    pixels = round(side_m / spacing_m)
    cell = resolution_m or 1.5 * spacing_m
    return ImageGrid(rows=pixels, columns=pixels, spacing_m=(spacing_m, spacing_m), resolution_m=(cell, cell))


def towards(grazing_deg: float) -> np.ndarray:
    """Unit vector to a radar on the left of a page whose axes are right and up."""
    angle = np.radians(grazing_deg)
    return np.array([-np.cos(angle), np.sin(angle)])


def show(ax: Axes, power: np.ndarray, where: ImageGrid, title: str, darkest_db: float = DARKEST_DB) -> None:
    """An image in decibels below its 99.9th percentile, near range at the top, with a scale bar of 2 m."""
    decibels = to_db(power, bright_level(power))
    half = where.columns * where.spacing_m[0] / 2
    ax.imshow(decibels, cmap=colormap(POWER), vmin=-darkest_db, vmax=0, extent=(-half, half, half, -half))
    ax.plot([0.9 * half - 2, 0.9 * half], [0.92 * half] * 2, color="white", lw=3)
    ax.text(0.9 * half - 1, 0.87 * half, "2 m", color="white", ha="center", va="bottom", fontsize=10)
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=11, loc="left")


def page(ax: Axes, x: tuple[float, float], z: tuple[float, float], title: str) -> None:
    """A side view without axes: the ground, and where the radar is."""
    ax.fill_between(x, z[0], 0, color="#e8e4da", lw=0, zorder=0)
    ax.plot(x, (0, 0), color=WORLD, lw=1.5, zorder=3)
    ax.set(xlim=x, ylim=z, aspect="equal")
    ax.set_title(title, fontsize=11, loc="left")
    ax.axis("off")


def beam(ax: Axes, u: np.ndarray, to: np.ndarray, length: float) -> None:
    """An arrow from the radar, which is far away."""
    arrow(ax, to + length * u, to + 0.45 * length * u, RADAR, 2.2)
    label(ax, to + (length + 0.5) * u, "radar", RADAR, fontsize=11)


def pair(height: float = 3.3, **options: Any) -> tuple[Figure, np.ndarray]:
    """A side view, and the image beside it."""
    return plt.subplots(1, 2, figsize=(WIDTH, height), layout="constrained", width_ratios=(1.25, 1), **options)


def range_picture() -> Figure:
    """Places at the same distance share a row."""
    figure, (side, image) = pair()
    u = towards(40)
    page(side, (-6.5, 6.5), (-1.4, 8.0), "from the side")
    vehicle_seen_along(side, target_mesh("t72").triangles, np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]))
    where = grid(11)
    power = simulate_raycast(target_mesh("t72"), View(0, 40), where, ScatteringLaw(), ground_gamma0=GROUND)
    show(image, power, where, "the radar's image")
    across = np.array([u[1], -u[0]])
    for distance, colour in zip((-3.0, -1.0, 1.0, 3.0), LINES):
        start = -distance * u
        side.plot(*np.transpose([start - 8 * across, start + 8 * across]), color=colour, lw=1.6, zorder=4)
        image.axhline(distance, color=colour, lw=1.6)
    beam(side, u, np.array([-1.6, 3.4]), 3.4)
    image.set_ylabel("slant range →", fontsize=11, color=RADAR)
    image.set_xlabel("azimuth (along the flight) →", fontsize=11, color=RADAR)
    return figure


def layover_picture() -> Figure:
    """The top of a wall is nearer than its foot."""
    figure, (side, image) = pair()
    building = Building(height=5.0, depth=5.0, length=8.0)
    u = towards(40)
    page(side, (-9.5, 6.5), (-1.4, 9.0), "from the side")
    box = [(0, 0), (0, building.height), (building.depth, building.height), (building.depth, 0)]
    side.add_patch(Polygon(box, facecolor="#c9cfc4", edgecolor=WORLD, zorder=2))
    across = np.array([u[1], -u[0]])
    top, foot = np.array([0, building.height]), np.array([0.0, 0.0])
    ground = np.array([top @ u / u[0], 0.0])
    marks = [("A  roof's edge", top, LINES[0]), ("B  foot", foot, LINES[1])]
    marks.append(("C  ground, as far as A", ground, LINES[0]))
    for point, colour in ((top, LINES[0]), (foot, LINES[1])):
        side.plot(*np.transpose([point - 9 * across, point + 12 * across]), color=colour, lw=1.2, ls="--", zorder=4)
    for (text, point, colour), shift in zip(marks, ((1.6, 0.7), (1.0, -0.8), (-0.9, -0.8))):
        side.plot(*point, "o", color=colour, ms=8, zorder=6)
        label(side, point + shift, text, colour, fontsize=11)
    beam(side, u, np.array([-3.0, 3.8]), 3.6)
    where = grid(16)
    law = ScatteringLaw(floor=1.0, lobe=0.0)
    power = simulate_raycast(building.mesh(), View(0, 40), where, law, ground_gamma0=0.3)
    show(image, power, where, "the radar's image", 12)
    for text, distance, colour in (("A, C", -top @ u, LINES[0]), ("B", 0.0, LINES[1])):
        image.axhline(distance, color=colour, lw=1.2, ls="--")
        label(image, np.array([-6.8, distance]), text, colour, fontsize=11)
    image.set_ylabel("slant range →", fontsize=11, color=RADAR)
    return figure


def shadow_picture() -> Figure:
    """Behind a target no ray arrives."""
    figure, (side, image) = pair()
    u = towards(25)
    page(side, (-6.5, 9.0), (-1.4, 6.0), "from the side")
    seen = vehicle_seen_along(side, target_mesh("t72").triangles, np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]))
    corners = seen.reshape(-1, 2)
    last = corners[np.argmax(corners @ (u[1], -u[0]))]  # the ray that just misses the target
    end = np.array([last[0] - last[1] * u[0] / u[1], 0.0])
    side.add_patch(Polygon([(1.7, 0), last, end], facecolor="#555555", alpha=0.45, lw=0, zorder=1))
    side.plot((corners[:, 0].max(), end[0]), (-0.12, -0.12), color="black", lw=5, zorder=4)
    label(side, np.array([(1.7 + end[0]) / 2, -0.8]), "no echo: shadow", WORLD, fontsize=11)
    for offset in np.arange(-3.0, 3.6, 0.55):
        start = np.array([0.0, 2.3]) + offset * np.array([u[1], -u[0]]) + 7 * u
        steps = np.linspace(0, 22, 2200)[:, None]
        path = start - steps * u
        inside = (np.abs(path[:, 0]) < 1.7) & (path[:, 1] < 1.9) | (path[:, 1] < 0)
        stop = path[np.argmax(inside)] if inside.any() else path[-1]
        side.plot(*np.transpose([start, stop]), color=FAINT, lw=0.9, zorder=2)
    side.plot(*np.transpose([last + 8 * u, end]), color=ANGLE, lw=1.6, zorder=5)
    beam(side, u, np.array([0.6, 4.2]), 3.2)
    where = grid(13)
    power = simulate_raycast(target_mesh("t72"), View(90, 25), where, ScatteringLaw(), ground_gamma0=GROUND)
    show(image, power, where, "the radar's image")
    pointer = {"arrowstyle": "->", "color": "white"}
    image.annotate("shadow", (0, 3.4), (0, 5.2), color="white", fontsize=11, ha="center", arrowprops=pointer)
    image.set_ylabel("slant range →", fontsize=11, color=RADAR)
    return figure


def speckle_picture() -> Figure:
    """One look, many looks, the mean; and how one look is distributed."""
    figure, axes = plt.subplots(1, 4, figsize=(WIDTH, 2.4), layout="constrained", width_ratios=(1, 1, 1, 1.1))
    where = grid(11, 0.2)
    mean = simulate_raycast(target_mesh("t72"), View(30, 25), where, ScatteringLaw(), ground_gamma0=GROUND)
    random = np.random.default_rng(0)
    one = add_speckle(mean, 1, random)
    for ax, power, title in zip(
        axes, (one, add_speckle(mean, 10, random), mean), ("one look", "ten looks", "the mean")
    ):
        show(ax, power, where, title)
    ground = add_speckle(np.ones(5000), 1, random)
    axes[3].hist(ground, bins=np.linspace(0, 5, 21), density=True, color="#9db7d5")
    level = np.linspace(0, 5, 100)
    axes[3].plot(level, np.exp(-level), color=RADAR, lw=2)
    axes[3].set(xlabel="power / mean", yticks=[])
    axes[3].set_title("one look of grass", fontsize=11, loc="left")
    axes[3].spines[["top", "right", "left"]].set_visible(False)
    return figure


def resolution_picture() -> Figure:
    """Finer and coarser cells; and the same target from low and from high."""
    figure, axes = plt.subplots(2, 3, figsize=(WIDTH, 5.2), layout="constrained")
    for ax, cell in zip(axes[0], (0.1, 0.3, 1.0)):
        where = grid(11, cell / 1.5, cell)
        power = simulate_raycast(target_mesh("t72"), View(50, 35), where, ScatteringLaw(), ground_gamma0=GROUND)
        show(ax, power, where, f"resolution {cell:g} m")
    for ax, grazing in zip(axes[1], (15, 45, 75)):
        where = grid(11, 0.15)
        power = simulate_raycast(target_mesh("t72"), View(50, grazing), where, ScatteringLaw(), ground_gamma0=GROUND)
        show(ax, power, where, f"grazing {grazing}°")
    return figure


def gaussian_picture() -> Figure:
    """One in front of another, and one at the same range: the shadow and the layover of Gaussians."""
    figure, (side, image) = pair()
    u = towards(35)
    across = np.array([u[1], -u[0]])
    centre = np.array([0.0, 2.6])
    places = {"A": centre + 1.2 * u, "B": centre - 2.6 * u, "C": centre + 1.2 * u - 3.2 * across}
    page(side, (-6.5, 6.0), (-1.4, 8.0), "from the side")
    for (name, place), colour in zip(places.items(), LINES):
        for widths, alpha in ((1, 0.75), (2, 0.35), (3, 0.15)):
            side.add_patch(
                Ellipse((place[0], place[1]), 0.9 * widths, 0.9 * widths, color=colour, alpha=alpha, lw=0, zorder=3)
            )
        label(side, place, name, "black", fontsize=11, bbox={"alpha": 0})
    depth = 2.0  # two-way, through the centre of each
    for offset in np.arange(-4.4, 2.0, 0.4):
        along = np.linspace(-5.5, 4.5, 200)
        path = centre + offset * across - along[:, None] * u
        absorbed = np.zeros_like(along)
        for place in places.values():
            near = np.exp(-0.5 * (((path - place) @ across) / 0.45) ** 2)
            absorbed += depth * near * (((path - place) @ u) < 0)
        for k in range(0, 198, 3):
            strength = float(np.exp(-absorbed[k]))
            if path[k, 1] > 0:
                side.plot(*path[k : k + 4].T, color=RADAR, lw=2.2 * strength, alpha=0.15 + 0.75 * strength, zorder=2)
    beam(side, u, centre + 3.3 * u, 2.4)
    place = np.array(list(places.values()))
    means = torch.tensor(np.stack([-place[:, 0], 0 * place[:, 0], place[:, 1]], axis=1), dtype=torch.float32)
    gaussians = Gaussians(
        means - means.mean(dim=0),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        torch.full((3, 3), 0.45),
        torch.full((3,), depth),
        Harmonics(torch.full((3, 1), 2.0)),
    )
    where, view = grid(9), View(0, 35)
    rendered = render(gaussians, [view], where)
    show(image, rendered.channel(0)[0].numpy() + 1e-9, where, "rendered", 20)
    alone = render(gaussians[:1], [view], where).cross_sections[0, 0, 0]
    a, b, c = (100 * rendered.cross_sections[0, :, 0] / alone).tolist()
    ranges = (-(place - place.mean(axis=0)) @ u).tolist()
    for text, distance in ((f"A {a:.0f} % + C {c:.0f} %", ranges[0]), (f"B {b:.0f} %", ranges[1])):
        label(image, np.array([0, distance - 1.5]), text, "white", fontsize=11, bbox={"alpha": 0})
    image.set_ylabel("slant range →", fontsize=11, color=RADAR)
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "range": range_picture,
    "layover": layover_picture,
    "shadow": shadow_picture,
    "speckle": speckle_picture,
    "resolution": resolution_picture,
    "gaussian": gaussian_picture,
}


def main() -> None:
    """Write all six."""
    plt.rcParams["font.size"] = 11
    for name, picture in PICTURES.items():
        figure = picture()
        figure.savefig(OUTPUT / f"primer-{name}.png", dpi=150, facecolor="white", pil_kwargs={"optimize": True})
        plt.close(figure)


if __name__ == "__main__":
    main()
