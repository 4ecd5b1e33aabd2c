"""SAR images of one target on one grid, with their views, calibration, speckle and ground."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from jaxtyping import Complex, Complex64, Real

from sarsplat.arguments import checks_arguments, expect, expect_fields
from sarsplat.data.header import SCHEMA, SCHEMA_VERSION, SPLIT, Box, Calibration, DatasetHeader
from sarsplat.data.image import SarImage, as_signal, check_power, check_signal, in_blocks, power_of_passes
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import ImageGrid, Place, Stack, Terrain, Turn, View
from sarsplat.threads import convert

_FARTHEST_M = 1e6  # maximum coordinate of the target's box, m
_MAX_AZIMUTH_STD_DEG = 10.0
PLAIN_FIELDS = (
    *("target", "calibration", "looks", "clean_tests", "ground", "score_margin", "target_box_m", "protocol", "source"),
)
"""Fields of `Dataset` that `dataset.json` holds unchanged."""

TERRAIN = "terrain.tif"
"""File of the terrain in a dataset's folder."""


@dataclass(frozen=True)
class DatasetEntry:
    """View, set and name of one image of a dataset.

    Parameters
    ----------
    view : View
        Direction to the radar.
    split : str
        "train", or a test set: a name that starts with "test".
    name : str
        Name of the image, e.g. the measured chip's path.
    azimuth_std_deg : float
        Standard deviation of the view's azimuth, degrees, at most 10; 0 if it is known exactly.
    stack : Stack, optional
        Passes of an interferometric stack, coregistered to `view` and the grid.
    turn : Turn, optional
        Rotation of a target aloft by which the frame was made, with its uncertainty.
    """

    view: View
    split: str
    name: str
    azimuth_std_deg: float = 0.0
    stack: Stack | None = None
    turn: Turn | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        if self.turn is not None:
            self.turn.check(self.view)
        std = self.azimuth_std_deg
        if not 0 <= std <= _MAX_AZIMUTH_STD_DEG:  # also catches NaN
            raise SarsplatError(
                f"azimuth_std_deg {shown(std)} of the image {shown(self.name)} is not a number between 0 and "
                f"{_MAX_AZIMUTH_STD_DEG:g}; give degrees, and improve less certain azimuths first"
            )
        object.__setattr__(self, "azimuth_std_deg", float(std))  # numpy's numbers do not fit into JSON


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Images of one target on one grid, in memory.

    Parameters
    ----------
    grid : ImageGrid
        Pixels of every image.
    entries : tuple of DatasetEntry
        One for each image.
    power : numpy.ndarray, float32 [V, rows, columns]
        β⁰, linear power, ≥ 0, row 0 near range; read-only by convention. Of stacks, the mean over the passes.
    signal : numpy.ndarray, complex64 [V, rows, columns] or [V, P, rows, columns], or None
        Complex amplitudes, if the phases are known: |signal|² is the power. Of stacks, those of P passes, not deramped.
        See `of_complex`.
    target : str
        Name of the target.
    calibration : {"absolute", "relative"}
        "absolute": the power is β⁰; "relative": β⁰ up to one common unknown factor.
    looks : float or None
        Number of looks of the speckle in the images; None without speckle.
    clean_tests : bool
        True if the test images have no speckle although the others do; they are scored as noise-free ones.
    ground : bool
        True if the images show the ground around the target.
    terrain : Terrain or None
        Heights of that ground; None where it is level at z = 0. With terrain, z in `target_box_m` is above it.
    place : Place or None
        Position of the scene's origin on earth, and bearing of its x axis, if known.
    score_margin : int
        Pixels left out on each side of an image when speckled images are scored.
    target_box_m : pair of (x, y, z) or None
        Corners of the box around the target, world frame, m; None to derive it from the images.
    protocol : str or None
        Experiment with the same views and grid, "paper" or "mstar".
    truth_mesh : Path or None
        Triangle mesh of the target (PLY), if it is known; target frame, m.
    source : dict
        Origin of the images, for people to read (JSON); programs use it only to orient masks of chips.
    path : Path or None
        Its folder; None for a dataset that is in memory only.

    Raises
    ------
    SarsplatError
        If shapes do not fit, a pixel is negative, absurdly large or not finite, or a field is out of range.
    """

    grid: ImageGrid
    entries: tuple[DatasetEntry, ...]
    power: Real[np.ndarray, "v rows columns"]
    _: KW_ONLY
    signal: Complex64[np.ndarray, "v *passes rows columns"] | None = None
    target: str = "unnamed"
    calibration: Calibration = "absolute"
    looks: float | None = None
    clean_tests: bool = False
    ground: bool = False
    terrain: Terrain | None = None
    place: Place | None = None
    score_margin: int = 0
    target_box_m: Box | None = None
    protocol: str | None = None
    truth_mesh: Path | None = None
    source: dict[str, Any] = field(default_factory=dict)
    path: Path | None = None

    def __post_init__(self) -> None:
        expect(ImageGrid, grid=self.grid)
        expect(tuple[DatasetEntry, ...], entries=self.entries)
        expected, power = (len(self.entries), self.grid.rows, self.grid.columns), self.power
        if not isinstance(power, np.ndarray) or power.shape != expected or power.dtype != np.float32:
            raise SarsplatError(
                f"the images are {getattr(power, 'dtype', type(power).__name__)} of shape {np.shape(power)}; "
                f"for {counted(len(self.entries), 'view')} they must be float32 {expected}"
            )
        check_signal(self.signal, self.power, "the images", self.passes)
        for entry, image in zip(self.entries, self.power):
            check_power(image, f"the image {shown(entry.name)}")
            if not re.fullmatch(SPLIT, entry.split):
                raise SarsplatError(
                    f'split {shown(entry.split)} of the image {shown(entry.name)} must be "train" or a name that '
                    'starts with "test"'
                )
        expect(Place | None, place=self.place)
        self.header()  # raises if a field has a type that dataset.json cannot hold
        looks, margin, box, aloft = self.looks, self.score_margin, self.target_box_m, sum(v.aloft for v in self.views)
        sides = zip(*box, strict=True) if box is not None else ()
        for wrong, message in (
            (not self.entries, "a dataset needs at least one image, but entries is empty; give one for each image"),
            (looks is not None and not 0 < looks < math.inf, f"looks {looks} must be a positive number, or None"),
            (self.clean_tests and looks is None, "clean_tests needs speckled images, but looks is None; give both"),
            (
                not 0 <= 2 * margin < min(expected[1:]),
                f"score_margin {margin} does not suit images of {expected[1]} × {expected[2]} pixels; give 0 or more, "
                "less than half a side",
            ),
            (0 < aloft < len(self), f"{aloft} of {len(self)} views are of a target aloft; give all or none"),
            (aloft and self.ground, "the views are of a target aloft, without ground, but ground is True"),
            (self.terrain is not None and not self.ground, "terrain is ground, but ground is False; give both"),
            (
                not all(-_FARTHEST_M <= low < high <= _FARTHEST_M for low, high in sides),
                f"target_box_m {box} must be a lower and an upper corner (x, y, z) in metres",
            ),
        ):
            if wrong:
                raise SarsplatError(message)

    @classmethod
    @checks_arguments
    def of_complex(
        cls,
        grid: ImageGrid,
        entries: tuple[DatasetEntry, ...],
        signal: Complex[np.ndarray, "v *passes rows columns"],
        **fields: Any,
    ) -> Self:
        """Make a dataset that keeps the phases.

        Parameters
        ----------
        grid, entries
            See `Dataset`.
        signal : numpy.ndarray, complex [V, rows, columns], or of stacks [V, P, rows, columns]
            Complex amplitudes √β⁰·e^jψ, row 0 near range.
        **fields
            Other fields of `Dataset`.

        Raises
        ------
        SarsplatError
            As for `Dataset`.
        """
        signal = as_signal(signal, "the images")
        return cls(grid, entries, power_of_passes(signal), signal=signal, **fields)

    @classmethod
    @checks_arguments
    def from_images(
        cls,
        images: Sequence[SarImage],
        *,
        test: Sequence[SarImage] = (),
        azimuth_std_deg: float | Sequence[float] = 0.0,
        turns: Sequence[Turn] | None = None,
        **fields: Any,
    ) -> Dataset:
        """Make a dataset in memory from training and test images.

        Parameters
        ----------
        images, test : sequence of SarImage
            All on the same grid; either all with their phase (`SarImage.of_complex`) or all without.
        azimuth_std_deg : float or sequence of float
            Standard deviation of the azimuths, degrees: one for all images, or one for each, test images last.
        turns : sequence of Turn, optional
            Rotation of a target aloft in each image, test images last.
        **fields
            `target`, `calibration`, `looks`, `ground` and other fields of `Dataset`.

        Raises
        ------
        SarsplatError
            If there are no training images, there are more or fewer standard deviations or turns than images, grids
            differ, only some images have their phase, or a field is out of range.
        """
        every = [*images, *test]
        if not images:
            raise SarsplatError("there are no training images; give at least one")
        grid = every[0].grid
        for index, image in enumerate(every):
            if image.grid != grid:
                raise SarsplatError(
                    f"image {index} is on {image.grid} but the first image is on {grid}; give images with the same grid"
                )
        stds = list(azimuth_std_deg) if isinstance(azimuth_std_deg, Iterable) else [azimuth_std_deg] * len(every)
        rotations: list[Turn | None] = [None] * len(every) if turns is None else list(turns)
        for name, count in (("azimuth_std_deg", len(stds)), ("turns", len(rotations))):
            if count != len(every):
                raise SarsplatError(f"{name} holds {count} values for {len(every)} images; give one for each")
        signals = [image.signal for image in every if image.signal is not None]
        if 0 < len(signals) < len(every):
            raise SarsplatError(f"{len(signals)} of {len(every)} images have their phase; give all with it, or none")
        digits = max(3, len(str(len(every) - 1)))
        entries = tuple(
            DatasetEntry(image.view, "train" if index < len(images) else "test", f"{index:0{digits}d}", std, turn=turn)
            for index, (image, std, turn) in enumerate(zip(every, stds, rotations, strict=True))
        )
        power = np.stack([image.power for image in every]).astype(np.float32, copy=False)
        return cls(grid, entries, power, signal=np.stack(signals) if signals else None, **fields)

    def __len__(self) -> int:
        return len(self.entries)

    @checks_arguments
    def __getitem__(self, index: int) -> SarImage:
        """Return an image; of a stack, its power without phases."""
        signal = None if self.signal is None or self.passes else self.signal[index]
        return SarImage(self.power[index], self.entries[index].view, self.grid, signal)

    def __str__(self) -> str:
        return f"the dataset of {self.target} in memory" if self.path is None else str(self.path)

    def __repr__(self) -> str:
        sets = ", ".join(f"{len(self.images(split))} {split}" for split in self.splits())
        return f"<Dataset of {self.target}: {sets}; {self.grid.rows} × {self.grid.columns} pixels>"

    @property
    def speckle(self) -> str:
        """Name of the speckle in its images: "none", "1 look", "4 looks, test images without"."""
        if self.looks is None:
            return "none"
        looks = f"{self.looks:g} look{'' if self.looks == 1 else 's'}"
        return f"{looks}, test images without" if self.clean_tests else looks

    @property
    def views(self) -> tuple[View, ...]:
        """View of each image."""
        return tuple(entry.view for entry in self.entries)

    @property
    def passes(self) -> int:
        """Number of passes of each image; 0 unless they are stacks."""
        return passes_of(self.entries)

    @property
    def stacks(self) -> tuple[Stack, ...]:
        """Stack of each image; empty unless they are stacks."""
        return tuple(entry.stack for entry in self.entries if entry.stack is not None)

    @property
    def interferometric(self) -> bool:
        """True for stacks whose phases depend on elevation."""
        return bool(self.passes) and all(stack.interferometric for stack in self.stacks)

    @property
    def polarimetric(self) -> bool:
        """True for stacks of several polarisations."""
        return bool(self.passes) and all(stack.polarimetric for stack in self.stacks)

    def splits(self) -> tuple[str, ...]:
        """Names of its sets, in order of first appearance."""
        return tuple(dict.fromkeys(entry.split for entry in self.entries))

    @checks_arguments
    def multilooked(self, factor: int) -> Dataset:
        """Return images of mean power over blocks of factor × factor pixels, without their phase."""
        grid = self.grid.multilooked(factor)
        power = in_blocks(self.power, factor).mean(axis=(2, 4))
        more = self.grid.independent_samples / grid.independent_samples
        looks = None if self.looks is None else self.looks * more
        return replace(self, grid=grid, power=power, signal=None, looks=looks, score_margin=0, path=None)

    @checks_arguments
    def select(self, split: str) -> Dataset:
        """Return one set alone as a dataset in memory; its `looks` are those of its images.

        Raises
        ------
        SarsplatError
            If there is no such set.
        """
        clean = self.clean_tests and split != "train"
        looks = None if clean else self.looks
        return replace(self.take(self.indices(split)), looks=looks, clean_tests=False)

    @checks_arguments
    def take(self, indices: Sequence[int]) -> Dataset:
        """Return the images with these indices, in this order, as a dataset in memory."""
        chosen = [*indices]
        part = _part(chosen)
        return replace(
            self,
            entries=tuple(self.entries[index] for index in chosen),
            power=self.power[part],
            signal=None if self.signal is None else self.signal[part],
            path=None,
        )

    @checks_arguments
    def images(self, split: str) -> Real[np.ndarray, "v {self.grid.rows} {self.grid.columns}"]:
        """Return β⁰ of one set, linear power, float32 [V, rows, columns], row 0 near range; may be a view of `power`.

        Raises
        ------
        SarsplatError
            If there is no such set.
        """
        return self.power[_part(self.indices(split))]

    @checks_arguments
    def indices(self, split: str) -> list[int]:
        """Return the indices of the images of one set; raise if there is no such set."""
        chosen = [index for index, entry in enumerate(self.entries) if entry.split == split]
        if not chosen:
            raise SarsplatError(f"{self} has no set {split!r}; it has {', '.join(self.splits())}")
        return chosen

    def header(self) -> DatasetHeader:
        """Return the content of `dataset.json`, in the types that reading returns; raise if JSON cannot hold it."""
        digits = max(3, len(str(len(self) - 1)))
        plain = {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "quantity": "beta0",
            "unit": "linear power",
            **{name: getattr(self, name) for name in PLAIN_FIELDS},
            "pixels": "power" if self.signal is None else "complex",
            "truth_mesh": None if self.truth_mesh is None else self.truth_mesh.name,
            "terrain": None if self.terrain is None else TERRAIN,
            "grid": self.grid.as_dict(),
            "views": [
                {"file": f"images/{index:0{digits}d}.tif", **entry.view.as_dict()}
                | {"split": entry.split, "name": entry.name, "azimuth_std_deg": entry.azimuth_std_deg or None}
                | ({} if entry.stack is None else {"stack": vars(entry.stack)})
                | ({} if entry.turn is None else {"turn": vars(entry.turn)})
                for index, entry in enumerate(self.entries)
            ],
        }
        if self.place is not None:
            plain["place"] = self.place.as_dict()
        try:
            return convert(msgspec.to_builtins(plain), DatasetHeader)
        except (msgspec.ValidationError, TypeError, RecursionError) as error:
            raise SarsplatError(
                f"the dataset does not fit into JSON: {error}; use finite numbers, text, lists, dicts"
            ) from error

    def fingerprint(self) -> str:
        """Return the SHA-256 of header and pixels, in hexadecimal; it does not depend on the folder."""
        header = msgspec.structs.replace(self.header(), truth_mesh=None)
        digest = hashlib.sha256(msgspec.json.encode(header, order="deterministic"))
        digest.update((self.power.astype("<f4") if self.signal is None else self.signal.astype("<c8")).tobytes())
        if self.terrain is not None:
            digest.update(np.array(self.terrain.pitch_m, "<f8").tobytes())
            digest.update(self.terrain.heights_m.astype("<f8").tobytes())
        return digest.hexdigest()


def passes_of(entries: Sequence[DatasetEntry]) -> int:
    """Return the number of passes of each image, 0 unless they are stacks; raise if images differ."""
    passes = sorted({0 if entry.stack is None else len(entry.stack) for entry in entries})
    if len(passes) > 1:
        raise SarsplatError(
            f"some images are of {passes[0]} passes and others of {passes[-1]} (0: no stack); give stacks of the same "
            "number of passes, or single images"
        )
    return passes[0] if passes else 0


def _part(indices: list[int]) -> slice | list[int]:
    """Convert indices for numpy, to a slice where possible, which copies nothing."""
    consecutive = bool(indices) and indices == [*range(indices[0], indices[0] + len(indices))]
    return slice(indices[0], indices[-1] + 1) if consecutive else indices
