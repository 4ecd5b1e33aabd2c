"""`sarsplat info` of a dataset: its properties, and its views on the sky."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sarsplat.cli import console
from sarsplat.cli.arguments import require_ending
from sarsplat.cli.import_mstar import SplitSource
from sarsplat.errors import counted

if TYPE_CHECKING:
    import numpy as np

    from sarsplat.data import Dataset
    from sarsplat.data.coverage import ViewGroup
    from sarsplat.geometry import ImageGrid, Stack, Turn, View

_CALIBRATIONS = {"absolute": "absolute", "relative": "relative: β⁰ up to one common factor"}

_LISTED = 8  # maximum number of azimuths of a set at one grazing angle that are listed; more are described
_ARC = 2.5  # maximum gap of views that go all around, in steps

_QUANTITIES = {False: "β⁰, linear power, float32", True: "complex amplitude, whose squared magnitude is β⁰, complex64"}
"""Quantity of pixels, by whether their phase is known."""


def describe_dataset(path: Path, plot: Path | None) -> None:
    """Print the properties of a dataset, and draw its views to `plot`."""
    from sarsplat.data import read_dataset
    from sarsplat.data.coverage import view_groups
    from sarsplat.examination.plausible import suspicions

    if plot is not None:
        require_ending("plot", plot, ".png", ".svg")
    dataset = read_dataset(path)
    for text in suspicions(dataset):
        console.warn(text)
    console.facts(
        f"{path}: a dataset of {counted(len(dataset), 'stack' if dataset.passes else 'image')}", _facts(dataset, path)
    )
    console.show(_table(view_groups(dataset)))
    terminal = Console()
    symbols = symbols_for(terminal.encoding)
    train = dataset.select("train").views
    tests = [entry.view for entry in dataset.entries if entry.split != "train"]
    place = dataset.place  # a place on earth has no nose
    zero = "nose" if place is None else f"compass bearing {place.x_towards_deg:.4g}°"
    console.show(sky_chart(train, tests, terminal.width, symbols, zero))
    console.say(legend([split for split in dataset.splits() if split != "train"], symbols, train[0].aloft))
    if found := dataset.source.get("contradictions"):
        look = shlex.join(["sarsplat", "check", str(path)])
        many = counted(len(found) if isinstance(found, list) else 1, "contradiction")
        console.warn(f"its images contradict its header ({many}, found when it was made); `{look}` lists them")
    if plot is not None:
        from sarsplat.data import write_bytes
        from sarsplat.report.sheet import sky_picture

        title = f"{dataset.target}: {counted(len(dataset), 'view')}"
        write_bytes(plot, sky_picture(train, tests, title, plot.suffix[1:].lower(), zero))
        console.say(f"wrote {plot}")


_SENTENCES = {"assumptions": "assumed", "contradictions": "contradicted"}
"""Row names of the lists of sentences in a dataset's source."""


def _facts(dataset: Dataset, path: Path) -> dict[str, str]:
    from sarsplat.data.coverage import largest_gap
    from sarsplat.examination.plausible import weakest_direction

    train = dataset.select("train").views
    gap = largest_gap(view.azimuth_deg for view in train)
    optional: dict[str, object] = {
        "terrain": dataset.terrain,
        "place": dataset.place,
        "azimuth": _uncertainty([entry.azimuth_std_deg for entry in dataset.entries]),
        "rotations": _rotations([entry.turn for entry in dataset.entries if entry.turn is not None]),
        "views": _looks(dataset.views),
        "largest gap": "" if train[0].aloft else f"{gap} (azimuths of the training views)",
    }
    return {
        "target": dataset.target,
        "calibration": _CALIBRATIONS[dataset.calibration],
        "speckle": dataset.speckle,
        "ground": "shown" if dataset.ground else "not shown",
        **{name: str(value) for name, value in optional.items() if value},
        **(_passes(dataset.stacks[0]) if dataset.passes else {"weakest direction": str(weakest_direction(train))}),
        "protocol": dataset.protocol or "none",
        "quantity": f"{_QUANTITIES[dataset.signal is not None]}; row 0 near range",
        **_grid(dataset.grid),
        **{f"set {split}": _set(dataset.images(split)) for split in dataset.splits()},
        "truth": dataset.truth_mesh.name if dataset.truth_mesh else "no mesh",
        "masks": "masks/" if (path / "masks").is_dir() else "none",
        **_source(dataset.target, dataset.source),
    }


