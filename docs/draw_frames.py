"""Draw docs/images/frames.png: the frames, the angles and the image array of docs/reference/conventions.md.

Run as `python docs/draw_frames.py`. The vehicle and its image are the library's own, seen from the angles shown.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Arc, Circle, Wedge

from sarsplat.colours import POWER, colormap
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.radiometry import to_db
from sarsplat.scenes import ScatteringLaw, simulate_raycast, target_mesh

VIEW = View(azimuth_deg=35.0, grazing_deg=40.0)
GRID = ImageGrid(rows=96, columns=96, spacing_m=(0.125, 0.125), resolution_m=(0.2, 0.2))

WORLD, RADAR, ANGLE, FAINT = "#333333", "#1f5fa8", "#c0392b", "#9a9a9a"
BODY = np.array([0.66, 0.72, 0.64])
OUTPUT = Path(__file__).parent / "images" / "frames.png"


def arrow(ax: Axes, start: np.ndarray, end: np.ndarray, colour: str, width: float = 1.8) -> None:
    """A straight arrow."""
    style = {"arrowstyle": "-|>", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14}
    ax.annotate("", xy=(end[0], end[1]), xytext=(start[0], start[1]), arrowprops=style, zorder=5)


def label(ax: Axes, at: np.ndarray, text: str, colour: str, **options: Any) -> None:
    """Text that stays legible over lines."""
    halo = {"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
    ax.text(
        at[0], at[1], text, **{"color": colour, "ha": "center", "va": "center", "bbox": halo, "zorder": 6, **options}
    )


def radar(ax: Axes, at: np.ndarray, looks: np.ndarray) -> None:
    """A radar at `at` whose beam goes along the unit vector `looks`."""
    angle = math.degrees(math.atan2(looks[1], looks[0]))
    ax.add_patch(Wedge((at[0], at[1]), 2.4, angle - 11, angle + 11, color=RADAR, alpha=0.25, lw=0, zorder=4))
    ax.add_patch(Circle((at[0], at[1]), 0.3, color=RADAR, zorder=6))


def vehicle_seen_along(ax: Axes, triangles: np.ndarray, page: np.ndarray) -> np.ndarray:
    """Draw triangles [F, 3, 3] on a page with axes right, up and towards the reader (rows); returns [F, 3, 2]."""
    seen = triangles @ page.T
    normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    normal = np.abs(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))
    shade = 0.45 + 0.5 * normal @ (0.25, 0.35, 0.9)
    far_first = seen[:, :, 2].mean(axis=1).argsort()
    colours = np.clip(shade[:, None] * BODY, 0, 1)[far_first]
    ax.add_collection(
        PolyCollection(seen[far_first, :, :2], facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=2)
    )
    return seen[:, :, :2]


def first_hit(start: np.ndarray, direction: np.ndarray, triangles: np.ndarray) -> float:
    """Distance from `start` along `direction` to the nearest edge of triangles [F, 3, 2]; infinite without a hit."""
    edge = np.roll(triangles, -1, axis=1) - triangles
    offset = triangles - start
    cross = direction[0] * edge[..., 1] - direction[1] * edge[..., 0]
    cross = np.where(np.abs(cross) < 1e-12, np.nan, cross)
    distance = (offset[..., 0] * edge[..., 1] - offset[..., 1] * edge[..., 0]) / cross
    along_edge = (offset[..., 0] * direction[1] - offset[..., 1] * direction[0]) / cross
    hit = (along_edge >= 0) & (along_edge <= 1) & (distance >= 0)
    return float(distance[hit].min(initial=np.inf))


def frame_panel(ax: Axes, title: str, x: tuple[float, float], y: tuple[float, float]) -> None:
    """A panel without axes."""
    ax.set(xlim=x, ylim=y, aspect="equal", anchor="N")
    ax.set_title(title, fontsize=12, loc="left", pad=10)
    ax.axis("off")


def top_view(ax: Axes, triangles: np.ndarray) -> None:
    """From above: x, y, the azimuth φ, the line of flight."""
    frame = radar_frame(VIEW)
    to_radar = VIEW.direction[:2] / np.linalg.norm(VIEW.direction[:2])
    flight = frame[0, :2]
    origin, antenna = np.zeros(2), 8.6 * to_radar
    frame_panel(ax, "a   from above (z towards the reader)", (-6.6, 10.2), (-9.0, 6.8))
    vehicle_seen_along(ax, triangles, np.eye(3))
    for direction, name in (((1.0, 0.0), "x  (nose)"), ((0.0, 1.0), "y")):
        end = 6.0 * np.array(direction)
        arrow(ax, origin, end, WORLD)
        label(ax, end + ((1.5, 0.0) if direction[0] else (0.5, 0.1)), name, WORLD)
    ax.plot(*np.stack([origin, antenna]).T, color=FAINT, lw=1, ls=(0, (4, 3)), zorder=3)
    arrow(ax, origin, 3.2 * to_radar, ANGLE)
    label(ax, 2.9 * to_radar + (-0.35, -0.6), "u", ANGLE)
    radius = 5.0
    ax.add_patch(
        Arc((0, 0), 2 * radius, 2 * radius, theta1=-VIEW.azimuth_deg + 4, theta2=0, color=ANGLE, lw=1.6, zorder=4)
    )
    tip, before = (radius * np.array([math.cos(a), math.sin(a)])
                   for a in np.radians([-VIEW.azimuth_deg, -VIEW.azimuth_deg + 5]))  # fmt: skip
    arrow(ax, before, tip, ANGLE, 1.6)
    half = math.radians(-VIEW.azimuth_deg / 2)
    label(ax, (radius + 0.4) * np.array([math.cos(half), math.sin(half)]), "φ, clockwise from x", ANGLE, ha="left")
    radar(ax, antenna, -to_radar)
    label(ax, np.add(antenna, (1.35, 0.1)), "radar", RADAR)
    ax.plot(*np.stack([antenna - 3.4 * flight, antenna + 3.4 * flight]).T, color=RADAR, lw=1, ls=(0, (4, 3)))
    arrow(ax, antenna + 2.0 * flight, antenna + 3.9 * flight, RADAR)
    label(ax, antenna + 4.2 * flight + (-1.7, 0.1), "flight", RADAR)
    arrow(ax, origin, 4.4 * flight, RADAR)
    label(ax, 4.4 * flight + (-1.4, -0.5), r"$x_r$  azimuth", RADAR)
    arrow(ax, origin, -4.4 * to_radar, RADAR)
    label(ax, -4.4 * to_radar + (-0.4, 0.65), r"$z_r$  range", RADAR)


def side_view(ax: Axes, triangles: np.ndarray) -> None:
    """From the side, the radar on the left: θ, y_r, z_r, the rays, the shadow."""
    theta = math.radians(VIEW.grazing_deg)
    away = -VIEW.direction[:2] / np.linalg.norm(VIEW.direction[:2])  # horizontal, to the right in this panel
    range_, elevation = np.array([math.cos(theta), -math.sin(theta)]), np.array([math.sin(theta), math.cos(theta)])
    frame_panel(ax, "b   from the side (flight into the page)", (-8.6, 8.2), (-5.6, 10.2))
    into_page = radar_frame(VIEW)[0]
    flat = vehicle_seen_along(ax, triangles, np.array([[*away, 0.0], [0.0, 0.0, 1.0], -into_page]))
    points = flat.reshape(-1, 2)
    top = points[(points @ elevation).argmax()]  # the ray over this point ends the shadow on the ground z = 0
    shadow_end = top[0] + top[1] / math.tan(theta)
    ax.plot([-8.0, 8.2], [0, 0], color=WORLD, lw=1.2, zorder=1)
    label(ax, np.array([-6.5, -0.55]), "ground  z = 0", WORLD, fontsize=9)
    behind = points[:, 0].max()
    ax.plot([behind, shadow_end], [0, 0], color="black", lw=5, solid_capstyle="butt", zorder=3)
    label(ax, np.array([(behind + shadow_end) / 2 + 0.2, -0.6]), "shadow", "black", fontsize=9)
    plane = -6.0 * range_  # the computation plane, drawn in front of the vehicle
    low, high = -2.2, 5.2
    ax.plot(*np.stack([plane + low * elevation, plane + high * elevation]).T, color=RADAR, lw=1.5)
    label(
        ax,
        plane + (high + 0.2) * elevation + (0.3, 0.75),
        "computation plane\n" + r"($x_r$, $y_r$)",
        RADAR,
        fontsize=10,
    )
    for step in np.arange(-1.75, 5.0, 0.5):
        start = plane + step * elevation
        length = min(start[1] / math.sin(theta), first_hit(start, range_, flat))
        ax.plot(*np.stack([start, start + length * range_]).T, color=FAINT, lw=0.6, zorder=1)
        ax.add_patch(Circle((start[0], start[1]), 0.07, color=RADAR, zorder=4))
    origin, antenna = np.zeros(2), -9.6 * range_
    radar(ax, antenna, range_)
    label(ax, np.add(antenna, (0.2, 0.7)), "radar", RADAR)
    ax.plot(*np.stack([antenna, origin]).T, color=FAINT, lw=1, ls=(0, (4, 3)), zorder=3)
    arrow(ax, origin, -3.6 * range_, ANGLE)
    label(ax, -3.3 * range_ + (0.45, 0.35), "u", ANGLE)
    radius = 5.2
    ax.add_patch(Arc((0, 0), 2 * radius, 2 * radius, theta1=180 - VIEW.grazing_deg, theta2=180, color=ANGLE, lw=1.6))
    half = math.radians(180 - VIEW.grazing_deg / 2)
    label(ax, (radius + 0.5) * np.array([math.cos(half), math.sin(half)]), "θ", ANGLE)
    arrow(ax, origin, 5.2 * elevation, RADAR)
    label(ax, 5.2 * elevation + (1.55, 0.2), r"$y_r$  elevation", RADAR)
    arrow(ax, origin, 5.6 * range_, RADAR)
    label(ax, 5.6 * range_ + (1.35, -0.2), r"$z_r$  range", RADAR)
    for step in np.arange(0.5, 5.0, 0.5):  # range cells
        ax.plot(*np.stack([step * range_ - 0.16 * elevation, step * range_ + 0.16 * elevation]).T, color=RADAR, lw=1.2)
    label(ax, 3.2 * range_ + (-1.5, -1.5), "imaging plane\n" + r"($x_r$, $z_r$)", RADAR, fontsize=10)
    ax.add_patch(Circle((0, 0), 0.24, facecolor="white", edgecolor=RADAR, lw=1.4, zorder=6))
    for sign in (1, -1):
        ax.plot([-0.15, 0.15], [-0.15 * sign, 0.15 * sign], color=RADAR, lw=1.4, zorder=7)
    label(ax, np.array([-0.8, -0.65]), r"$x_r$", RADAR)


def image_array(ax: Axes, power: np.ndarray) -> None:
    """Draw the stored image: row 0 near and on top, columns along the flight."""
    decibels = to_db(power, least=1e-6)
    ax.imshow(decibels, cmap=colormap(POWER), vmin=-26, vmax=3, interpolation="nearest")
    ax.set_anchor("N")
    ax.set_title("c   the array image[row, column], β⁰ in decibels", fontsize=12, loc="left", pad=10)
    last = GRID.columns - 1
    ax.set_xticks([0, last], ["column 0", f"{last}"])
    ax.set_yticks([0, GRID.rows - 1], ["row 0", f"{GRID.rows - 1}"])
    ax.tick_params(length=3)
    ax.set_xlabel(r"azimuth  $x_r$  (flight)  $\longrightarrow$", color=RADAR, fontsize=11, labelpad=-6)
    ax.set_ylabel(r"$\longleftarrow$  slant range  $z_r$", color=RADAR, fontsize=11, labelpad=-14)
    ax.annotate(
        "radar on this side: near range",
        xy=(0.5, 0.965),
        xycoords="axes fraction",
        color="white",
        ha="center",
        va="top",
    )
    row, column = np.argwhere(decibels[GRID.rows // 2 :] <= -40).mean(axis=0)
    ax.text(column, row + GRID.rows // 2, "shadow", color="white", ha="center", va="center", fontsize=9)


def main() -> None:
    """Draw the three panels."""
    mesh = target_mesh("t72")
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    power = simulate_raycast(mesh, VIEW, GRID, ScatteringLaw(), ground_gamma0=0.04)
    figure, axes = plt.subplots(1, 3, figsize=(17, 5.9), width_ratios=(1.0, 1.0, 0.92), layout="constrained")
    top_view(axes[0], triangles)
    side_view(axes[1], triangles)
    image_array(axes[2], power)
    OUTPUT.parent.mkdir(exist_ok=True)
    figure.savefig(OUTPUT, dpi=110, facecolor="white")


if __name__ == "__main__":
    main()
