"""The page of the comparison: a table for every set, quality against time, and pictures."""

from __future__ import annotations

import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from baseline_runs import scores_of, write_runs
from jaxtyping import Bool
from matplotlib.figure import Figure
from summary import METRIC

from sarsplat.colours import HEIGHT, POWER, colormap
from sarsplat.data import write_bytes
from sarsplat.evaluation.paper import NOT_THE_SAME_EXPERIMENT, paper_scores
from sarsplat.radiometry import DYNAMIC_RANGE_DB, brighter, shade

if TYPE_CHECKING:
    from baselines import Bout, Comparison

RENDERED = ("psnr_db", "psnr_target_db", "ssim", "lpips", "cd_m", "f1@0.3", "f1@0.1")
MEASURED = ("registered_nats_per_pixel", "registered_log_correlation", "nats_per_pixel", "cd_m", "f1@0.3")
_DRAWN = {"psnr_target_db": "PSNR of the target, dB", "registered_nats_per_pixel": "registered nats per pixel"}
_PAPER_SAR_NERF = {
    "T72": {"psnr_db": 34.29, "ssim": 0.9894, "lpips": 0.0262, "time_s": 5599},
    "BTR70": {"psnr_db": 34.54, "ssim": 0.9911, "lpips": 0.0224, "time_s": 5666},
    "KRAZ": {"psnr_db": 36.65, "ssim": 0.9953, "lpips": 0.0178, "time_s": 5432},
}
"""Table II, rendered sets; times on an RTX 3060 Ti."""

_PAPER_MEASURED = {
    "SAR-GS": {"cd_m": 0.179, "f1@0.3": 0.904},
    "DSR": {"cd_m": 0.196, "f1@0.3": 0.845, "time_s": 596},
}
"""Table V, the measured T72 against another model; the time on an RTX 2080 Ti."""

_COLOURS = ("#1f4e79", "#c0392b", "#d98e04", "#4d8c57", "#7a5195", "#8c6d5a")
_RIM = 4  # pixels


_ABOUT = """SAR-NeRF and DSR, written afresh ([docs/baselines.md](../baselines.md)), beside sarsplat on the same images,
scored the same way. Every training has one thread, and its time is that of this core. *In our time*: as many iterations
as fit into the time that sarsplat takes, the learning rate falling within them; *full*: as long as the settings
say. The perceptron's training would take months: it gets ten minutes, and its steps show how far it came; it is
left out where hundreds of chips would have to be rendered, each of which takes it ten seconds. Mean ±
sample standard deviation over the seeds. The peak memory is that of the whole process until the end of the training,
Python and its libraries included. Points are held against the visible surface; those of measured chips against a
procedural model of a T-72, brought onto it by a small motion."""


def write(comparison: Comparison) -> Path:
    """Write the page as far as it is finished, with its pictures; those that need what another machine has stay.

    Parameters
    ----------
    comparison : Comparison
        What was done.
    """
    out = comparison.out
    out.mkdir(parents=True, exist_ok=True)
    parts = [f"# Baselines\n\n{_ABOUT}\n{_unfinished(comparison)}"]
    curves: dict[str, list[tuple[str, list[tuple[float, float]]]]] = {}
    all_here = True
    for images in comparison.sets:
        bouts = [*comparison.bouts(images)]
        rows = [_row(bout, comparison) for bout in bouts]
        if not any(rows):
            continue
        keys = MEASURED if images.chips else RENDERED
        finished = [row for row in rows if row]
        parts.append(f"\n## {images.name}\n\n{_finding(keys, finished)}\n\n{_table(keys, finished, images.name)}")
        parts += [f"\n–: {text}\n" for text in _missing(keys, finished)]
        if lines := _lines(bouts, comparison, keys):
            curves[images.name] = lines
        name = f"baselines-{'-'.join(re.findall(r'[a-z0-9]+', images.name.lower()))}.png"
        here = all(comparison.is_here(bout.cells[0]) for bout, row in zip(bouts, rows, strict=True) if row)
        all_here = all_here and here
        if here and (drawn := _pictures(bouts, comparison)):
            _save(drawn, out / name)
        if (out / name).is_file():
            parts.append(f"\n![Two unseen images and the points of every method]({name})\n")
    if curves and all_here:
        _save(_against_time(curves), out / "baselines.png")
    if (out / "baselines.png").is_file():
        parts.append(
            "\n## Quality against time\n\nThe first seed, scored on a quarter of the unseen images as it trains (the "
            "learning rate is then that of the full training), and at its end.\n\n"
            "![Quality against time](baselines.png)\n"
        )
    parts.append(
        f"\n{NOT_THE_SAME_EXPERIMENT}\n\nEvery training with all its scores: "
        f"[baselines-runs.csv](baselines-runs.csv). Written by `make baselines` from code version {comparison.code}.\n"
    )
    write_runs(comparison)
    page = out / "baselines.md"
    write_bytes(page, "".join(parts).encode())
    return page


