"""Recognise a folder of images that is not a dataset, and name the command that imports it."""

from __future__ import annotations

import itertools
import math
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sarsplat.data.csv_table import CsvTable, parsed, read_table
from sarsplat.data.files import plain_os_errors
from sarsplat.errors import SarsplatError, counted
from sarsplat.importers.columns import Columns, chosen_columns
from sarsplat.importers.mstar_chips import LABEL_COLUMNS, has_label_columns, read_labels
from sarsplat.importers.phoenix import is_phoenix, read_phoenix
from sarsplat.importers.pictures import PICTURE_ENDINGS
from sarsplat.importers.sample import SampleName, named_as_sample

_MOST_FILES = 20_000
"""More are not looked at: somebody gave a home folder."""

_MOST_READ = 500
"""Number of Phoenix files whose headers are read; the others are assumed to be of the same classes."""

_OTHERS = (
    ((".nitf", ".ntf"), "sicd", "which may be SICD"),
    ((".mat",), "phase-history", "which may be phase history"),
)
"""Endings, the command that reads such files, and what they may be."""

_NEEDED = ("file", "azimuth", "grazing", "spacing")
_JPEGS = (".jpg", ".jpeg")
_USUAL_DEPRESSION, _USUAL_VIEWS = 17, 36


@dataclass(frozen=True)
class Recognised:
    """What a folder of images seems to be.

    Attributes
    ----------
    kind : str
        In a few words.
    facts : dict of str to str
        Names and values.
    command : str or None
        What to type to import it; words in capitals are to be replaced. None if there is no such command.
    """

    kind: str
    facts: dict[str, str] = field(default_factory=dict)
    command: str | None = None


def recognised(folder: Path) -> Recognised | None:
    """Contents of a folder that is neither a dataset nor a run; None if there are no images in it.

    Parameters
    ----------
    folder : Path
        At most its first 20,000 files are looked at, those of its subfolders included; a table of labels of MSTAR
        chips may also lie up to two folders above.

    Raises
    ------
    SarsplatError
        If it cannot be read, or a table of labels or a Phoenix file in it is damaged.
    """
    with plain_os_errors("read", folder):
        files = sorted(itertools.islice((path for path in folder.rglob("*") if path.is_file()), _MOST_FILES))
        above = [path for parent in folder.absolute().parents[:2] for path in sorted(parent.glob("*.csv"))]
    by_ending = Counter(path.suffix.lower() for path in files)
    tables = [path for path in files if path.suffix.lower() == ".csv"]
    pictures = sum(by_ending[ending] for ending in PICTURE_ENDINGS)
    jpegs = sum(by_ending[ending] for ending in _JPEGS)
    listed = _with_table(folder, tables, pictures) if pictures else None
    if listed is not None and "missing" not in listed.facts:
        return listed
    for table in (*tables, *above) if jpegs else ():
        if has_label_columns(table) and (labelled := _labelled(folder, table)) is not None:
            return labelled
    if phoenix := [path for path in files if path.suffix.lower() not in PICTURE_ENDINGS and is_phoenix(path)]:
        return _phoenix(folder, phoenix)
    if jpegs:
        return _unlabelled(folder, jpegs)
    if samples := [name for name in map(named_as_sample, files) if name is not None]:
        return _samples(folder, samples)
    for endings, command, kind in _OTHERS:
        if of_kind := [path for path in files if path.suffix.lower() in endings]:
            return _of_files(kind, command, of_kind)
    return listed or (_without_table(folder, pictures, by_ending) if pictures else None)


def _with_table(folder: Path, tables: list[Path], pictures: int) -> Recognised | None:
    """Pictures and one table with at least one column that is of use."""
    if len(tables) != 1:
        return None
    try:
        table = read_table(tables[0], "a table with a row for each picture")
        columns = chosen_columns(table, {})
    except SarsplatError:
        return None  # whatever table that is
    if not columns:
        return None
    facts = {"pictures": str(pictures), "table": f"{table.path} ({counted(len(table.rows), 'row')})"}
    facts["columns"] = ", ".join(f"{meaning} = {name}" for meaning, name in columns.items())
    if lacking := [meaning for meaning in ("file", "azimuth") if meaning not in columns]:
        facts["missing"] = f"which column is the {' and which the '.join(lacking)}; it has {', '.join(table.columns)}"
    return Recognised("pictures with a table of their angles", facts, _folder_command(folder, table, columns, lacking))


def _folder_command(folder: Path, table: CsvTable, columns: Columns, lacking: list[str]) -> str:
    words = ["folder", str(folder)]
    if lacking:
        words += ["--columns", ",".join(f"{meaning}=NAME" for meaning in lacking)]
    if "grazing" not in columns and "incidence" not in columns:
        words += ["--grazing", "DEGREES"]
    if not any("spacing" in meaning for meaning in columns):
        words += ["--spacing", "METRES"]
    return _import(*words, out=f"{folder.resolve().name}-dataset")


