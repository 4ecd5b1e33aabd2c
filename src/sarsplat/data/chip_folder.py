"""Whether a folder holds MSTAR chips, and which command makes a dataset of them."""

from __future__ import annotations

import itertools
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sarsplat.data.files import plain_os_errors
from sarsplat.data.mstar_chips import LABEL_COLUMNS, has_label_columns, read_labels
from sarsplat.data.phoenix import PhoenixChip, is_phoenix, read_phoenix
from sarsplat.errors import counted

_MOST_FILES = 20_000
"""More are not looked at: somebody gave a home folder."""

_MOST_READ = 500
"""Phoenix files whose headers are read; more are of the same classes."""

_USUAL_DEPRESSION, _USUAL_VIEWS = 17, 36
_JPEGS, _PICTURES = (".jpg", ".jpeg"), (".tif", ".tiff", ".png")


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
    facts: dict[str, str]
    command: str | None = None


def recognised(folder: Path) -> Recognised | None:
    """What chips are in a folder; None if there are none.

    Parameters
    ----------
    folder : Path
        At most its first 20,000 files are looked at, those of its subfolders included; a table of labels may also lie
        up to two folders above.

    Raises
    ------
    SarsplatError
        If it cannot be read, or a table of labels or a Phoenix file in it is damaged.
    """
    with plain_os_errors("read", folder):
        files = sorted(itertools.islice((path for path in folder.rglob("*") if path.is_file()), _MOST_FILES))
        above = [path for parent in folder.absolute().parents[:2] for path in sorted(parent.glob("*.csv"))]
    by_ending = Counter(path.suffix.lower() for path in files)
    if jpegs := sum(by_ending[ending] for ending in _JPEGS):
        for table in (*(path for path in files if path.suffix.lower() == ".csv"), *above):
            if has_label_columns(table) and (found := _labelled(folder, table)) is not None:
                return found
    phoenix = [path for path in files if path.suffix.lower() not in (*_JPEGS, *_PICTURES) and is_phoenix(path)]
    if phoenix:
        return _phoenix(folder, phoenix)
    if jpegs:
        return _unlabelled(folder, jpegs)
    return None


def _labelled(folder: Path, table: Path) -> Recognised | None:
    """The chips in a folder that a table describes; None if it describes none of them."""
    rows = [row for _, row in read_labels(table)]
    for root in dict.fromkeys((folder, table.parent)):
        inside = [row for row in rows if (root / row["path"]).absolute().is_relative_to(folder.absolute())]
        present = [row for row in inside if (root / row["path"]).is_file()]
        if present:
            break
    else:
        return None
    planned = [(row["class"], _whole(row["desired_depression_deg"])) for row in present]
    missing = f" ({len(inside) - len(present)} more in the table are not there)" if len(present) < len(inside) else ""
    facts, command = _choice(root, planned, table)
    return Recognised(
        "MSTAR chips as JPEGs, with a table of labels",
        {"chips": f"{len(present)}{missing}", "labels": str(table), **facts},
        command,
    )


def _phoenix(folder: Path, files: list[Path]) -> Recognised:
    chips = [read_phoenix(path) for path in files[:_MOST_READ]]
    planned = [(chip.target_type, round(chip.desired_depression_deg)) for chip in chips]
    facts, command = _choice(folder, planned, None)
    return Recognised(
        "original MSTAR chips (Phoenix files)", {"chips": str(len(files)), **_pixels(chips[0]), **facts}, command
    )


def _pixels(chip: PhoenixChip) -> dict[str, str]:
    rows, columns = chip.magnitude.shape
    spacing = f"{chip.spacing_m[1]:g} m in range, {chip.spacing_m[0]:g} m across"
    return {"the first": f"{rows} × {columns} pixels of {spacing}"}


def _choice(
    folder: Path, planned: Sequence[tuple[str, int | None]], labels: Path | None
) -> tuple[dict[str, str], str | None]:
    """Classes and depressions with their numbers, and the command for the largest class."""
    by_class = Counter(name for name, _ in planned)
    facts = {}
    for name in sorted(by_class):
        depressions = Counter(depression for its, depression in planned if its == name)
        told = ", ".join(
            f"{number} at {'an unknown depression' if angle is None else f'{angle}°'}"
            for angle, number in sorted(depressions.items(), key=lambda item: -(item[0] or 0))
        )
        facts[f"class {name}"] = told
    name = max(by_class, key=lambda its: by_class[its])
    known = Counter(angle for its, angle in planned if its == name and angle is not None)
    if not known:
        return facts, None
    angle = _USUAL_DEPRESSION if known[_USUAL_DEPRESSION] else max(known, key=lambda its: known[its])
    words = ["sarsplat", "import", "mstar", str(folder)]
    if labels is not None:
        words += ["--labels", str(labels)]
    words += ["--class", name, "--train-views", str(min(_USUAL_VIEWS, max(1, known[angle] // 2)))]
    if angle != _USUAL_DEPRESSION:
        words += ["--train-depression", str(angle)]
    plain = "".join(c for c in name.lower().split("_")[0] if c.isalnum()) or "chips"
    return facts, shlex.join([*words, "--out", f"mstar-{plain}"])


def _whole(text: str) -> int | None:
    try:
        return round(float(text))
    except (ValueError, OverflowError):
        return None


def _unlabelled(folder: Path, count: int) -> Recognised:
    words = ["sarsplat", "import", "mstar", str(folder), "--labels", "labels.csv", "--class", "NAME"]
    return Recognised(
        f"{counted(count, 'JPEG')} without a table of labels",
        {
            "missing": f"a table (CSV) that says what each shows, with the columns {', '.join(LABEL_COLUMNS)} "
            "(docs/datasets-and-runs.md)"
        },
        shlex.join([*words, "--train-views", "36", "--out", "chips-dataset"]),
    )