def _unfinished(comparison: Comparison) -> str:
    """What is missing, if anything is."""
    cells = [cell for images in comparison.sets for bout in comparison.bouts(images) for cell in bout.cells]
    done = sum(comparison.read(cell) is not None for cell in cells)
    if done == len(cells):
        return ""
    return (
        f"\n**Not complete:** {done} of at least {len(cells)} trainings are finished; what is missing is not shown.\n"
    )


def _row(bout: Bout, comparison: Comparison) -> dict[str, Any] | None:
    results = [one for cell in bout.cells if (one := comparison.read(cell)) is not None]
    if not results:
        return None
    scores = [scores_of(one) for one in results]
    budget = "" if bout.contender.reference else ", in our time" if bout.equal else ", full"
    if bout.cells[0].seconds is not None and not bout.equal:
        budget = f", stopped after {bout.contender.seconds / 60:.0f} min"
    return {
        "name": bout.contender.title + budget,
        "seeds": len(results),
        "steps": statistics.fmean(one["iterations"] for one in results),
        "time_s": [one["time_s"] for one in results],
        "peak": max(one["peak_bytes"] for one in results) / 1e9,
        "reasons": results[0]["reasons"],
        "scores": {key: [one[key] for one in scores] for key in scores[0] if all(key in one for one in scores)},
    }


