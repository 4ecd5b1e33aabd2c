"""Sets of chips as files: folders of classes, or shards, with a table and their settings (`chips.json`).

An unfinished set with the same settings is resumed.
"""

import ctypes
import io
import json
import math
import signal
import sys
import tarfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Generic, Self, TypeVar

import msgspec
import numpy as np
import torch
from jaxtyping import Float64
from torch.utils.data import DataLoader, Dataset

from sarsplat.arguments import checks_arguments
from sarsplat.data import new_folder, write_bytes
from sarsplat.data.files import encode_json, read_versioned_json, sha256_of
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import program_version
from sarsplat.learning.sampler import LEARNED, UNIFORM
from sarsplat.names import ChipFormat, ChipQuantity, ChipScale, Side, Speckle
from sarsplat.progress import progress
from sarsplat.samples.chip_set import Chips
from sarsplat.samples.encoding import ENDINGS, IMPORT_COLUMNS, LABELS, encoded_table, unusual_columns, unusual_values

_COLUMNS = ("path", "class", "azimuth_deg", "grazing_deg", "seed", "run", *IMPORT_COLUMNS, "near_side")

_MIN_ITEMS = 100  # minimum number of items for which processes are started
_BATCH = 16  # items sent to a process at a time
_PR_SET_PDEATHSIG = 1  # of Linux's prctl

T = TypeVar("T")

_SCALES = "scales.npy"  # temporary file of the scales of finished chips, which the table takes in the end

MARKER = "chips.json"
"""File that marks a folder of chips."""

SCHEMA, SCHEMA_VERSION = "sarsplat-chips", 5
_CALLED = {
    "runs": "runs",
    "ground_digest": "the picture of the ground",
    "azimuths_deg": "azimuths",
    "grazing_deg": "grazing angles",
}
"""Texts of fields whose values are too long to print."""


@checks_arguments
def write_chips(
    chips: Chips, out: str | Path, *, shard: int | None = None, overwrite: bool = False, quiet: bool = True
) -> None:
    """Write a set of chips as a folder; an interrupted call is resumed by the same call.

    Parameters
    ----------
    chips : Chips
        The set.
    out : str or Path
        New folder: CLASS/NUMBER.jpg (.png, .npy); `labels.csv`, which also has the columns that `import mstar` and
        `import folder` need; and the settings, `chips.json`.
    shard : int, optional
        Write WebDataset shards instead, tar files of `shard` chips: NUMBER.jpg (.png, .npy), .cls (class number) and
        .json (row of the table).
    overwrite : bool
        Replace an existing set, or an unfinished one of another kind.
    quiet : bool
        Show no progress.

    Raises
    ------
    SarsplatError
        If the folder exists, is in use, cannot be written or holds an unfinished set of another kind, or `shard` is
        not positive.
    """
    if shard is not None and shard < 1:
        raise SarsplatError(f"shard is {shard}; give at least one chip for each file")
    out = Path(out)
    header = Made.of(chips, None if shard is None else int(shard))
    made = encode_json(header, out / MARKER)

    def goes_on(folder: Path) -> bool:
        started = (folder / MARKER).read_bytes() if (folder / MARKER).is_file() else b""
        if started not in (b"", made) and not overwrite:
            raise SarsplatError(
                f"{out} is an unfinished set that {header.unlike(folder)}; go on with it by the command that began it, "
                "choose another name, or pass overwrite=True to begin anew"
            )
        return started == made

    with new_folder(out, overwrite, marker=MARKER, goes_on=goes_on) as folder:
        write_bytes(folder / MARKER, made)
        total, scales = len(chips), _scales(folder / _SCALES, len(chips))
        with progress(f"chips to {out}", total, quiet) as reporter:
            for done in _files(chips, folder, scales) if shard is None else _shards(chips, folder, scales, shard):
                reporter.update(done)
        write_bytes(folder / LABELS, _table(chips, shard, scales))
        del scales  # some systems remove no file that is open
        (folder / _SCALES).unlink()


