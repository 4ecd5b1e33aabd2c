"""What a folder of images that is no dataset seems to hold, and which command makes a dataset of it."""

from __future__ import annotations

import itertools
import shlex
from collections import Counter
from pathlib import Path

from sarsplat.data.chip_folder import Recognised
from sarsplat.data.chip_folder import recognised as recognised_chips
from sarsplat.data.csv_table import CsvTable, read_table
from sarsplat.data.files import plain_os_errors
from sarsplat.errors import SarsplatError, counted
from sarsplat.importers.columns import Columns, chosen_columns
from sarsplat.importers.pictures import PICTURE_ENDINGS
from sarsplat.importers.sample import SampleName, named_as_sample

_MOST_FILES = 20_000
"""More are not looked at: somebody gave a home folder."""

_OTHERS = (
    ((".nitf", ".ntf"), "sicd", "which may be SICD"),
    ((".mat",), "phase-history", "which may be phase history"),
)
"""Endings, the command that reads such files, and what they may be."""

_NEEDED = ("file", "azimuth", "grazing", "spacing")
_USUAL_VIEWS = 36


def recognised(folder: Path) -> Recognised | None:
    """What is in a folder that is neither dataset nor run; None if there are no images in it.

    Parameters
    ----------
    folder : Path
        At most its first 20,000 files are looked at, those of its subfolders included.

    Raises
    ------
    SarsplatError
        If it cannot be read, or a table of labels or a Phoenix file in it is damaged.
    """
    with plain_os_errors("read", folder):
        files = sorted(itertools.islice((path for path in folder.rglob("*") if path.is_file()), _MOST_FILES))
    by_ending = Counter(path.suffix.lower() for path in files)
    pictures = sum(by_ending[ending] for ending in PICTURE_ENDINGS)
    listed = _with_table(folder, files, pictures) if pictures else None
    if listed is not None and "missing" not in listed.facts:
        return listed
    if (chips := recognised_chips(folder)) is not None:
        return chips
    if samples := [name for name in map(named_as_sample, files) if name is not None]:
        return _samples(folder, samples)
    for endings, command, kind in _OTHERS:
        if found := [path for path in files if path.suffix.lower() in endings]:
            return _of_files(kind, command, found)
    return listed or (_without_table(folder, pictures, by_ending) if pictures else None)


def _with_table(folder: Path, files: list[Path], pictures: int) -> Recognised | None:
    """Pictures and one table with at least one column that is of use."""
    tables = [path for path in files if path.suffix.lower() == ".csv"]
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
    words = ["sarsplat", "import", "folder", str(folder)]
    if lacking:
        words += ["--columns", ",".join(f"{meaning}=NAME" for meaning in lacking)]
    if "grazing" not in columns and "incidence" not in columns:
        words += ["--grazing", "DEGREES"]
    if not any("spacing" in meaning for meaning in columns):
        words += ["--spacing", "METRES"]
    return shlex.join([*words, "--out", f"{folder.resolve().name}-dataset"])


def _samples(folder: Path, names: list[SampleName]) -> Recognised:
    by_kind = Counter((name.target, name.kind) for name in names)
    target, kind = max(by_kind, key=lambda its: (by_kind[its], its[1] == "real"))
    facts = {f"class {target}": f"{number} {kind}" for (target, kind), number in sorted(by_kind.items())}
    words = ["sarsplat", "import", "sample", str(folder), "--class", target, "--kind", kind]
    words += ["--train-views", str(min(_USUAL_VIEWS, max(1, by_kind[target, kind] // 2)))]
    return Recognised(
        "images of the SAMPLE set (complex, MATLAB files)", facts, shlex.join([*words, "--out", f"sample-{target}"])
    )


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
    words = ["sarsplat", "import", "folder", str(folder), "--table", "TABLE.csv", "--spacing", "METRES"]
    return Recognised(
        f"{counted(pictures, 'picture')} ({endings}) without a table of their angles",
        {"missing": f"a table (CSV) with a row for each, with the columns {', '.join(_NEEDED)} (docs/formats.md)"},
        shlex.join([*words, "--out", f"{folder.resolve().name}-dataset"]),
    )