def _samples(folder: Path, names: list[SampleName]) -> Recognised:
    by_kind = Counter((name.target, name.kind) for name in names)
    target, kind = max(by_kind, key=lambda its: (by_kind[its], its[1] == "real"))
    facts = {f"class {target}": f"{number} {kind}" for (target, kind), number in sorted(by_kind.items())}
    words = ("--class", target, "--kind", kind, "--train-views", _half(by_kind[target, kind]))
    command = _import("sample", str(folder), *words, out=f"sample-{target}")
    return Recognised("images of the SAMPLE set (complex, MATLAB files)", facts, command)


def _of_files(kind: str, command: str, files: list[Path]) -> Recognised:
    """Files of one ending, as a pattern for the shell."""
    first = files[0]
    pattern = f"{shlex.quote(str(first.parent))}/*{first.suffix}"
    out = shlex.quote(f"{first.parent.resolve().name}-dataset")
    return Recognised(
        f"{counted(len(files), f'{first.suffix} file')}, {kind}",
        {},
        f"sarsplat import {command} {pattern} --size METRES --out {out}",
    )


def _without_table(folder: Path, pictures: int, by_ending: Counter[str]) -> Recognised:
    endings = ", ".join(f"{by_ending[ending]} {ending}" for ending in PICTURE_ENDINGS if by_ending[ending])
    return Recognised(
        f"{counted(pictures, 'picture')} ({endings}) without a table of their angles",
        {"missing": f"a table (CSV) with a row for each, with the columns {', '.join(_NEEDED)} (docs/formats.md)"},
        _import(
            *("folder", str(folder), "--table", "TABLE.csv", "--spacing", "METRES"),
            out=f"{folder.resolve().name}-dataset",
        ),
    )


def _labelled(folder: Path, table: Path) -> Recognised | None:
    """The chips in a folder that a table describes; None if it describes none of them."""
    rows = [row for _, row in read_labels(table).rows]
    for root in dict.fromkeys((folder, table.parent)):
        inside = [row for row in rows if (root / row["path"]).absolute().is_relative_to(folder.absolute())]
        if present := [row for row in inside if (root / row["path"]).is_file()]:
            break
    else:
        return None
    missing = f" ({len(inside) - len(present)} more in the table are not there)" if len(present) < len(inside) else ""
    return _chips(
        "MSTAR chips as JPEGs, with a table of labels",
        {"chips": f"{len(present)}{missing}", "labels": str(table)},
        [(row["class"], parsed(row["desired_depression_deg"])) for row in present],
        [str(root), "--labels", str(table)],
    )


def _phoenix(folder: Path, files: list[Path]) -> Recognised:
    chips = [read_phoenix(path) for path in files[:_MOST_READ]]
    (rows, columns), spacing = chips[0].magnitude.shape, chips[0].spacing_m
    pixels = f"{rows} × {columns} pixels of {spacing[1]:g} m in range, {spacing[0]:g} m across"
    return _chips(
        "original MSTAR chips (Phoenix files)",
        {"chips": str(len(files)), "the first": pixels},
        [(chip.target_type, chip.desired_depression_deg) for chip in chips],
        [str(folder)],
    )


def _chips(kind: str, facts: dict[str, str], planned: Sequence[tuple[str, float]], where: list[str]) -> Recognised:
    """Classes and their planned depressions, degrees, NaN if unknown; and the command for the largest class."""
    by_class: dict[str, Counter[int | None]] = {name: Counter() for name in sorted({name for name, _ in planned})}
    for name, angle in planned:
        by_class[name][round(angle) if math.isfinite(angle) else None] += 1
    for name, depressions in by_class.items():
        facts[f"class {name}"] = ", ".join(
            f"{number} at {'an unknown depression' if angle is None else f'{angle}°'}"
            for angle, number in sorted(depressions.items(), key=lambda item: -(item[0] or 0))
        )
    name = max(by_class, key=lambda its: by_class[its].total())
    usable = {angle: number for angle, number in by_class[name].items() if angle is not None}
    if not usable:
        return Recognised(kind, facts)
    angle = _USUAL_DEPRESSION if _USUAL_DEPRESSION in usable else max(usable, key=lambda its: usable[its])
    words = [*where, "--class", name, "--train-views", _half(usable[angle])]
    if angle != _USUAL_DEPRESSION:
        words += ["--train-depression", str(angle)]
    plain = "".join(c for c in name.lower().split("_")[0] if c.isalnum()) or "chips"
    return Recognised(kind, facts, _import("mstar", *words, out=f"mstar-{plain}"))


def _unlabelled(folder: Path, count: int) -> Recognised:
    columns = f"with the columns {', '.join(LABEL_COLUMNS)} (docs/datasets-and-runs.md)"
    return Recognised(
        f"{counted(count, 'JPEG')} without a table of labels",
        {"missing": f"a table (CSV) that says what each shows, {columns}"},
        _import(
            *("mstar", str(folder), "--labels", "labels.csv", "--class", "NAME", "--train-views", str(_USUAL_VIEWS)),
            out="chips-dataset",
        ),
    )


def _half(images: int) -> str:
    """How many of them to train on, as an option takes it."""
    return str(min(_USUAL_VIEWS, max(1, images // 2)))


def _import(*words: str, out: str) -> str:
    return shlex.join(["sarsplat", "import", *words, "--out", out])
