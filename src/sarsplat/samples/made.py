"""Record of how a set of chips was made (`chips.json`), with which a stopped one can be continued."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Annotated, Self

import msgspec

from sarsplat.data.files import encode_json, open_file, read_versioned_json
from sarsplat.errors import SarsplatError, shown
from sarsplat.learning.sampler import LEARNED, UNIFORM
from sarsplat.names import ChipFormat, ChipQuantity, ChipScale, Side, Speckle
from sarsplat.samples.chip_set import Chips
from sarsplat.version import program_version

MARKER = "chips.json"
"""The file that marks a folder of chips."""

SCHEMA, SCHEMA_VERSION = "sarsplat-chips", 4

_CALLED = {
    "runs": "runs",
    "ground_digest": "the picture of the ground",
    "azimuths_deg": "azimuths",
    "grazing_deg": "grazing angles",
}
"""Fields with values that nobody would compare, in words."""


class MadeRun(msgspec.Struct, forbid_unknown_fields=True):
    """Where a run was, what it shows, and what it had learned."""

    path: str | None
    target: str
    checkpoint: str


class Made(msgspec.Struct, forbid_unknown_fields=True):
    """Content of `chips.json`: everything that the files of a set depend on."""

    schema: str
    schema_version: int
    program: str
    """Version of this program."""
    runs: Annotated[list[MadeRun], msgspec.Meta(min_length=1)]
    count: Annotated[int, msgspec.Meta(ge=1)]
    seed: int
    azimuths_deg: list[float]
    grazing_deg: Annotated[list[tuple[float, float]], msgspec.Meta(min_length=1)]
    ground: str
    ground_digest: str | None
    """Of the picture's file; None of a word."""
    speckle: Speckle
    scatterers: float | None
    """None of any number."""
    quantity: ChipQuantity
    scale: ChipScale
    format: ChipFormat
    jpeg_quality: int
    crop: int | None
    near: Side
    shard: Annotated[int, msgspec.Meta(ge=1)] | None
    pixels: tuple[int, int]
    """Rows and columns of each file."""
    spacing_m: tuple[float, float]
    """Azimuth, range."""

    @classmethod
    def of(cls, chips: Chips, shard: int | None) -> Self:
        """The record of a set, written in shards of so many chips or chip by chip."""
        how, grid = chips.encoding, chips.runs[0].grid
        return cls(
            schema=SCHEMA,
            schema_version=SCHEMA_VERSION,
            program=program_version(),
            runs=[
                MadeRun(None if run.path is None else str(run.path), target, run.snapshot.digest())
                for run, target in zip(chips.runs, chips.targets, strict=True)
            ],
            count=chips.count,
            seed=chips.seed,
            azimuths_deg=list(chips.azimuths_deg),
            grazing_deg=list(chips.grazing_deg),
            ground=str(chips.ground),
            ground_digest=None if str(chips.ground) in (LEARNED, UNIFORM) else _digest(Path(chips.ground)),
            speckle=chips.speckle,
            scatterers=chips.scatterers if math.isfinite(chips.scatterers) else None,
            quantity=how.quantity,
            scale=how.scale,
            format=how.format,
            jpeg_quality=how.jpeg_quality,
            crop=how.crop,
            near=how.near,
            shard=shard,
            pixels=how.size(grid),
            spacing_m=grid.spacing_m,
        )

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the record of a folder; a SarsplatError if it is not one of ours."""
        remedy = "give a folder that `sarsplat chips` has written"
        return read_versioned_json(folder / MARKER, cls, schema=SCHEMA, version=SCHEMA_VERSION, remedy=remedy)

    def unlike(self, folder: Path) -> str:
        """What is different about the set in another folder, for a sentence: names, and values that are short."""
        try:
            other = Made.read(folder)
        except SarsplatError:
            return "has a header that this version of the program does not read"
        words = []
        for name, mine in msgspec.structs.asdict(self).items():
            if (theirs := getattr(other, name)) != mine:
                words.append(_CALLED.get(name) or f"{name} ({shown(theirs)}, not {shown(mine)})")
        return f"differs in {', '.join(words)}"

    def encoded(self, path: Path) -> bytes:
        """The record as JSON; `path` is what an error names."""
        return encode_json(self, path)


def _digest(path: Path) -> str:
    with open_file(path) as file:
        return hashlib.sha256(file.read()).hexdigest()
