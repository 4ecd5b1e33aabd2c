"""Standard splits of MSTAR: vehicles and depression angles that train a recogniser, and those that test it.

Numbers of chips are those of papers: S. Chen, H. Wang, F. Xu and Y.-Q. Jin, "Target
Classification Using the Deep Convolutional Networks for SAR Images", IEEE TGRS 54(8), 2016, tables I and IV to VI.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sarsplat.errors import SarsplatError, counted
from sarsplat.importers.files import warn_caller
from sarsplat.importers.mstar_chips import Chip, plain_name, same_class
from sarsplat.names import MstarSplit


@dataclass(frozen=True)
class Part:
    """Chips of one vehicle at some depression angles, degrees, and their published number."""

    target: str
    serial: str
    depressions: tuple[int, ...]
    count: int

    def holds(self, chip: Chip) -> bool:
        """Return whether a chip of the class belongs to it; one without a serial does."""
        named = plain_name(chip.serial).removeprefix("sn")  # as in SN_132
        return chip.depression in self.depressions and named in ("", plain_name(self.serial))

    def __str__(self) -> str:
        return f"{self.target} ({self.serial}) at {' and '.join(f'{angle}°' for angle in self.depressions)}"


@dataclass(frozen=True)
class Split:
    """A standard split: parts that train, and parts that test."""

    train: tuple[Part, ...]
    test: tuple[Part, ...]

    def names_of(self, target: str) -> tuple[str, ...]:
        """Return names of a class in tables, some of which name its vehicles: T72, T72-A64."""
        parts = [part for part in (*self.train, *self.test) if same_class(target, part.target)]
        return (target, *dict.fromkeys(f"{part.target}-{part.serial}" for part in parts))

    @property
    def classes(self) -> tuple[str, ...]:
        """Training classes, in their order."""
        return tuple(dict.fromkeys(part.target for part in self.train))


def _parts(depressions: tuple[int, ...], *parts: tuple[str, str, int]) -> tuple[Part, ...]:
    return tuple(Part(target, serial, depressions, count) for target, serial, count in parts)


_VEHICLES = (
    ("2S1", "b01", 299, 274),
    ("BMP2", "9563", 233, 195),
    ("BRDM2", "E-71", 298, 274),
    ("BTR60", "k10yt7532", 256, 195),
    ("BTR70", "c71", 233, 196),
    ("D7", "92v13015", 299, 274),
    ("T62", "A51", 299, 273),
    ("T72", "132", 232, 196),
    ("ZIL131", "E12", 299, 274),
    ("ZSU234", "d08", 299, 274),
)
"""Class, serial, and numbers of chips at 17° and at 15°."""

_TRAIN_17 = _parts((17,), *((target, serial, count) for target, serial, count, _ in _VEHICLES))
_TEST_15 = _parts((15,), *((target, serial, count) for target, serial, _, count in _VEHICLES))


def _trained(*targets: str) -> tuple[Part, ...]:
    return tuple(part for part in _TRAIN_17 if part.target in targets)


SPLITS: dict[MstarSplit, Split] = {
    "soc": Split(_TRAIN_17, _TEST_15),
    "eoc-depression": Split(
        _trained("2S1", "BRDM2", "T72", "ZSU234"),
        _parts((30,), ("2S1", "b01", 288), ("BRDM2", "E-71", 287), ("T72", "A64", 288), ("ZSU234", "d08", 288)),
    ),
    "eoc-configuration": Split(
        _trained("BMP2", "BRDM2", "BTR70", "T72"),
        _parts(
            (15, 17), ("T72", "s7", 419), ("T72", "A32", 572), ("T72", "A62", 573), ("T72", "A63", 573),
            ("T72", "A64", 573),
        ),
    ),
    "eoc-version": Split(
        _trained("BMP2", "BRDM2", "BTR70", "T72"),
        _parts(
            (15, 17), ("BMP2", "9566", 428), ("BMP2", "c21", 429), ("T72", "812", 426), ("T72", "A04", 573),
            ("T72", "A05", 573), ("T72", "A07", 573), ("T72", "A10", 567),
        ),
    ),
}  # fmt: skip


Counts = list[dict[str, int | str]]
"""For each part: its "set" ("train" or "test"), "part" in words, the chips "found" and "published", and how many of
those found have no azimuth ("without_azimuth")."""


def divide(chips: Sequence[Chip], split: MstarSplit, target: str) -> tuple[list[Chip], list[Chip], Counts]:
    """Return the chips of a class that train in a split and those that test, without copies; warn of those left out.

    Raises if the split does not train that class, or there is no chip to train on.
    """
    chosen = SPLITS[split]
    if not any(same_class(target, one) for one in chosen.classes):
        raise SarsplatError(f"the split {split} has no class {target}; it has {', '.join(chosen.classes)}")
    chips = _once(chips, target)
    found: dict[str, list[Chip]] = {"train": [], "test": []}
    counts: Counts = []
    for name, parts in (("train", chosen.train), ("test", chosen.test)):
        for part in parts:
            if not same_class(target, part.target):
                continue
            # chips without a serial belong to the only vehicle
            alone = sum(same_class(target, other.target) for other in parts) == 1
            held = [chip for chip in chips if part.holds(chip) and (alone or plain_name(chip.serial))]
            held = [chip for chip in held if not any(chip is one for one in found["train"])]
            found[name] += held
            numbers = {"found": len(held), "published": part.count}
            unplaced = sum(not chip.placed for chip in held)
            counts.append({"set": name, "part": str(part), **numbers, "without_azimuth": unplaced})
    if not found["train"]:
        present = sorted({f"{chip.serial or 'unnamed'} at {chip.depression}°" for chip in chips})
        lacking = " and ".join(str(part) for part in chosen.train if same_class(target, part.target))
        raise SarsplatError(
            f"there is no chip of {lacking}, but of {', '.join(present)}; get these chips, or leave the class out"
        )
    chosen_ones = {id(chip) for chip in (*found["train"], *found["test"])}
    if others := [chip for chip in chips if id(chip) not in chosen_ones]:
        kinds = Counter(f"{chip.serial or 'an unnamed vehicle'} at {chip.depression}°" for chip in others)
        said = ", ".join(f"{number} of {kind}" for kind, number in sorted(kinds.items()))
        warn_caller(f"{target}: left out {counted(len(others), 'chip')} that the split {split} has not ({said})")
    return found["train"], found["test"], counts


def _once(chips: Sequence[Chip], target: str) -> list[Chip]:
    """Remove copies: the same file name of one vehicle at the same angles in several folders."""
    first: dict[tuple[str, int, str, str], Chip] = {}
    for chip in chips:
        frame = Path(chip.name).stem.upper()  # HB03787 of hb03787.jpeg
        first.setdefault((plain_name(chip.serial), chip.depression, frame, f"{chip.target_az_deg:.4f}"), chip)
    if repeated := len(chips) - len(first):
        warn_caller(f"{target}: left out {counted(repeated, 'chip')} lying in several folders, where each counts once")
    return list(first.values())


def in_words(counts: Counts) -> Iterator[str]:
    """Yield a sentence for each part of a split: numbers of chips found and published."""
    for one in counts:
        found, published, unplaced = (int(one[key]) for key in ("found", "published", "without_azimuth"))
        said = f"{one['set']}: {one['part']}: {found} of {published} chips"
        if found != published:
            said += f", {published - found} are missing" if found < published else f", {found - published} too many"
        yield said + (f"; {unplaced} {'has' if unplaced == 1 else 'have'} no azimuth" if unplaced else "")
