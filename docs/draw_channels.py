"""Draw docs/images/channels.png: the signs of docs/concepts/stacks.md, one drawing for each, and what the library does.

Run as `python docs/draw_channels.py`, or with the other figures as `make figures`. Angles between passes are drawn much
larger than they are.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import trimesh
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle

from sarsplat import Gaussians, Harmonics, ImageGrid, ScatteringLaw, Stack, View, render_covariances, simulate_stack

OUTPUT = Path(__file__).parent / "images" / "channels.png"
VIEW, GRID = View(azimuth_deg=0.0, grazing_deg=40.0), ImageGrid(48, 24, (0.4, 0.4), (0.6, 0.6))
STACK = Stack(wavelength_m=0.031, offsets_rad=(0.0, 0.0006))
HEIGHTS = np.arange(-3.0, 8.1, 1.0)  # m

WORLD, VIEWED, HIGHER, POINT, FAINT = "#333333", "#1f5fa8", "#c0392b", "#2e7d32", "#9a9a9a"
THETA, WIDER = math.radians(VIEW.grazing_deg), math.radians(14.0)  # b/R in the drawing

U = np.array([-math.cos(THETA), math.sin(THETA)])  # towards the view's antenna; ground range to the right, z up
UP = np.array([math.sin(THETA), math.cos(THETA)])  # y_r
U_I = math.cos(WIDER) * U + math.sin(WIDER) * UP
GROUND = np.zeros(2)
RAISED = 2.6 * UP  # at the same range as GROUND
CORNER = np.array([RAISED[0], 0.0])


def line(ax: Axes, start: np.ndarray, end: np.ndarray, colour: str, style: str = "-", width: float = 1.2) -> None:
    ax.plot(*np.stack([start, end]).T, color=colour, linestyle=style, linewidth=width, zorder=2)


def arrow(ax: Axes, start: np.ndarray, end: np.ndarray, colour: str, both: bool = False) -> None:
    shape = "<|-|>" if both else "-|>"
    style = {"arrowstyle": shape, "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 13}
    ax.annotate("", xy=(end[0], end[1]), xytext=(start[0], start[1]), arrowprops=style, zorder=5)


def label(ax: Axes, at: np.ndarray, text: str, colour: str, **options: Any) -> None:
    """Text that stays legible over lines."""
    halo = {"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
    ax.text(
        at[0], at[1], text, **{"color": colour, "ha": "center", "va": "center", "fontsize": 11, "bbox": halo, **options}
    )


def dot(ax: Axes, at: np.ndarray, colour: str, radius: float) -> None:
    ax.add_patch(Circle(tuple(at), radius, color=colour, zorder=6))


def scene(ax: Axes, title: str, x: tuple[float, float], y: tuple[float, float]) -> None:
    """A vertical plane along the line of sight: level ground, the radar at the upper left."""
    ax.set(xlim=x, ylim=y, aspect="equal", anchor="NW")
    ax.set_title(title, fontsize=12, loc="left", pad=8)
    ax.axis("off")
    line(ax, np.array([x[0], 0.0]), np.array([x[1], 0.0]), WORLD)


def passes(ax: Axes) -> None:
    """Draw the antennas' positions: directions, the offset b/R, the axis of elevation."""
    scene(ax, "a   a positive offset b/R: the antenna of pass i is seen higher", (-9.4, 5.2), (-1.2, 8.6))
    far = 9.0
    for direction, colour, name, at in ((U, VIEWED, "view", (0.2, -0.55)), (U_I, HIGHER, "pass i", (0.2, 0.5))):
        line(ax, GROUND, far * direction, FAINT, "--")
        dot(ax, far * direction, colour, 0.17)
        label(ax, far * direction + at, name, colour, ha="left")
        arrow(ax, GROUND, 4.0 * direction, colour)
    label(ax, 3.4 * U + (-0.3, -0.5), "u", VIEWED)
    label(ax, 3.7 * U_I + (0.35, 0.45), r"$u_i$", HIGHER)
    first = math.degrees(math.atan2(*U[::-1]))
    ax.add_patch(Arc((0, 0), 12.4, 12.4, theta1=first - math.degrees(WIDER), theta2=first, color=HIGHER, lw=1.6))
    label(ax, 6.2 * (U + U_I) / np.linalg.norm(U + U_I), "b/R > 0", HIGHER)
    arrow(ax, GROUND, 3.6 * UP, VIEWED)
    label(ax, 3.6 * UP + (1.2, 0.3), r"$y_r$, elevation", VIEWED)
    ax.add_patch(Arc((0, 0), 4.4, 4.4, theta1=first, theta2=180, color=WORLD, lw=1.2))
    label(ax, 2.65 * np.array([-math.cos(THETA / 2), math.sin(THETA / 2)]), "θ", WORLD)
    label(ax, np.array([3.4, -0.5]), "ground, z = 0", WORLD)


