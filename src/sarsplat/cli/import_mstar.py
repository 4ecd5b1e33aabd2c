"""`sarsplat import mstar`: measured chips in, a dataset out, or those of a standard split."""

import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Angles, angles, exclude, refuse_existing
from sarsplat.cli.from_signature import Option, assumed_once, command_of
from sarsplat.cli.importers import Contents, Recognised
from sarsplat.errors import SarsplatError, counted

PLAN = "sweep.toml"
"""File name of the plan of a sweep beside the datasets of a split."""

_USUAL_DEPRESSIONS = ("17",)
_REFUSED = 2  # exit code if a class could not be imported

_PLAN_TEXT = """# a reconstruction of each class; `sarsplat sweep sweep.toml --out RUNS` makes them
datasets = ["*"]
preset = "measured"
seeds = [0]
"""


_MOST_READ = 500  # number of Phoenix files whose headers are read; the others are assumed to be of the same classes


def _whole(words: tuple[str, ...], name: str) -> list[int]:
    """Parse whole degrees, which name depressions."""
    whole = angles(words, name)
    for angle in whole:
        if not angle.is_integer():  # nor NaN or infinite
            raise SarsplatError(f"--{name} {angle:g} is not a whole number of degrees; chips are named by these")
    return [round(angle) for angle in whole]


_one = command_of(
    __name__,
    "sarsplat.importers.mstar:import_mstar",
    reading="chips from ",
    target_class=Option(
        Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")],
        name="class",
        default=(),
        help="Vehicle class, e.g. T72. Several, or all that there are (all), become a dataset each in the folder OUT; "
        "with --split, those that it trains, unless some are named. If one cannot be imported, the others are all the "
        "same, each whole or not at all, and the exit code is 2.",
    ),
    train_views=Option(Annotated[int | Literal["all"], tyro.conf.arg(metavar="N|all")]),
    train_depression=Option(Angles, _whole, default=_USUAL_DEPRESSIONS),
    test=Option(help="Leave out all other chips: nothing to score with, but the import takes less time."),
)


@wraps(_one)
def command(**given: Any) -> int:
    classes, split = given["target_class"], given["split"]
    if split is not None:
        others = {"serial": given["serial"], "train-depression": given["train_depression"] != _USUAL_DEPRESSIONS}
        exclude("split", "determines vehicles and depression angles", {**others, "no-test": given["test"]})
        return _all_of_split(given)
    if not classes:
        raise SarsplatError("--class is missing; give a class of vehicles, such as T72, or a --split, such as soc")
    if classes == ("all",):
        from sarsplat.importers.mstar_chips import classes_in

        classes = classes_in(given["chips"], given["labels"])
    elif len(classes) == 1:
        return _one(**given | {"target_class": classes[0]})
    return max(_each(given, classes)[0])


def _each(given: dict[str, Any], classes: Sequence[str]) -> tuple[list[int], list[Path]]:
    """Import a dataset of each class; return exit codes, and the folders written."""
    from sarsplat.importers.mstar_chips import same_class
    from sarsplat.progress import progress

    for k, name in enumerate(classes):
        if twice := next((other for other in classes[:k] if other != name and same_class(other, name)), None):
            raise SarsplatError(f"--class {twice} and {name} are the same class; leave one out")
    outs = {name: given["out"] / re.sub(r"[^\w+-]", "_", name) for name in dict.fromkeys(classes)}
    for out in outs.values():
        refuse_existing(out, given["overwrite"], marker="dataset.json")
    codes, made = [], []
    with assumed_once(), progress(f"import {given['chips']}", len(outs)) as shown:
        for done, (name, out) in enumerate(outs.items()):
            shown.update(done, name)
            try:
                codes.append(_one(**given | {"target_class": name, "out": out}))
                made.append(out)
            except SarsplatError as error:  # as where a class has too few chips: the others are imported
                old = f"; {out} stays as it was" if out.exists() else ""
                console.complain(f"{name}: {error}{old}")
                codes.append(_REFUSED)
        shown.update(len(outs))
    if not made:
        return codes, made
    console.finish(
        f"{given['out']}: {len(made)} of {len(codes)} classes, a dataset each",
        f"sarsplat info {shlex.quote(str(given['out']))}",
    )
    return codes, made