def _looks(views: Sequence[View]) -> str:
    """Return remarks on inverse SAR, tilt and side left; "" for level views to the right."""
    low, high = (bound(round(view.tilt_deg, 1) for view in views) for bound in (min, max))
    left = sum(view.side == "left" for view in views)
    remarks = ["of a target aloft (inverse SAR)"] * views[0].aloft
    if low or high:
        remarks.append(f"azimuth axis tilted by {low:g}°" + ("" if low == high else f" to {high:g}°"))
    if left:
        remarks.append("looking left" if left == len(views) else f"{left} of {len(views)} looking left")
    return ", ".join(remarks)


def _passes(stack: Stack) -> dict[str, str]:
    """Return rows about the passes of an image."""
    count = len(set(stack.offsets_rad))
    each = f", {stack.transmit} transmits" if count > 1 else ""
    rows = {"passes": f"{count}, wavelength {stack.wavelength_m:g} m{each}"}
    if stack.interferometric:
        rows["elevation"] = f"resolution {stack.resolution_m:.3g} m, ambiguous by {stack.ambiguous_elevation_m:.3g} m"
    if stack.polarisations is not None:
        rows["polarisations"] = ", ".join(stack.polarisations)
    noise = "not stated" if stack.noise is None else ", ".join(f"{power:.3g}" for power in stack.noise)
    return {**rows, "noise": f"{noise} (β⁰ of each channel)"}


def _source(target: str, source: Mapping[str, Any]) -> dict[str, str]:
    """Return rows about the origin of the images: a line for each sentence, a count for nested lists."""
    from sarsplat.data.dataset_folder import HEADER

    split = SplitSource.of(target, source)
    rows = {} if split is None else split.rows()
    for name, value in source.items():
        if not value or name in rows:
            continue
        parts = [*value.values()] if isinstance(value, dict) else value
        if not isinstance(parts, list):
            rows[f"source.{name}"] = f"{value:.6g}" if isinstance(value, float) else str(value)
        elif name in _SENTENCES:
            rows[_SENTENCES[name]] = "\n".join(map(str, parts))
        elif any(isinstance(part, dict | list) for part in parts):
            rows[f"source.{name}"] = f"{len(parts)}, listed in {HEADER}"
        elif isinstance(value, dict):
            rows[f"source.{name}"] = ", ".join(f"{key} = {one}" for key, one in value.items())
        else:
            rows[f"source.{name}"] = ", ".join(map(str, parts))
    return rows


def _uncertainty(std_deg: list[float]) -> str:
    low, high = min(std_deg), max(std_deg)
    if not high:
        return ""
    return f"± {low:g}°" if low == high else f"± {low:g}° to {high:g}°"


def _rotations(turns: list[Turn]) -> str:
    """Return the number of passes of a target aloft, with the largest uncertainties; "" without turns."""
    if not turns:
        return ""
    axis_std_deg, rate_std = (max(getattr(turn, name) for turn in turns) for name in ("axis_std_deg", "rate_std"))
    known = [f"axis ± {axis_std_deg:g}°"] * (axis_std_deg > 0) + [f"rate ± {rate_std:.2g}"] * (rate_std > 0)
    count = len({turn.of_pass for turn in turns})
    return ", ".join([f"{count} pass{'es' * (count > 1)}", *(known or ["known exactly"])])


def _set(images: np.ndarray) -> str:
    return f"{counted(len(images), 'image')}, mean β⁰ {images.mean():.4g}, largest {images.max():.4g}"


def _grid(grid: ImageGrid) -> dict[str, str]:
    def pair(values: tuple[float, float]) -> str:
        return f"{values[0]:g} m in azimuth, {values[1]:g} m in slant range"

    return {
        "pixels": f"{grid.rows} rows (range) × {grid.columns} columns (azimuth)",
        "spacing": pair(grid.spacing_m),
        "resolution": f"{pair(grid.resolution_m)} (3 dB)",
    }


