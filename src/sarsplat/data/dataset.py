"""A dataset: a folder of SAR images of one target, with their views and how they came about."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float32, Real

from sarsplat.data.fields import Fields, shown
from sarsplat.data.files import plain_os_errors, read_json, write_bytes, write_json
from sarsplat.data.folders import new_folder
from sarsplat.data.tiff import check_power, read_power_tiff, write_power_tiff
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View

if TYPE_CHECKING:
    import trimesh

SCHEMA = "sarsplat-dataset"
SCHEMA_VERSION = 1
HEADER = "dataset.json"
_MESH = "truth.ply"
_MAKE_ONE = "make one with `sarsplat simulate` or `sarsplat import mstar`"

Domain = Literal["rendered", "measured"]


@dataclass(frozen=True)
class DatasetView:
    """One image of a dataset.

    Parameters
    ----------
    view : View
        From where it was taken.
    split : str
        "train", or a test set: a name that starts with "test".
    image : str
        Path of its TIFF, relative to the dataset's folder.
    target_az_deg : float or None
        The azimuth the source gave it, in the source's own convention, degrees; None if there was none.
    """

    view: View
    split: str
    image: str
    target_az_deg: float | None = None


@dataclass(frozen=True)
class Dataset:
    """Images of one target on one grid, on the disk.

    Parameters
    ----------
    path : Path
        Its folder.
    grid : ImageGrid
        Where the pixels of every image lie.
    views : tuple of DatasetView
        Its images, in the order of the header.
    source : dict
        Where the images come from and what was assumed (JSON).
    domain : {"rendered", "measured"}
        Whether they were computed, on the absolute scale of β⁰, or measured, here up to one common factor.
    truth_mesh : Path or None
        Triangle mesh of the target, if it is known; target frame, m.
    """

    path: Path
    grid: ImageGrid
    views: tuple[DatasetView, ...]
    source: dict[str, Any]
    domain: Domain
    truth_mesh: Path | None = None

    def splits(self) -> tuple[str, ...]:
        """Names of the sets it holds, in the order of the header."""
        return tuple(dict.fromkeys(item.split for item in self.views))

    def select(self, split: str) -> tuple[DatasetView, ...]:
        """The views of one set.

        Raises
        ------
        SarsplatError
            If there is no such set.
        """
        chosen = tuple(item for item in self.views if item.split == split)
        if not chosen:
            raise SarsplatError(f"{self.path} has no set {split!r}; it has {', '.join(self.splits())}")
        return chosen

    def images(self, split: str) -> Float32[np.ndarray, "v {self.grid.rows} {self.grid.columns}"]:
        """β⁰ of one set, linear power, float32 [V, rows, columns], row 0 near range; read from the disk."""
        shape = (self.grid.rows, self.grid.columns)
        return np.stack([read_power_tiff(self.path / item.image, shape) for item in self.select(split)])

    def fingerprint(self) -> str:
        """SHA-256 over the header and every pixel, in hexadecimal: the same iff the data are the same."""
        digest = hashlib.sha256(json.dumps(_header(self), sort_keys=True).encode())
        shape = (self.grid.rows, self.grid.columns)
        for item in self.views:
            digest.update(read_power_tiff(self.path / item.image, shape).astype("<f4").tobytes())
        return digest.hexdigest()


def write_dataset(
    path: Path,
    *,
    grid: ImageGrid,
    views: Sequence[tuple[View, str, float | None]],
    images: Real[np.ndarray, "v rows columns"],
    source: dict[str, Any],
    domain: Domain,
    truth_mesh: trimesh.Trimesh | None = None,
    overwrite: bool = False,
) -> Dataset:
    """Write a dataset, whole or not at all.

    Parameters
    ----------
    path : Path
        Folder to make.
    grid : ImageGrid
        Where the pixels lie.
    views : sequence of (View, split, target_az_deg or None)
        One for each image; at least one in the split "train".
    images : numpy.ndarray, float32 [V, rows, columns]
        β⁰, linear power, ≥ 0, row 0 near range.
    source : dict
        Where the images come from and what was assumed; anything JSON can hold.
    domain : {"rendered", "measured"}
        See `Dataset`.
    truth_mesh : trimesh.Trimesh, optional
        The target, m, in the target's frame.
    overwrite : bool
        Whether an existing dataset may be replaced.

    Returns
    -------
    Dataset
        As read back from the disk.

    Raises
    ------
    SarsplatError
        If shapes, splits or pixels are wrong, the folder exists, or it cannot be written.
    """
    expected = (len(views), grid.rows, grid.columns)
    if images.shape != expected or images.dtype != np.float32:
        raise SarsplatError(
            f"the images are {images.dtype} of shape {images.shape}; "
            f"for {len(views)} views they must be float32 {expected}"
        )
    check_power(images, "the array of images")
    digits = max(3, len(str(len(views) - 1)))
    items = tuple(
        DatasetView(view, split, f"images/{index:0{digits}d}.tif", target_az_deg)
        for index, (view, split, target_az_deg) in enumerate(views)
    )
    with new_folder(path, overwrite, marker=HEADER) as folder:
        mesh_path = None if truth_mesh is None else folder / _MESH
        dataset = Dataset(folder, grid, items, source, domain, mesh_path)
        write_json(folder / HEADER, _header(dataset))
        _parse(folder, read_json(folder / HEADER))  # what we write obeys what we demand of others
        if truth_mesh is not None:
            from trimesh.exchange.ply import export_ply

            write_bytes(folder / _MESH, export_ply(truth_mesh))
        with plain_os_errors("write", folder):
            (folder / "images").mkdir()
        for item, image in zip(items, images):
            write_power_tiff(folder / item.image, image, _describe(item, grid))
    return read_dataset(path)


def _describe(item: DatasetView, grid: ImageGrid) -> str:
    return (
        f"SAR image, beta0 in linear power; row 0 is near range, columns grow along the flight direction; "
        f"azimuth {item.view.azimuth_deg:.6g} deg, grazing {item.view.grazing_deg:.6g} deg; "
        f"pixel spacing {grid.spacing_m[0]:.6g} m (azimuth) x {grid.spacing_m[1]:.6g} m (slant range); set {item.split}"
    )


def _header(dataset: Dataset) -> dict[str, Any]:
    """What dataset.json holds."""
    grid = dataset.grid
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "quantity": "beta0",
        "unit": "linear power",
        "domain": dataset.domain,
        "grid": {
            "rows": grid.rows,
            "columns": grid.columns,
            "spacing_m": list(grid.spacing_m),
            "resolution_m": list(grid.resolution_m),
            "center_m": list(grid.center_m),
        },
        "source": dataset.source,
        "truth_mesh": None if dataset.truth_mesh is None else dataset.truth_mesh.name,
        "views": [
            {
                "file": item.image,
                "azimuth_deg": item.view.azimuth_deg,
                "grazing_deg": item.view.grazing_deg,
                "split": item.split,
                "target_az_deg": item.target_az_deg,
            }
            for item in dataset.views
        ],
    }


def read_dataset(path: Path) -> Dataset:
    """Read a dataset's header and check everything in the folder against it, each pixel included.

    Parameters
    ----------
    path : Path
        The dataset's folder; nothing in it is trusted.

    Returns
    -------
    Dataset
        Its images stay on the disk until asked for.

    Raises
    ------
    SarsplatError
        If the folder is missing, empty or no dataset, a field is missing, unknown or out of range, a path leaves the
        folder, an image is missing, damaged or of another shape or type, or there is nothing to train on.
    """
    path = Path(path)
    _look_like_dataset(path)
    value = read_json(path / HEADER)
    try:
        dataset = _parse(path, value)
    except SarsplatError as error:
        raise SarsplatError(f"{path / HEADER}: {error}") from error
    for item in dataset.views:
        read_power_tiff(path / item.image, (dataset.grid.rows, dataset.grid.columns))
    with plain_os_errors("read", path):  # a name may be longer than the system has names
        lacking = dataset.truth_mesh is not None and not dataset.truth_mesh.is_file()
    if dataset.truth_mesh is not None and lacking:
        raise SarsplatError(f"{path} lacks its mesh {shown(dataset.truth_mesh.name)}; {_MAKE_ONE}")
    return dataset


def _look_like_dataset(path: Path) -> None:
    with plain_os_errors("read", path):
        if not path.exists():
            raise SarsplatError(f"{path} does not exist; {_MAKE_ONE}")
        if not path.is_dir():
            raise SarsplatError(f"{path} is a file, but a dataset is a folder that holds {HEADER}; give the folder")
        names = {entry.name for entry in path.iterdir()}
    if HEADER in names:
        return
    if not names:
        raise SarsplatError(f"{path} is empty; {_MAKE_ONE}")
    looks = " (it looks like a run; give the dataset it was made from)" if "metrics.jsonl" in names else ""
    raise SarsplatError(f"{path} is not a dataset: there is no {HEADER} in it{looks}; {_MAKE_ONE}")


def _parse(path: Path, value: object) -> Dataset:
    """The header as a Dataset; strict."""
    if not isinstance(value, dict) or value.get("schema") != SCHEMA:
        raise SarsplatError(f"this is not a dataset's header: its schema is not {SCHEMA!r}; {_MAKE_ONE}")
    if value.get("schema_version") != SCHEMA_VERSION:
        raise SarsplatError(
            f"schema_version is {shown(value.get('schema_version'))} but this program reads {SCHEMA_VERSION}; "
            f"{_MAKE_ONE}"
        )
    fields = Fields(
        value,
        "the header",
        ("schema", "schema_version", "quantity", "unit", "domain", "grid", "source", "truth_mesh", "views"),
    )
    fields.text("quantity", "beta0")
    fields.text("unit", "linear power")
    mesh = None if fields.get("truth_mesh") is None else _inside(path, fields.text("truth_mesh"))
    views = tuple(_parse_view(path, item, f"views[{index}]") for index, item in enumerate(fields.items("views")))
    if not any(item.split == "train" for item in views):
        raise SarsplatError('there is no view in the split "train", so there is nothing to learn from; mark some')
    if len({(path / item.image).resolve() for item in views}) < len(views):
        raise SarsplatError("two views name the same image file; give each view its own")
    domain: Domain = "rendered" if fields.text("domain", "rendered", "measured") == "rendered" else "measured"
    return Dataset(path, _parse_grid(fields.get("grid")), views, fields.mapping("source"), domain, mesh)


def _parse_grid(value: object) -> ImageGrid:
    fields = Fields(value, "grid", ("rows", "columns", "spacing_m", "resolution_m", "center_m"))
    return ImageGrid(
        rows=fields.integer("rows"),
        columns=fields.integer("columns"),
        spacing_m=fields.pair("spacing_m"),
        resolution_m=fields.pair("resolution_m"),
        center_m=fields.pair("center_m"),
    )


def _parse_view(path: Path, value: object, where: str) -> DatasetView:
    fields = Fields(value, where, ("file", "azimuth_deg", "grazing_deg", "split", "target_az_deg"))
    split, image = fields.text("split"), fields.text("file")
    if not re.fullmatch(r"train|test[A-Za-z0-9.-]*", split):
        raise SarsplatError(f'{where}.split is {shown(split)} but must be "train" or a name that starts with "test"')
    _inside(path, image)
    try:
        view = View(fields.number("azimuth_deg"), fields.number("grazing_deg"))
    except SarsplatError as error:
        raise SarsplatError(f"{where}: {error}") from error
    return DatasetView(view, split, image, fields.number_or_null("target_az_deg"))


def _inside(folder: Path, name: str) -> Path:
    """`folder / name`, which must not lead out of the folder, not even by a link."""
    path = folder / name
    try:
        inside = name.isprintable() and path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a name the system cannot hold, or a loop of links
        inside = False
    if not name or not inside:
        raise SarsplatError(
            f"the file {shown(name)} does not lie inside the dataset's folder; use a plain relative path in it"
        )
    return path