def _finding(keys: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    """Who is best, from the means."""
    ours, *baselines = rows
    better = []
    for key in keys:
        metric, own = METRIC[key], ours["scores"].get(key)
        means = {row["name"]: statistics.fmean(row["scores"][key]) for row in baselines if key in row["scores"]}
        if own is None or not means:
            continue
        best = metric.best([statistics.fmean(own), *means.values()])
        winners = [name for name, mean in means.items() if mean == best and mean != statistics.fmean(own)]
        better += [f"{metric.label} ({name})" for name in winners]
    if not baselines:
        return "No baseline is finished yet."
    if not better:
        return "sarsplat is the best of them in every score."
    return f"A baseline is the best in: {'; '.join(better)}. In all else it is sarsplat."


def _missing(keys: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why rows lack scores: each reason that the evaluation gave, and who lacks which scores for it."""
    lacking: dict[str, dict[str, list[str]]] = {}
    for row in (row for row in rows if row["reasons"]):  # there are none of what was done elsewhere
        for key in (key for key in keys if key not in row["scores"]):
            reason = next((text for name, text in row["reasons"].items() if name.endswith(f".{key}")), "unknown")
            reason = re.sub(r"\d+ of \d+ scored pixels", "some scored pixels", reason)  # the same for all test sets
            lacking.setdefault(reason, {}).setdefault(row["name"], []).append(METRIC[key].label)
    return [
        f"{reason} ({'; '.join(f'{name}: ' + ', '.join(labels) for name, labels in whose.items())})."
        for reason, whose in lacking.items()
    ]


def _spread(values: Sequence[float], digits: int) -> str:
    mean = f"{statistics.fmean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {statistics.stdev(values):.{digits}f}"


def _table(keys: Sequence[str], rows: Sequence[Mapping[str, Any]], images: str) -> str:
    heads = ["", *(f"{METRIC[key].title} {METRIC[key].arrow}".strip() for key in keys)]
    heads += ["time of one core, s", "steps", "peak memory, GB", "seeds"]
    cells = []
    for row in rows:
        texts = [row["name"]]
        for key in keys:
            values = row["scores"].get(key)
            digits = len(METRIC[key].text(values[0]).partition(".")[2]) if values else 0
            texts.append(_spread(values, digits) if values else "–")
        texts += [_spread(row["time_s"], 0), f"{row['steps']:,.0f}", f"{row['peak']:.2g}", str(row["seeds"])]
        cells.append(texts)
    for name, values in _published(images).items():
        texts = [METRIC[key].text(values.get(key)) for key in (*keys, "time_s")]
        if any(text != "–" for text in texts[:-1]):
            cells.append([f"*paper: {name}*", *texts, "–", "–", "–"])
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *cells]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _published(images: str) -> dict[str, dict[str, float]]:
    """What the paper has beside a set's table: scores by method, its own first."""
    target = images.split(",")[0].upper()
    if "chips" in images:
        return _PAPER_MEASURED
    return {"SAR-GS": dict(paper_scores(target).values), "SAR-NeRF": _PAPER_SAR_NERF[target]}


def _lines(
    bouts: Sequence[Bout], comparison: Comparison, keys: Sequence[str]
) -> list[tuple[str, list[tuple[float, float]]]]:
    """Time and score of every contender of which there is a curve: those on the way, then the end."""
    key, lines = next(key for key in keys if key in _DRAWN), []
    for bout in bouts:
        result = comparison.read(bout.cells[0])
        if result is not None:
            points = [(point["seconds"], scores_of(point)) for point in result["curve"]]
            points.append((result["time_s"], scores_of(result)))
            title = bout.contender.title + ", in our time" * bout.equal
            if scored := [(seconds, scores[key]) for seconds, scores in points if key in scores]:
                lines.append((title, scored))
    return lines if any(len(points) > 1 for _, points in lines) else []


def _against_time(curves: Mapping[str, Sequence[tuple[str, Sequence[tuple[float, float]]]]]) -> Figure:
    figure, axes = plt.subplots(1, len(curves), figsize=(6 * len(curves), 4), squeeze=False, layout="constrained")
    whose = [name.removesuffix(", in our time") for lines in curves.values() for name, _ in lines]
    names = list(dict.fromkeys(whose))
    for ax, (images, lines) in zip(axes[0], curves.items()):
        for name, points in lines:
            equal, method = name.endswith(", in our time"), name.removesuffix(", in our time")
            colour, label = _COLOURS[names.index(method) % len(_COLOURS)], None if equal else name
            ax.plot(*zip(*points), "D" if equal else "o-", ms=5 if equal else 3.5, color=colour, label=label)
        measured = "chips" in images
        ax.set(xscale="log", xlabel="time of one core, s", title=images)
        ax.set_ylabel(_DRAWN[MEASURED[0] if measured else RENDERED[1]] + (" (less is better)" if measured else ""))
        if measured:
            ax.invert_yaxis()
        ax.grid(alpha=0.25, which="both")
        ax.legend(fontsize=7)
    return figure


def _pictures(bouts: Sequence[Bout], comparison: Comparison) -> Figure | None:
    """A row for the truth and one for every contender at its full budget: two unseen images, and its points."""
    shown = []
    for bout in bouts:
        path = comparison.path(bout.cells[0]).with_suffix(".npz")
        if path.is_file() and not bout.equal:
            with np.load(path, allow_pickle=False) as kept:
                shown.append((bout.contender.title, {name: kept[name] for name in kept.files}))
    if not shown:
        return None
    truth = shown[0][1]["truth"]
    shown_part = _around(brighter(truth, -DYNAMIC_RANGE_DB))
    height, width = truth[0][shown_part].shape
    figure, axes = plt.subplots(
        len(shown) + 1,
        3,
        figsize=(9, max(1.5, 2.5 * height / width) * (len(shown) + 1)),
        width_ratios=(1, 1, 1.6),
        layout="constrained",
    )
    for row, (title, kept) in zip(axes, [("truth: two unseen images, 40 dB", {"images": truth}), *shown]):
        for ax, image in zip(row, kept["images"]):
            ax.imshow(shade(image[shown_part], truth.max()), cmap=colormap(POWER), vmin=0, vmax=1)
            ax.set(xticks=[], yticks=[])
        row[0].set_title(title, fontsize=8, loc="left", pad=3)
        points = kept.get("points", np.empty((0, 3)))
        row[2].scatter(points[:, 0], points[:, 2], c=points[:, 1], s=0.3, cmap=colormap(HEIGHT), linewidths=0)
        row[2].set_aspect("equal")
        row[2].tick_params(labelsize=7)
    for ax in axes[1:, 2]:
        ax.sharex(axes[1, 2])
        ax.sharey(axes[1, 2])
    axes[0, 2].axis("off")
    axes[-1, 2].set_xlabel("x, m; z, m upwards; colour: y", fontsize=8)
    return figure


def _around(bright: Bool[np.ndarray, "v rows columns"]) -> tuple[slice, slice]:
    """Rows and columns in which any of the images is bright, and some around them."""
    rows, columns = (np.flatnonzero(bright.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    return tuple(slice(max(0, int(places[0]) - _RIM), int(places[-1]) + 1 + _RIM) for places in (rows, columns))


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=90, facecolor="white", metadata={"Software": None}, pil_kwargs={"optimize": True})
    plt.close(figure)