def _scales(path: Path, count: int) -> Float64[np.ndarray, " n"]:
    """Open the scales of chips, 0 for unfinished ones, as a memory map that processes share."""
    with suppress(OSError, ValueError):  # missing or damaged
        old: Float64[np.ndarray, " n"] = np.lib.format.open_memmap(path, "r+")
        if old.shape == (count,):
            return old
    new: Float64[np.ndarray, " n"] = np.lib.format.open_memmap(path, "w+", np.float64, (count,))
    return new


def _files(chips: Chips, folder: Path, scales: Float64[np.ndarray, " n"]) -> Iterator[int]:
    """Write missing chips; yield the number of finished chips after each."""
    for target in chips.classes:
        (folder / target).mkdir(exist_ok=True)

    def write(index: int) -> None:
        content, scales[index] = _encoded(chips, index)
        write_bytes(folder / _file(chips, index), content)

    missing = [n for n in range(len(chips)) if not (scales[n] and _is_written(folder / _file(chips, n)))]
    for done, _ in enumerate(parallel_map(write, missing), len(chips) - len(missing) + 1):
        yield done


def _shards(chips: Chips, folder: Path, scales: Float64[np.ndarray, " n"], size: int) -> Iterator[int]:
    """Write missing shards; yield the number of finished chips after each."""
    shards = [range(first, min(first + size, len(chips))) for first in range(0, len(chips), size)]
    missing = {n: ids for n, ids in enumerate(shards) if not (scales[ids].all() and _is_written(folder / _shard(n)))}
    files = parallel_map(lambda index: _encoded(chips, index), list(chain(*missing.values())))
    done = len(chips) - sum(map(len, missing.values()))
    for number, indices in missing.items():
        encoded = dict(zip(indices, files, strict=False))
        scales[indices] = [scale for _, scale in encoded.values()]
        write_bytes(folder / _shard(number), _packed(chips, number, encoded))
        yield (done := done + len(indices))


def _encoded(chips: Chips, index: int) -> tuple[bytes, float]:
    """Content of a chip's file, and its `numbers_per_unit`."""
    sample = chips.sample(index)
    encoding = chips.encoding
    return encoding.encoded(sample, chips.brightest), encoding.numbers_per_unit(sample, chips.brightest)