def _table(groups: list[ViewGroup]) -> Table:
    """Return a table with a row for every set and grazing angle."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for name in ("set", "grazing", "views", "azimuths", "step", "largest gap"):
        table.add_column(name, justify="right" if name == "views" else "left", overflow="fold")
    for group in groups:
        low, high = group.grazing_deg
        table.add_row(
            group.split,
            _angle(low) if _angle(low) == _angle(high) else f"{low:.4g}° … {high:.4g}°",
            str(len(group.views)),
            _azimuths(group),
            "–" if group.step_deg is None else _angle(group.step_deg),
            str(group.gap) if group.step_deg is not None else "–",
        )
    return table


def _azimuths(group: ViewGroup) -> str:
    azimuths = sorted({round(azimuth, 6) % 360 for azimuth in group.azimuths_deg})  # 0 is seldom 0 to the last bit
    if len(azimuths) <= _LISTED:
        return ", ".join(f"{azimuth:.4g}" for azimuth in azimuths) + "°"
    gap, step = group.gap, group.step_deg
    if step is not None and gap.width_deg > _ARC * step:
        return f"{_angle(gap.last_deg)} … {_angle(gap.first_deg)}, clockwise"
    return f"{_angle(azimuths[0])} … {_angle(azimuths[-1])}"


def _angle(degrees: float) -> str:
    return f"{degrees:.4g}°"


# ---- chart of views as points on the sky, drawn with characters ----
_WIDEST, _NARROWEST = 48, 24  # columns
_RINGS_DEG = (0.0, 30.0, 60.0)
_RINGS_ALOFT_DEG = (-30.0, 0.0, 30.0)
_DOTS_ACROSS, _DOTS_DOWN = 2, 4  # of a braille character
_BRAILLE = 0x2800
_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))


@dataclass(frozen=True)
class Symbols:
    """Characters of a chart; rings are of braille dots unless `ring` is given."""

    train: str
    test: str
    ring: str | None = None


PLAIN = Symbols("o", "x", ".")
"""Symbols of ASCII."""

PRETTY = Symbols("●", "○")


def symbols_for(encoding: str) -> Symbols:
    """Return the symbols that a terminal of this encoding can show."""
    try:
        (PRETTY.train + PRETTY.test + chr(_BRAILLE)).encode(encoding)
    except (UnicodeEncodeError, LookupError):
        return PLAIN
    return PRETTY


def sky_chart(train: Sequence[View], test: Sequence[View], width: int, symbols: Symbols, zero: str = "nose") -> Text:
    """Draw the sky from above: the zenith in the middle, the horizon around, azimuth 0°, named `zero`, at the top.

    At most `width` columns; a training view hides a test view in the same place.
    """
    columns = max(_NARROWEST, min(width, _WIDEST)) - 10  # labels at the sides
    rows = columns * _DOTS_ACROSS // _DOTS_DOWN + 1
    middle = (columns * _DOTS_ACROSS // 2, rows * _DOTS_DOWN // 2)
    radius = min(middle) - 1
    aloft = any(view.aloft for view in train)
    farthest, rings = (180, _RINGS_ALOFT_DEG) if aloft else (90, _RINGS_DEG)  # the nadir around, or the horizon

    def place(azimuth_deg: float, grazing_deg: float) -> tuple[int, int]:
        """Return the dot of a direction."""
        distance = radius * (90 - grazing_deg) / farthest
        angle = math.radians(azimuth_deg)
        return round(middle[0] + distance * math.sin(angle)), round(middle[1] - distance * math.cos(angle))

    cells = [[" "] * columns for _ in range(rows)]
    for ring in rings:
        count = max(24, round(radius * (90 - ring) / farthest * 1.6))
        for x, y in {place(360 * k / count, ring) for k in range(count)}:
            row, column = y // _DOTS_DOWN, x // _DOTS_ACROSS
            if symbols.ring is not None:
                cells[row][column] = symbols.ring
            else:
                before = 0 if cells[row][column] == " " else ord(cells[row][column]) - _BRAILLE
                cells[row][column] = chr(_BRAILLE + (before | _BITS[y % _DOTS_DOWN][x % _DOTS_ACROSS]))
    styles: dict[tuple[int, int], str] = {}
    for views, symbol, style in ((test, symbols.test, "yellow"), (train, symbols.train, "bold cyan")):
        for view in views:
            x, y = place(view.azimuth_deg, view.grazing_deg)
            cells[y // _DOTS_DOWN][x // _DOTS_ACROSS] = symbol
            styles[y // _DOTS_DOWN, x // _DOTS_ACROSS] = style
    return _labelled(cells, styles, f"0° ({zero})")


def _labelled(cells: Sequence[Sequence[str]], styles: dict[tuple[int, int], str], zero: str) -> Text:
    columns, margin = len(cells[0]), 5
    text = Text(zero.center(columns + 2 * margin).rstrip() + "\n", no_wrap=True)
    for row, line in enumerate(cells):
        at_the_middle = row == len(cells) // 2
        text.append("270° ".rjust(margin) if at_the_middle else " " * margin)
        for column, symbol in enumerate(line):
            text.append(symbol, style=styles.get((row, column), "dim"))
        text.append(" 90°\n" if at_the_middle else "\n")
    text.append("180°".center(columns + 2 * margin).rstrip())
    return text


def legend(tests: Iterable[str], symbols: Symbols, aloft: bool = False) -> str:
    """Return a legend of symbols and rings with the names of the test sets."""
    named = ", ".join(tests)
    points = f"{symbols.train} train" + (f"  {symbols.test} {named}" if named else "")
    around = "; around: from below; rings: grazing 30°, 0° and −30°" if aloft else "; rings: grazing 60°, 30° and 0°"
    return f"{points}; middle: straight from above{around}"