def phase(ax: Axes) -> None:
    """Two places that the view sees at one range, and the difference of their ranges from pass i."""
    scene(ax, "b   what is above the plane is nearer to pass i: positive phase", (-5.4, 5.8), (-1.6, 5.8))
    nearer = float((RAISED - GROUND) @ U_I)  # by how much
    for place, colour in ((GROUND, WORLD), (RAISED, POINT)):
        line(ax, place, place + 3.4 * U_I, HIGHER)
        line(ax, place, place + 3.4 * U, VIEWED, "--")
        dot(ax, place, colour, 0.13)
    across = np.array([U_I[1], -U_I[0]])
    line(ax, GROUND - 1.0 * across, GROUND + 4.5 * across, HIGHER, ":")
    line(ax, GROUND - 1.0 * UP, GROUND + 3.9 * UP, VIEWED, ":")
    label(ax, 4.1 * UP + (-0.2, 0.2), "one range of the view", VIEWED, fontsize=10)
    label(ax, 4.5 * across + (0.15, 0.1), "one range\nof pass i", HIGHER, fontsize=10, ha="left")
    arrow(ax, RAISED - nearer * U_I, RAISED, HIGHER)
    label(ax, RAISED - nearer * U_I + (0.15, -0.4), r"$\Delta = y_r\, b/R$ nearer", HIGHER, ha="left")
    label(ax, np.array([0.0, -1.1]), r"phase of $C_{i0}$ = $+k\Delta$ = $\kappa\, y_r$, once deramped", HIGHER)
    label(ax, np.array([0.75, -0.4]), "phase 0", WORLD, fontsize=10)


def heights(ax: Axes) -> None:
    """From elevation to height."""
    scene(ax, r"c   at one range, elevation is $\Delta z$ / cos θ", (-4.4, 5.4), (-1.2, 4.4))
    line(ax, GROUND - 0.8 * UP, GROUND + 3.6 * UP, VIEWED, ":")
    line(ax, GROUND, 3.6 * U, VIEWED, "--")
    for place, colour in ((GROUND, WORLD), (RAISED, POINT)):
        dot(ax, place, colour, 0.1)
    arrow(ax, GROUND, RAISED, VIEWED, both=True)
    arrow(ax, CORNER, RAISED, POINT, both=True)
    label(ax, RAISED / 2 + (-0.95, 0.25), r"$\Delta z\,/\cos\theta$", VIEWED)
    label(ax, (CORNER + RAISED) / 2 + (0.45, 0), r"$\Delta z$", POINT)
    ax.add_patch(Arc(tuple(RAISED), 1.7, 1.7, theta1=270 - VIEW.grazing_deg, theta2=270, color=WORLD, lw=1.2))
    label(ax, RAISED + 1.15 * np.array([-math.sin(THETA / 2), -math.cos(THETA / 2)]), "θ", WORLD)
    label(ax, np.array([0.5, -0.8]), r"$k_z = \kappa\,/\cos\theta$:  phase of a pair per metre of height", WORLD)


def measured(ax: Axes) -> None:
    """The phase of C_10 of level plates: simulated signals, rendered covariances, and k_z z."""
    number = float(np.diff(STACK.elevation_numbers(VIEW))[0])
    ax.plot(HEIGHTS, number / math.cos(THETA) * HEIGHTS, color=FAINT, linewidth=2, label=r"$k_z\, z$")
    ax.plot(HEIGHTS, [simulated_phase(float(z)) for z in HEIGHTS], "o", color=HIGHER, label="simulate_stack")
    ax.plot(HEIGHTS, [rendered_phase(float(z)) for z in HEIGHTS], "x", color=VIEWED, ms=9, label="render_covariances")
    ax.axhline(0, color=WORLD, linewidth=0.8)
    ax.axvline(0, color=WORLD, linewidth=0.8)
    ax.set_title(r"d   deramped phase of $C_{10}$ of a plate at a height", fontsize=12, loc="left", pad=8)
    ax.set(xlabel="height z above the plane, m", ylabel=r"phase, rad  ($b_1/R > b_0/R$)")
    ax.legend(frameon=False, fontsize=11)
    ax.spines[["top", "right"]].set_visible(False)


def simulated_phase(z: float) -> float:
    """Phase of a level plate of 3 × 3 m, from signals."""
    plate = trimesh.creation.box((3.0, 3.0, 0.01))
    plate.apply_translation((0.0, 0.0, z))
    signals = simulate_stack(plate, VIEW, GRID, STACK, ScatteringLaw(1.0, 0.0, 1.0))
    deramped = signals * np.exp(-1j * STACK.plane_phases(VIEW, GRID))
    return float(np.angle((deramped[1] * deramped[0].conj()).sum()))


def rendered_phase(z: float) -> float:
    """Phase of a flat Gaussian, from covariances."""
    law = Harmonics(torch.tensor([[1.0]]))
    flat = torch.tensor([[1.0, 1.0, 0.01]])
    plate = Gaussians(torch.tensor([[0.0, 0.0, z]]), torch.tensor([[1.0, 0, 0, 0]]), flat, torch.tensor([4.0]), law)
    pair = render_covariances(plate, [VIEW], GRID, STACK)[0, 1, 0].detach().numpy()
    level = STACK.plane_phases(VIEW, GRID)
    return float(np.angle((pair * np.exp(1j * (level[0] - level[1]))).sum()))


def main() -> None:
    figure, panels = plt.subplots(2, 2, figsize=(13, 8.6), layout="constrained")
    for draw, ax in zip((passes, phase, heights, measured), panels.ravel(), strict=True):
        draw(ax)
    OUTPUT.parent.mkdir(exist_ok=True)
    figure.savefig(OUTPUT, dpi=90, facecolor="white")


if __name__ == "__main__":
    main()