def _packed(chips: Chips, number: int, encoded: dict[int, tuple[bytes, float]]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for index, (content, scale) in encoded.items():
            row = _row(chips, index, _shard(number), scale)
            members = {
                ENDINGS[chips.encoding.format]: content,
                ".cls": str(chips.classes.index(row["class"])).encode(),
                ".json": json.dumps(row).encode(),
            }
            for ending, data in members.items():
                entry = tarfile.TarInfo(f"{_key(index)}{ending}")
                entry.size = len(data)
                tar.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def _key(index: int) -> str:
    return f"{index:08d}"


def _file(chips: Chips, index: int) -> str:
    return f"{chips.targets[index % len(chips.runs)]}/{_key(index)}{ENDINGS[chips.encoding.format]}"


def _shard(number: int) -> str:
    return f"chips-{number:06d}.tar"


def _table(chips: Chips, shard: int | None, scales: Float64[np.ndarray, " n"]) -> bytes:
    files = (_file(chips, index) if shard is None else _shard(index // shard) for index in range(len(chips)))
    rows = (_row(chips, index, file, float(scales[index])) for index, file in enumerate(files))
    return encoded_table(rows, _columns(chips))


def _columns(chips: Chips) -> tuple[str, ...]:
    unusual = unusual_columns([chips.label(place).view for place in range(len(chips.runs))])
    return (*_COLUMNS, chips.encoding.scale_column, *unusual)


def _row(chips: Chips, index: int, path: str, scale: float) -> dict[str, Any]:
    label = chips.label(index)
    view, grid = label.view, chips.runs[label.run].grid
    angles = (round(view.grazing_deg), view.grazing_deg, round(-view.azimuth_deg % 360, 6))  # as `import mstar` reads
    lengths = (*grid.spacing_m, *grid.resolution_m)
    written = (chips.encoding.near, scale)
    named = (path, label.target, view.azimuth_deg, view.grazing_deg, label.seed, str(chips.runs[label.run].path))
    every = (*named, chips.serials[label.run], *angles, *lengths, *written, *unusual_values(view))
    return dict(zip(_columns(chips), every, strict=False))  # usual views have no columns of unusual values


def _is_written(path: Path) -> bool:
    """True if a file exists and is not empty, as after a power cut."""
    return path.is_file() and path.stat().st_size > 0


def parallel_map(work: Callable[[int], T], indices: Sequence[int]) -> Iterator[T]:
    """Map `work` over indices, in order, with as many processes as PyTorch has threads.

    Processes are forked, so only on Linux; elsewhere, and for few indices, this process does the work.
    """
    processes = torch.get_num_threads()
    if processes == 1 or len(indices) < _MIN_ITEMS or sys.platform != "linux":
        yield from map(work, indices)
        return
    loader = DataLoader(
        _Work(work),
        batch_size=None,
        sampler=[indices[first : first + _BATCH] for first in range(0, len(indices), _BATCH)],
        num_workers=processes,
        multiprocessing_context="fork",
        worker_init_fn=_end_with_parent,
    )
    for result in chain.from_iterable(loader):
        if isinstance(result, Exception):
            raise result
        yield result


def _end_with_parent(_: int) -> None:
    """Make a worker ignore SIGTERM to the group, and end when its parent ends, however that ends."""
    if sys.platform == "linux":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # also while it waits for the parent to read


class _Work(Dataset[list[T | Exception]], Generic[T]):
    """Batches of results; exceptions are results, since the loader would add a worker's traceback to their text."""

    def __init__(self, work: Callable[[int], T]) -> None:
        self._work = work

    def __getitem__(self, indices: Sequence[int]) -> list[T | Exception]:
        results: list[T | Exception] = []
        try:
            results += map(self._work, indices)
        except Exception as error:
            results.append(error)
        return results


class MadeRun(msgspec.Struct, forbid_unknown_fields=True):
    """Folder, class, vehicle and state of a run when a set was made."""

    path: str | None
    target: str
    serial: str
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
    """Digest of the picture's file; None without picture."""
    speckle: Speckle
    scatterers: float | None
    """Number of scatterers per cell (`Run.sample`); None if infinite."""
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
    """Spacing in azimuth and range, m."""

    @classmethod
    def of(cls, chips: Chips, shard: int | None) -> Self:
        """Settings of a set, written in shards of `shard` chips, or chip by chip."""
        how, grid = chips.encoding, chips.runs[0].grid
        return cls(
            schema=SCHEMA,
            schema_version=SCHEMA_VERSION,
            program=program_version(),
            runs=[
                MadeRun(None if run.path is None else str(run.path), target, serial, run.snapshot.digest())
                for run, target, serial in zip(chips.runs, chips.targets, chips.serials, strict=True)
            ],
            count=chips.count,
            seed=chips.seed,
            azimuths_deg=list(chips.azimuths_deg),
            grazing_deg=list(chips.grazing_deg),
            ground=str(chips.ground),
            ground_digest=None if str(chips.ground) in (LEARNED, UNIFORM) else sha256_of(Path(chips.ground)),
            speckle=chips.speckle,
            scatterers=chips.scatterers if math.isfinite(chips.scatterers) else None,
            **vars(how),
            shard=shard,
            pixels=how.size(grid),
            spacing_m=grid.spacing_m,
        )

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the settings of a folder of chips."""
        remedy = "give a folder that `sarsplat chips` has written"
        return read_versioned_json(folder / MARKER, cls, schema=SCHEMA, version=SCHEMA_VERSION, remedy=remedy)

    def unlike(self, folder: Path) -> str:
        """Text on the fields that differ from those of the set in another folder."""
        try:
            other = Made.read(folder)
        except SarsplatError:
            return "has a header that this version of the program does not read"
        words = []
        for name, mine in msgspec.structs.asdict(self).items():
            if (theirs := getattr(other, name)) != mine:
                words.append(_CALLED.get(name) or f"{name} ({shown(theirs)}, not {shown(mine)})")
        return f"differs in {', '.join(words)}"
