"""The benchmark's lines, kept as they finish, and the page that is made of them."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sarsplat.data import write_bytes

RUNS, TABLE, PLOT, PAGE = "chips-runs.csv", "chips.csv", "chips.png", "chips.md"
_DRAWN = ("measured", "turned", "average-turned", "sar-nerf-turned", "ours-turned")
_COMPARED = ("average-turned", "average", "sar-nerf-turned", "turned")


@dataclass(frozen=True)
class Line:
    """A trained network."""

    draw: str
    arm: str
    seed: int
    steps: int
    chosen: int
    """Steps that count; a network of others is not asked about test chips."""
    loss: float
    """Over the last tenth of its training."""
    left_out: float
    """Accuracy on training chips that were left out."""
    test: float
    new_clutter: float
    """… and on test chips in front of other clutter."""
    took_s: float
    by_class: str
    """Accuracy on the test chips of each class, with blanks between."""

    @property
    def key(self) -> tuple[str, str, int, int]:
        """What it is of."""
        return self.draw, self.arm, self.seed, self.steps

    def __str__(self) -> str:
        how = f"{self.draw}, {self.arm}, seed {self.seed}, {self.steps} steps"
        return f"{how}: {self.left_out:.4f} left out, {self.test:.4f} at 15° ({self.took_s:.0f} s)"


def read_lines(out: Path) -> list[Line]:
    """What is there so far."""
    path = out / RUNS
    if not path.is_file():
        return []
    kinds = {field.name: {"int": int, "float": float, "str": str}[str(field.type)] for field in fields(Line)}
    with path.open(newline="", encoding="utf-8") as file:
        return [Line(**{name: kinds[name](text) for name, text in row.items()}) for row in csv.DictReader(file)]


def write_line(out: Path, line: Line) -> None:
    """Add one."""
    lines = [other for other in read_lines(out) if other.key != line.key]
    rows = [asdict(_rounded(one)) for one in (*lines, line)]
    write_bytes(out / RUNS, _csv(rows))


def _rounded(line: Line) -> Line:
    shorter = {field.name: round(getattr(line, field.name), 4) for field in fields(Line) if field.type == "float"}
    return replace(line, **shorter)


def write_page(out: Path, titles: Mapping[str, str]) -> None:
    """Page, table and plot of the networks that are finished."""
    every = read_lines(out)
    lines = [line for line in every if line.steps == line.chosen]
    groups = {
        group: _sized(group) for group in dict.fromkeys(map(_group, sorted(lines, key=lambda one: _order(one.draw))))
    }
    arms = [arm for arm in titles if any(line.arm == arm for line in lines)]
    cells = {
        (arm, group): [line for line in lines if (line.arm, _group(line)) == (arm, group)]
        for arm in arms
        for group in groups
    }
    heads = ["", *groups]

    def table(value: Callable[[Line], float]) -> str:
        return _markdown(
            heads, [[titles[arm], *(_text(map(value, cells[arm, group])) for group in groups)] for arm in arms]
        )

    differences = [
        [f"… above “{titles[other]}”", *(_text(_paired(cells[ours, group], cells[other, group])) for group in groups)]
        for ours in ("ours-turned",)
        for other in _COMPARED
        if ours in arms and other in arms
    ]
    parts = {
        "test": table(lambda line: line.test),
        "differences": _markdown(heads, differences),
        "left_out": table(lambda line: line.left_out),
        "new_clutter": table(lambda line: line.new_clutter),
        "steps": _steps(every, titles),
        "counts": _markdown(
            heads, [["networks of an arm", *(str(max(len(cells[arm, group]) for arm in arms)) for group in groups)]]
        ),
        "chosen": lines[0].chosen if lines else 0,
    }
    write_bytes(out / PAGE, _PAGE.format(**parts).encode())
    rows = [
        {
            "arm": arm,
            "chips": group,
            "networks": len(some),
            "test_mean": _mean(some, "test"),
            "test_sd": _sd(some, "test"),
            "left_out_mean": _mean(some, "left_out"),
            "new_clutter_mean": _mean(some, "new_clutter"),
        }
        for (arm, group), some in cells.items()
        if some
    ]
    write_bytes(out / TABLE, _csv(rows))
    _draw(cells, groups, titles, out / PLOT)


def _group(line: Line) -> str:
    """Draws at random of one size stand in one column."""
    words = line.draw.split()
    return " ".join(words[:3]) if "random" in words else line.draw


def _order(draw: str) -> tuple[float, bool]:
    return _sized(draw), "random" in draw


def _sized(draw: str) -> float:
    return float("inf") if draw == "all" else float(draw.split()[0])


def _paired(ours: Sequence[Line], others: Sequence[Line]) -> Iterable[float]:
    """Differences of networks of the same chips and seed."""
    theirs = {(line.draw, line.seed): line.test for line in others}
    return [line.test - theirs[line.draw, line.seed] for line in ours if (line.draw, line.seed) in theirs]


def _text(values: Iterable[float]) -> str:
    """Mean ± sample standard deviation, per cent."""
    per_cent = [100 * value for value in values if np.isfinite(value)]
    if not per_cent:
        return "–"
    spread = f" ± {statistics.stdev(per_cent):.1f}" if len(per_cent) > 1 else ""
    return f"{statistics.fmean(per_cent):.1f}{spread}"


def _mean(lines: Sequence[Line], name: str) -> float:
    return round(statistics.fmean(getattr(line, name) for line in lines), 4)


def _sd(lines: Sequence[Line], name: str) -> float | str:
    return round(statistics.stdev(getattr(line, name) for line in lines), 4) if len(lines) > 1 else ""


def _steps(every: Sequence[Line], titles: Mapping[str, str]) -> str:
    """Of seed 0 and the draw of which several numbers of steps were tried: accuracy on what was left out."""
    tried = [line for line in every if line.seed == 0 and line.draw == "12 evenly"]
    numbers = sorted({line.steps for line in tried})
    found = {(line.arm, line.steps): line for line in tried}
    rows = [
        [
            titles[arm],
            *(
                f"{100 * found[arm, n].left_out:.1f} ({found[arm, n].loss:.2f})" if (arm, n) in found else "–"
                for n in numbers
            ),
        ]
        for arm in titles
        if sum(arm == line.arm for line in tried) > 1
    ]
    return _markdown(["", *(f"{number:,}" for number in numbers)], rows)


def _markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _csv(rows: Sequence[Mapping[str, object]]) -> bytes:
    text = io.StringIO(newline="")
    if rows:
        table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    return text.getvalue().encode()


def _draw(
    cells: Mapping[tuple[str, str], Sequence[Line]], groups: Mapping[str, float], titles: Mapping[str, str], path: Path
) -> None:
    """Accuracy over the number of chips, evenly spaced ones as lines and others as dots."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for arm in _DRAWN:
        line = None
        for random in (False, True):
            some = [
                (groups[group], 100 * one.test)
                for (name, group), found in cells.items()
                for one in found
                if name == arm and ("random" in group) == random and np.isfinite(groups[group])
            ]
            if not some:
                continue
            if random:
                axes.plot(*zip(*some), ".", color=line, alpha=0.5)
                continue
            sizes = sorted({size for size, _ in some})
            means = [statistics.fmean(value for size, value in some if size == each) for each in sizes]
            line = axes.plot(sizes, means, "o-", label=titles[arm])[0].get_color()
    for (arm, group), found in cells.items():
        if group == "all" and arm == "measured" and found:
            axes.axhline(100 * _mean(found, "test"), color="grey", linestyle=":", label="all 2,747 measured chips")
    axes.set(xscale="log", xlabel="measured chips of a class", ylabel="accuracy on all chips at 15° (%)")
    axes.set_xticks([5, 8, 12, 20, 40], ["5", "8", "12", "20", "40"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120, metadata={"Software": None})
    plt.close(figure)


_PAGE = """# What generated chips are worth to a classifier

Written by `make chips`; do not edit. Ten classes of MSTAR, one vehicle each: a network learns from a few chips at 17° and
from others that are made of these, and is asked about all 2,425 chips at 15°. No reconstruction, no choice of a setting and
no moment to stop has seen a chip at 15°.

Accuracy, per cent, mean ± sample standard deviation over networks and draws:

{test}

{counts}

“12 evenly”: twelve chips of each class, evenly spaced in azimuth; “at random”: draws by seed. Every batch of 32 is half
measured and half generated, or with turned chips a quarter, a quarter and a half. *Turned*: measured chips, turned in the
ground plane by up to half of the mean gap to the next one. *Rotated average*: all chips, turned to the azimuth and averaged;
*SAR-NeRF*: `--method sar-nerf-grid`; both with the same speckle through the response and the same compression as ours.
*sarsplat*: `sarsplat chips` at grazing angles from 14.5° to 17.5°, so that the tests' 15° is among them; *of 17° alone*: 16.5°
to 17.5°. There are 720 chips of a class of each kind.

sarsplat with turned chips, per cent more than others of the same chips and seed:

{differences}

![Accuracy over the number of measured chips](PLOT)

## Without the place

The same networks, asked about test chips with other clutter of the same level in place of all that is eight pixels and more
from target and shadow, by the masks of our own runs.

{new_clutter}

## Training chips that were left out

The same networks, asked about the chips at 17° that they were not trained on:

{left_out}

Of networks of twelve evenly spaced chips and seed 0, by the number of steps (in brackets: the loss over the last tenth of
them). It is {chosen:,} everywhere else.

{steps}

The network is A-ConvNets with batch norm, which sees the middle 88 × 88 pixels of a chip, displaced by up to four, as roots
of magnitudes, standardised chip by chip; the statistics of the batch norm are those of measured chips. Every network:
[chips-runs.csv](chips-runs.csv); figures: [chips.csv](chips.csv). How real the chips look:
[chips-realism.md](chips-realism.md).
""".replace("PLOT", PLOT)  # noqa: E501
