"""What `dataset.json` holds, field by field; msgspec reads and writes it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import msgspec

from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    from sarsplat.data.dataset import Dataset

SCHEMA = "sarsplat-dataset"
SCHEMA_VERSION = 2

Calibration = Literal["absolute", "relative"]
Pair = tuple[float, float]
Point = tuple[float, float, float]
Box = tuple[Point, Point]


class Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A JSON object: every field there, none unknown, each of its type."""


class GridHeader(Strict, frozen=True):
    """`ImageGrid` in JSON."""

    rows: int
    columns: int
    spacing_m: Pair
    resolution_m: Pair
    center_m: Pair


class ViewHeader(Strict, frozen=True, omit_defaults=True):
    """One image: its file, and `DatasetEntry`. What came later has a default, as in `DatasetHeader`."""

    file: str
    azimuth_deg: float
    grazing_deg: float
    split: str
    name: str
    azimuth_std_deg: float | None = None  # of 0: msgspec leaves out a default only if it is the very object


class DatasetHeader(Strict, frozen=True, omit_defaults=True):
    """`Dataset` without its pixels. A field that came later has a default, which the fingerprint leaves out."""

    schema: str
    schema_version: int
    quantity: Literal["beta0"]
    unit: Literal["linear power"]
    target: str
    calibration: Calibration
    looks: float | None
    ground: bool
    score_margin: int
    target_box_m: Box | None
    protocol: str | None
    truth_mesh: str | None
    grid: GridHeader
    source: dict[str, Any]
    views: tuple[ViewHeader, ...]
    clean_tests: bool = False
    pixels: Literal["power", "complex"] = "power"

    @classmethod
    def of(cls, dataset: Dataset) -> DatasetHeader:
        """The header of a dataset, each number of the type it will be read back as.

        Raises
        ------
        SarsplatError
            If a field is of another type, or `source` does not fit into JSON.
        """
        digits = max(3, len(str(len(dataset) - 1)))
        plain = {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "quantity": "beta0",
            "unit": "linear power",
            **{name: getattr(dataset, name) for name in _AS_THEY_ARE},
            "pixels": "power" if dataset.signal is None else "complex",
            "truth_mesh": None if dataset.truth_mesh is None else dataset.truth_mesh.name,
            "grid": vars(dataset.grid),
            "views": [
                {"file": f"images/{index:0{digits}d}.tif", **vars(entry.view)}
                | {"split": entry.split, "name": entry.name, "azimuth_std_deg": entry.azimuth_std_deg or None}
                for index, entry in enumerate(dataset.entries)
            ],
        }
        try:
            return msgspec.convert(msgspec.to_builtins(plain), cls)
        except (msgspec.ValidationError, TypeError, RecursionError) as error:
            raise SarsplatError(
                f"the dataset does not fit into JSON: {error}; use finite numbers, text, lists, dicts"
            ) from error


_AS_THEY_ARE = (
    *("target", "calibration", "looks", "clean_tests", "ground", "score_margin", "target_box_m", "protocol", "source"),
)
