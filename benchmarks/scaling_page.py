"""Fill docs/reference/scaling.md and docs/images/scaling.png from scenes-quick.json, tiles.json and fleets.json.

These, in benchmarks/results, are written by `python benchmarks/scenes.py quick`, `python benchmarks/tiles.py` and
`python benchmarks/fleets.py`, on an idle machine.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from results import REPOSITORY, RESULTS

sys.path.insert(0, str(REPOSITORY / "docs"))
from fill_block import fill_block

PAGE, PICTURE = REPOSITORY / "docs" / "reference" / "scaling.md", REPOSITORY / "docs" / "images" / "scaling.png"
COLOURS = {"simulate": "#4878a8", "train": "#c0392b", "render by tiles": "#7a9a3a"}
VIEWS = 24
SCENE_KM2, PIXEL_M, TARGETS, CORES = 1000.0, 0.3, 100_000, 1000  # what is projected


def slope(sides: list[int], values: list[float]) -> float:
    """Of the straight line through the logarithms: 2 is linear in area."""
    return float(np.polyfit(np.log(sides), np.log(values), 1)[0])


def draw(scenes: list[dict[str, Any]], tiles: list[dict[str, Any]]) -> dict[str, float]:
    """Time and memory against the side; the exponents of time by name."""
    figure, (time, memory) = plt.subplots(1, 2, figsize=(9, 3.7), layout="constrained")
    series = {
        part: ([row["side"] for row in scenes], [row["parts"][part] for row in scenes])
        for part in ("simulate", "train")
    }
    series["render by tiles"] = ([row["side"] for row in tiles], tiles)
    exponents = {}
    for name, (sides, rows) in series.items():
        seconds = [row["seconds"] for row in rows]
        exponents[name] = slope(sides[-3:], seconds[-3:])
        time.plot(sides, seconds, "o-", color=COLOURS[name], label=f"{name}, exponent {exponents[name]:.2f}")
        memory.plot(sides, [row["peak_gib"] for row in rows], "o-", color=COLOURS[name], label=name)
    for ax, label in ((time, "seconds"), (memory, "peak memory of the process (GiB)")):
        ax.set(xscale="log", yscale="log", xlabel="pixels of a side", ylabel=label)
        ax.legend(fontsize=8)
        ax.grid(alpha=0.25)
    figure.savefig(PICTURE, dpi=90, facecolor="white", pil_kwargs={"optimize": True})
    plt.close(figure)
    return exponents


def fleet_lines(fleets: dict[str, Any]) -> list[str]:
    """What a sweep costs, as Markdown."""
    executors = {"local": "local processes", "ray": "Ray, two nodes"}
    lines = [
        f"Runs of [a sweep](../how-to/sweep.md), {fleets['processes']} at a time, one thread each; load before: "
        f"{fleets['machine']['load']:.1f}. The smallest run, 5 iterations on 32² pixels, is hardly more than what a "
        "sweep itself costs:",
        "",
        "| by | to begin | the smallest run | T-72, 128², 24 views, `quick`, scored on 48 |",
        "|---|---:|---:|---:|",
    ]
    return lines + [
        f"| {executors[row['executor']]} | {row['begin_s']:.2g} s | {row['tiny_s']:.2g} s | {row['t72_s']:.3g} s |"
        for row in fleets["rows"]
    ]


def targets_line(fleets: dict[str, Any]) -> str:
    """What many targets take: time of a run and, at most, what is added to any, times their number."""
    (ray,) = [row for row in fleets["rows"] if row["executor"] == "ray"]
    hours = (ray["t72_s"] + ray["tiny_s"]) * TARGETS / 3600
    return (
        f"- **{TARGETS:,} targets like the T-72, trained with `quick` and scored, on a Ray cluster**: "
        f"({ray['t72_s']:.3g} + {ray['tiny_s']:.2g}) s × {TARGETS:,} = {hours:,.0f} core hours, or "
        f"{hours / CORES:.2g} h on {CORES:,} cores, if their images can be read as fast."
    )


def section(
    scenes: dict[str, Any], tiles: dict[str, Any], fleets: dict[str, Any] | None, exponents: dict[str, float]
) -> str:
    """Tables and projections, as Markdown; fleets are None until they are measured."""
    rows = scenes["rows"]
    last, largest, machine = rows[-1], tiles["rows"][-1], scenes["machine"]
    lines = [
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, {machine['date']}; "
        f"load before: {machine['load']:.1f}. {VIEWS} views.",
        "",
        "| image | faces | Gaussians | simulate | train | peak | F1 at 0.3 m |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        parts = row["parts"]
        lines.append(
            f"| {row['side']}² | {row['faces']:,} | {row['gaussians']:,} | {parts['simulate']['seconds']:.3g} s | "
            f"{parts['train']['seconds']:.3g} s | {parts['train']['peak_gib']:.2g} GiB | {row['f1']['0.3']:.3f} |"
        )
    lines += ["", "One view by tiles, one thread:", "", "| image | Gaussians | time | peak |", "|---|---:|---:|---:|"]
    lines += [
        f"| {row['side']:,}² | {row['gaussians']:,} | {row['seconds']:.3g} s | {row['peak_gib']:.2g} GiB |"
        for row in tiles["rows"]
    ]
    named = ", ".join(f"{name} {value:.2f}" for name, value in exponents.items())
    lines += [
        "",
        f"Exponents of time against the side, over the three largest sizes (2 is linear in area): {named}.",
        "",
    ]
    if fleets is not None:
        lines += [*fleet_lines(fleets), ""]

    km2 = (last["side"] * PIXEL_M * 1e-3) ** 2
    seconds, pixels = last["parts"]["train"]["seconds"] * machine["cores"], SCENE_KM2 * 1e6 / PIXEL_M**2
    view_h, scene_h = largest["seconds"] / largest["side"] ** 2 * pixels / 3600, seconds / km2 * SCENE_KM2 / 3600
    lines += [
        "## What larger things take, on paper",
        "",
        f"- **{SCENE_KM2:,.0f} km² at {PIXEL_M} m, one view rendered**: {largest['seconds']:.3g} s for "
        f"{largest['side']:,}² pixels, so {view_h:.2g} core hours for {pixels:.2g} pixels.",
        f"- **The same, trained on {VIEWS} views with `quick`, without points**: {seconds:.3g} core seconds for "
        f"{km2:.2g} km², so {scene_h:,.0f} core hours if all of it were built up like the village, or "
        f"{scene_h / 1000:.2g} h on 1,000 cores. It would have to go by tiles, whose halos are not counted.",
        *([] if fleets is None else [targets_line(fleets)]),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    scenes, tiles = (
        json.loads((RESULTS / name).read_text(encoding="utf-8")) for name in ("scenes-quick.json", "tiles.json")
    )
    known = RESULTS / "fleets.json"
    fleets = json.loads(known.read_text(encoding="utf-8")) if known.exists() else None
    fill_block(PAGE, "scaling", section(scenes, tiles, fleets, draw(scenes["rows"], tiles["rows"])))
