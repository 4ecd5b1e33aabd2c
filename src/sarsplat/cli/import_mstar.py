"""`sarsplat import mstar`: measured chips in, a dataset out."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Angles, angles, refuse_existing
from sarsplat.cli.from_signature import Option, assumed_once, command_of
from sarsplat.cli.importers import Contents, Recognised, training_half, typed_import, unusable
from sarsplat.cli.info_run import PLAN
from sarsplat.errors import SarsplatError

_USUAL_DEPRESSION = 17
_REFUSED = 2
"""Exit code if a class could not be imported."""

_PLAN_TEXT = """# a reconstruction of each class; `sarsplat sweep sweep.toml --out RUNS` makes them
datasets = ["*"]
preset = "measured"
seeds = [0]
"""


@dataclass(frozen=True)
class _Planned:
    """What is known of a chip before it is read."""

    target: str
    serial: str
    depression_deg: float
    """NaN if unknown."""
    placed: bool
    """Whether its azimuth is known."""


_MOST_READ = 500
"""Number of Phoenix files whose headers are read; the others are assumed to be of the same classes."""


def _whole(words: tuple[str, ...], name: str) -> list[int]:
    """Depressions are named by whole degrees."""
    whole = angles(words, name)
    for angle in whole:
        if not angle.is_integer():  # nor NaN or infinite
            raise SarsplatError(f"--{name} {angle:g} is not a whole number of degrees; chips are named by these")
    return [round(angle) for angle in whole]


def _all_or_number(text: str, name: str) -> int | str:
    if text.isdecimal():
        return int(text)
    if text != "all":
        raise SarsplatError(f"--{name} {text!r} is no number of chips; give one, or all")
    return text


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
    train_views=Option(Annotated[str, tyro.conf.arg(metavar="N|all")], _all_or_number),
    train_depression=Option(Angles, _whole, default=(str(_USUAL_DEPRESSION),)),
    test=Option(help="Leave out all other chips: nothing to score with, but the import takes less time."),
)


@wraps(_one)
def command(**given: Any) -> int:
    classes, split = given["target_class"], given["split"]
    if split is not None:
        _refuse_with_split(given)
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
    """Import a dataset of each class; exit codes, and the folders that were made."""
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


def _refuse_with_split(given: dict[str, Any]) -> None:
    """A split says itself which vehicles at which depression angles train and test."""
    if (
        given["serial"] is not None or given["train_depression"] != (str(_USUAL_DEPRESSION),) or given["test"]
    ):  # which is typed as --no-test
        raise SarsplatError(
            f"--split {given['split']} says itself which vehicles at which depression angles there are; leave out "
            "--serial, --train-depression and --no-test"
        )


def _all_of_split(given: dict[str, Any]) -> int:
    """Import the classes of a split, say how many chips there are and should be, and put a plan of a sweep beside."""
    from sarsplat.data.dataset_folder import read_header
    from sarsplat.data.files import write_bytes
    from sarsplat.importers.mstar_chips import same_class
    from sarsplat.importers.mstar_splits import SPLITS, in_words

    split = SPLITS[given["split"]]
    classes = given["target_class"] or split.classes
    codes, made = _each(given, classes)
    if not made:
        return max(codes)
    totals = Counter[str]()
    headers = [read_header(out) for out in made]
    for header in headers:
        parts = header.source["split"]["parts"]
        for said in in_words(parts):
            console.say(said)
        for part in parts:
            totals[part["set"]] += part["found"]
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
    """JPEGs that a table of labels describes, which may lie up to two folders above; or Phoenix files."""
    from sarsplat.importers.mstar_chips import has_label_columns
    from sarsplat.importers.phoenix import is_phoenix
    from sarsplat.importers.pictures import PICTURE_ENDINGS

    if contents.path.is_dir() and contents.ending_in(".jpg", ".jpeg"):
        above = (path for parent in contents.path.absolute().parents[:2] for path in sorted(parent.glob("*.csv")))
        for table in (*contents.ending_in(".csv"), *above):
            if has_label_columns(table) and (labelled := _labelled(contents.path, table)) is not None:
                return labelled
    phoenix = [path for path in contents.files if path.suffix.lower() not in PICTURE_ENDINGS and is_phoenix(path)]
    if contents.path.is_file() and phoenix:
        return _one_phoenix(contents.path)
    return _phoenix(contents.path, phoenix) if phoenix else None


def _labelled(folder: Path, table: Path) -> Recognised | None:
    """The chips in a folder that a table describes; None if it describes none of them."""
    from sarsplat.data.csv_table import parsed
    from sarsplat.importers.mstar_chips import read_labels

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
        [
            _Planned(row["class"], row["serial"], parsed(row["desired_depression_deg"]), bool(row["target_az_deg"]))
            for row in present
        ],
        [str(root), "--labels", str(table)],
    )


def _phoenix(folder: Path, files: list[Path]) -> Recognised:
    from sarsplat.importers import read_phoenix

    chips, planned, refused = [], [], list[str]()
    for path in files[:_MOST_READ]:
        try:
            chip = read_phoenix(path)
            planned.append(_Planned(chip.target_type, chip.serial, chip.desired_depression_deg, placed=True))
            chips.append(chip)
        except SarsplatError as error:
            refused.append(str(error))
    if not chips:
        raise SarsplatError(refused[0])
    (rows, columns), spacing = chips[0].magnitude.shape, chips[0].spacing_m
    pixels = f"{rows} × {columns} pixels of {spacing[1]:g} m in range, {spacing[0]:g} m across"
    return _chips(
        "original MSTAR chips (Phoenix files)",
        {"chips": str(len(files) - len(refused)), "the first": pixels, **unusable(refused)},
        planned,
        [str(folder)],
    )


def _one_phoenix(path: Path) -> Recognised:
    from sarsplat.importers import read_phoenix

    chip = read_phoenix(path)
    rows = {
        "vehicle": f"{chip.target_type}, serial {chip.serial}",
        "depression": f"{chip.measured_depression_deg:g}° (planned {chip.desired_depression_deg:g}°)",
        "TargetAz": f"{chip.target_az_deg:g}°; azimuth here {-chip.target_az_deg % 360:g}°",
        "pixels": f"{chip.magnitude.shape[0]} × {chip.magnitude.shape[1]}, linear magnitude and phase",
        "spacing": f"{chip.spacing_m[0]:g} m in cross-range, {chip.spacing_m[1]:g} m in slant range",
        "resolution": f"{chip.resolution_m[0]:g} m, {chip.resolution_m[1]:g} m (3 dB)",
        "radar at the": chip.radar_position,
    }
    return Recognised("a Phoenix chip (MSTAR)", rows)


def _chips(kind: str, facts: dict[str, str], planned: Sequence[_Planned], where: list[str]) -> Recognised:
    """How many there are of each class, and the commands for the largest class and for standard splits."""
    by_class: dict[str, Counter[int | None]] = {name: Counter() for name in sorted({one.target for one in planned})}
    usable: dict[str, Counter[int]] = {name: Counter() for name in by_class}
    for one in planned:
        angle = round(one.depression_deg) if math.isfinite(one.depression_deg) else None
        by_class[one.target][angle] += 1
        if angle is not None and one.placed:
            usable[one.target][angle] += 1
    for name, depressions in by_class.items():
        said = ", ".join(
            f"{number} at {'an unknown depression' if angle is None else f'{angle}°'}"
            for angle, number in sorted(depressions.items(), key=lambda item: -(item[0] or 0))
        )
        unplaced = sum(not one.placed for one in planned if one.target == name)
        facts[f"class {name}"] = said + (f" ({unplaced} without azimuth)" if unplaced else "")
    name = max(usable, key=lambda its: usable[its].total())
    if not usable[name]:
        return Recognised(kind, facts)
    angle = _USUAL_DEPRESSION if _USUAL_DEPRESSION in usable[name] else max(usable[name], key=usable[name].__getitem__)
    words = [*where, "--class", name, "--train-views", training_half(usable[name][angle])]
    if angle != _USUAL_DEPRESSION:
        words += ["--train-depression", str(angle)]
    plain = "".join(c for c in name.lower().split("_")[0] if c.isalnum()) or "chips"
    command = typed_import("mstar", *words, out=f"mstar-{plain}")
    return Recognised(kind, facts, command, also=_split_commands(planned, where))


def _split_commands(planned: Sequence[_Planned], where: list[str]) -> dict[str, str]:
    """The commands for standard splits that chips are of."""
    from sarsplat.importers.mstar_splits import SPLITS, splits_in

    known = [
        (one.target, one.serial, round(one.depression_deg)) for one in planned if math.isfinite(one.depression_deg)
    ]
    commands = {}
    for split, number in splits_in(known).items():
        classes = f"{split}, {number} of its {len(SPLITS[split].classes)} classes are here"
        words = [*where, "--split", split, "--train-views", "all"]
        commands[f"or a dataset of each class of a standard split ({classes})"] = typed_import(
            "mstar", *words, out=f"mstar-{split}"
        )
    return commands