def _all_of_split(given: dict[str, Any]) -> int:
    """Import the classes of a split, print numbers of chips found and published, and write a plan of a sweep."""
    from sarsplat.data.dataset_folder import read_header
    from sarsplat.data.files import write_bytes
    from sarsplat.importers.mstar_chips import same_class
    from sarsplat.importers.mstar_splits import SPLITS, in_words

    split = SPLITS[given["split"]]
    classes = given["target_class"] or split.classes
    codes, made = _each(given, classes)
    if not made:
        return max(codes)
    headers = [read_header(out) for out in made]
    sources = [source for header in headers if (source := SplitSource.of(header.target, header.source)) is not None]
    for source in sources:
        for said in in_words(source.parts):
            console.say(said)
    totals = _chips(sources, "found")
    for name, whole in (("train", split.train), ("test", split.test)):
        found = totals[name]
        published = sum(part.count for part in whole if same_class(tuple(classes), part.target))
        (console.say if found == published else console.warn)(
            f"{name}: {found:,} of {published:,} chips, {len(made)} of {len(classes)} classes"
        )
    if missing := [name for name in classes if not any(same_class(name, header.target) for header in headers)]:
        console.warn(
            f"without {', '.join(missing)} (see above); the datasets of the others are whole. Once the chips are "
            f"there, the same command with --class {shlex.join(missing)} adds what is missing"
        )
    plan = given["out"] / PLAN
    if not plan.exists():  # it may have been changed
        write_bytes(plan, _PLAN_TEXT.encode())
        console.say(f"wrote {plan}, a plan by which a sweep reconstructs each class")
    runs = shlex.quote(f"{given['out']}-runs")
    console.say(f"next: sarsplat sweep {shlex.quote(str(plan))} --out {runs}")
    return max(codes)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise JPEGs that a table of labels describes, or Phoenix files."""
    from sarsplat.data.csv_table import column_names, parsed
    from sarsplat.importers import read_phoenix
    from sarsplat.importers.mstar_chips import LABEL_COLUMNS, read_labels
    from sarsplat.importers.phoenix import is_phoenix
    from sarsplat.importers.pictures import PICTURE_ENDINGS

    if contents.ending_in(".jpg", ".jpeg"):
        above = (path for parent in contents.path.absolute().parents[:2] for path in sorted(parent.glob("*.csv")))
        for table in (*contents.ending_in(".csv"), *above):
            if set(LABEL_COLUMNS) <= set(column_names(table)):
                rows = [row for _, row in read_labels(table).rows]
                labelled = [(row["class"], parsed(row["desired_depression_deg"])) for row in rows]
                return Recognised("MSTAR chips as JPEGs", {"labels": str(table), **_by_class(labelled)})
    files = [path for path in contents.files if path.suffix.lower() not in PICTURE_ENDINGS and is_phoenix(path)]
    if not files:
        return None
    chips = [read_phoenix(path) for path in files[:_MOST_READ]]
    (rows, columns), spacing = chips[0].magnitude.shape, chips[0].spacing_m
    pixels = f"{rows} × {columns} pixels of {spacing[1]:g} m in range, {spacing[0]:g} m across"
    classes = _by_class([(chip.target_type, chip.desired_depression_deg) for chip in chips])
    return Recognised(
        "original MSTAR chips (Phoenix files)", {"chips": str(len(files)), "the first": pixels, **classes}
    )


def _by_class(chips: Sequence[tuple[str, float]]) -> dict[str, str]:
    """Numbers of chips (class, depression angle) of each class by whole degrees."""
    facts = {}
    for name in sorted({target for target, _ in chips}):
        angles = Counter(
            f"{angle:.0f}°" if math.isfinite(angle) else "an unknown depression"
            for target, angle in chips
            if target == name
        )
        facts[f"class {name}"] = ", ".join(f"{number} at {angle}" for angle, number in angles.items())
    return facts


_FOR = "for `sarsplat locate` and `sarsplat chips --measured`"
_NUMBERS = ("found", "published", "without_azimuth")


@dataclass(frozen=True)
class SplitSource:
    """Standard split of MSTAR in a dataset's source."""

    name: str
    target: str
    parts: list[dict[str, int | str]]
    """See `mstar_splits.Counts`."""
    unplaced: int
    """Number of chips without azimuth."""

    @classmethod
    def of(cls, target: str, source: Mapping[str, Any]) -> "SplitSource | None":
        """Return the split, None without or for an unknown one."""
        from sarsplat.importers.mstar_splits import SPLITS

        try:
            name, parts = source["split"]["name"], [{**part} for part in source["split"]["parts"]]
            if name not in SPLITS or not all(isinstance(part[key], int) for part in parts for key in _NUMBERS):
                return None
            if not all(part["set"] in ("train", "test") and isinstance(part["part"], str) for part in parts):
                return None
            return cls(name, target, parts, len(source.get("unplaced", ())))
        except (KeyError, TypeError, ValueError):  # a header changed by hand
            return None

    def rows(self) -> dict[str, str]:
        """Names and values for a table."""
        from sarsplat.importers.mstar_splits import in_words

        rows = {"split": "\n".join([f"{self.name}, of MSTAR", *in_words(self.parts)])}
        if self.unplaced:
            rows["unplaced"] = f"{counted(self.unplaced, 'chip')} without azimuth, in the folder unplaced; {_FOR}"
        return rows

    def incomplete(self) -> str:
        """Return the numbers of chips found and published; "" if they are equal."""
        found, published = (_chips([self], key) for key in ("found", "published"))
        if found == published:
            return ""
        return f"{self.target}: " + ", ".join(f"{kind} {found[kind]:,} of {published[kind]:,}" for kind in found)


def _chips(sources: Sequence[SplitSource], key: str) -> Counter[str]:
    """Return sums over the parts of splits, "found" or "published", by set."""
    sums = Counter[str]()
    for part in (part for source in sources for part in source.parts):
        sums[str(part["set"])] += int(part[key])
    return sums


def rows_of_all(sources: Sequence[SplitSource]) -> dict[str, str]:
    """Return rows about the classes and chips of splits that several datasets, one a class, have and lack."""
    from sarsplat.importers.mstar_chips import same_class
    from sarsplat.importers.mstar_splits import SPLITS

    rows = {}
    for name in dict.fromkeys(one.name for one in sources):
        own, split = [one for one in sources if one.name == name], SPLITS[name]  # type: ignore[index]
        missing = [one for one in split.classes if not any(same_class(other.target, one) for other in own)]
        lacking = f"; {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing" if missing else ""
        rows[f"split {name}"] = f"{len(split.classes) - len(missing)} of {len(split.classes)} classes{lacking}"
        found = _chips(own, "found")
        for kind, parts in (("train", split.train), ("test", split.test)):
            published = sum(part.count for part in parts)
            rows[f"{kind} {name}"] = f"{found[kind]:,} of {published:,} chips"
        if short := [counts for one in own if (counts := one.incomplete())]:
            rows[f"not whole, {name}"] = "\n".join(short)
    if unplaced := sum(one.unplaced for one in sources):
        rows["unplaced"] = f"{counted(unplaced, 'chip')} without azimuth, in the datasets' folders unplaced; {_FOR}"
    return rows
