"""Folders of datasets: `dataset.json`, a TIFF for each image, and mesh, terrain and masks where known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from jaxtyping import Float32, UInt8

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import PLAIN_FIELDS, TERRAIN, Dataset, DatasetEntry, passes_of
from sarsplat.data.files import inside, open_file, plain_os_errors, read_versioned_json, write_bytes, write_json
from sarsplat.data.folders import new_folder
from sarsplat.data.header import SCHEMA, SCHEMA_VERSION, DatasetHeader, ViewHeader
from sarsplat.data.image import power_of_passes
from sarsplat.data.sidecar import MASKS, encode_masks, sidecars_of
from sarsplat.data.terrain_file import read_terrain, write_terrain
from sarsplat.data.tiff import read_tiff, write_tiff
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, Stack, Turn, View

if TYPE_CHECKING:
    import trimesh

HEADER = "dataset.json"
_MESH = "truth.ply"


@checks_arguments
def write_dataset(
    path: str | Path,
    dataset: Dataset,
    *,
    truth_mesh: trimesh.Trimesh | None = None,
    masks: UInt8[np.ndarray, "v rows columns"] | None = None,
    pictures: Mapping[str, Float32[np.ndarray, "rows columns"]] | None = None,
    overwrite: bool = False,
) -> Dataset:
    """Write a dataset, whole or not at all.

    Masks and chips without azimuth in the folder that it was read from are copied, unless they are given here or the
    images have changed since; masks also if images have changed by a factor.

    Parameters
    ----------
    path : str or Path
        Folder to make.
    dataset : Dataset
        With at least one image in the split "train".
    truth_mesh : trimesh.Trimesh, optional
        The target, m, in the target's frame; unless given, the file that `dataset.truth_mesh` names is copied.
    masks : numpy.ndarray, uint8 [V, rows, columns], optional
        True masks of simulated images, row 0 near: 0 clutter, 1 target, 2 shadow. They go to the folder `masks`, for
        `read_masks`.
    pictures : mapping of str to numpy.ndarray, float32 [rows, columns], optional
        Linear power of further images, by FOLDER/FILE, as its `source` lists them.
    overwrite : bool
        True to replace an existing dataset.

    Returns
    -------
    Dataset
        The same dataset with its path.

    Raises
    ------
    SarsplatError
        If there is nothing to train on, the masks do not suit the images, the folder exists, or it cannot be written.
    """
    path = Path(path)
    _require_training(dataset)
    mesh = _mesh_bytes(dataset, truth_mesh)
    pngs = {} if masks is None else encode_masks(masks, dataset)
    if pictures is None:
        source, pictures, kept = sidecars_of(dataset, lambda folder: _unchanged(folder, dataset))
        dataset, pngs = replace(dataset, source=source), kept if masks is None else pngs
    written = replace(dataset, path=path, truth_mesh=None if mesh is None else path / _MESH)
    header = written.header()
    pixels = dataset.power if dataset.signal is None else dataset.signal
    with new_folder(path, overwrite, marker=HEADER) as folder:
        write_json(folder / HEADER, header)
        if mesh is not None:
            write_bytes(folder / _MESH, mesh)
        if dataset.terrain is not None:
            write_terrain(folder / TERRAIN, dataset.terrain)
        with plain_os_errors("write", folder):
            (folder / "images").mkdir()
            if pngs:
                (folder / MASKS).mkdir()
        for name, png in pngs.items():
            write_bytes(folder / MASKS / name, png)
        for index, item in enumerate(header.views):
            unusual = dataset.views[index].unusual.replace("°", " deg")
            what = "beta0 in linear power" if dataset.signal is None else "complex amplitude, root of beta0,"
            description = (
                f"SAR image, {what} ({dataset.calibration} scale); row 0 is near range, columns grow "
                f"along the flight direction; azimuth {item.azimuth_deg:.6g} deg, grazing {item.grazing_deg:.6g} deg"
                f"{unusual}; pixel spacing {dataset.grid.spacing_m[0]:.6g} m (azimuth) x "
                f"{dataset.grid.spacing_m[1]:.6g} m (slant range); set {item.split}"
            ) + ("" if item.stack is None else "; one page for each pass")
            write_tiff(folder / item.file, pixels[index], description)
        for picture, power in pictures.items():
            with plain_os_errors("write", folder):
                (folder / picture).parent.mkdir(exist_ok=True)
            write_tiff(folder / picture, power, "SAR image, beta0 in linear power; row 0 is near range")
    return written


def _unchanged(folder: Path, dataset: Dataset) -> tuple[bool, bool]:
    """Return whether a folder's first and last image of a dataset are still the same, and the same but for a factor."""
    header, pixels = read_header(folder), dataset.power if dataset.signal is None else dataset.signal
    files, waves = {item.name: item.file for item in header.views}, header.pixels == "complex"
    known = [index for index, entry in enumerate(dataset.entries) if entry.name in files]
    same = alike = bool(known)
    for index in known[:1] + known[-1:]:
        try:
            file = inside(folder, files[dataset.entries[index].name])
            stored = read_tiff(file, pixels.shape[1:], np.complex64 if waves else np.float32)
        except SarsplatError:  # of another size or type, or gone
            return False, False
        power = dataset.power[index], power_of_passes(stored[None])[0] if waves else stored
        own, other = (image / (image.max() or 1) for image in power)
        same, alike = same and np.array_equal(*power), alike and np.allclose(own, other, atol=0.0)
    return same, alike


def _require_training(dataset: Dataset) -> None:
    if "train" not in dataset.splits():
        raise SarsplatError('no view is in the split "train", so there is nothing to train on; assign at least one')


def _mesh_bytes(dataset: Dataset, mesh: trimesh.Trimesh | None) -> bytes | None:
    if mesh is not None:
        from trimesh.exchange.ply import export_ply

        return export_ply(mesh)
    if dataset.truth_mesh is None:
        return None
    with open_file(dataset.truth_mesh) as file:
        data = file.read()
    if not data.startswith(b"ply"):
        raise SarsplatError(f"{dataset.truth_mesh} is not a PLY file; load the mesh and pass it as truth_mesh")
    return data


@checks_arguments
def read_dataset(path: str | Path) -> Dataset:
    """Read a dataset into memory and check everything in its folder, each pixel included.

    Parameters
    ----------
    path : str or Path
        The dataset's folder; nothing in it is trusted.

    Raises
    ------
    SarsplatError
        If the folder is missing, empty or no dataset, a field is missing, unknown or out of range, a path leaves the
        folder, an image is missing, damaged or of another shape or type, or there is nothing to train on.
    """
    path = Path(path)
    header = read_header(path)
    with _blamed_on(path / HEADER):
        grid = ImageGrid.of(**msgspec.structs.asdict(header.grid))
        entries = tuple(_entry(index, item) for index, item in enumerate(header.views))
        files = [inside(path, item.file) for item in header.views]
        if len({file.resolve() for file in files}) < len(files):
            raise SarsplatError("two views name the same image file; give each view its own")
        passes = passes_of(entries)
        mesh = None if header.truth_mesh is None else inside(path, header.truth_mesh)
        heights = None if header.terrain is None else inside(path, header.terrain)
    if mesh is not None:
        with open_file(mesh):  # raises if it is missing
            pass
    make, pixel = (Dataset.of_complex, np.complex64) if header.pixels == "complex" else (Dataset, np.float32)
    shape = (passes, grid.rows, grid.columns) if passes else (grid.rows, grid.columns)
    images = [read_tiff(file, shape, pixel) for file in files]
    with _blamed_on(path / HEADER):
        dataset = make(
            grid,
            entries,
            np.stack(images) if images else np.empty((0, *shape), pixel),
            **{name: getattr(header, name) for name in PLAIN_FIELDS},
            truth_mesh=mesh,
            terrain=None if heights is None else read_terrain(heights),
            place=header.place.place if header.place else None,
            path=path,
        )
        _require_training(dataset)
    return dataset


def read_header(path: Path) -> DatasetHeader:
    """Read `dataset.json`; raise if the folder holds no dataset, or one of another version."""
    with plain_os_errors("read", path):
        names = {entry.name for entry in path.iterdir()}
    if HEADER not in names:
        remedy = f"make one with `sarsplat simulate`, or by an import, which `sarsplat info {path}` recommends"
        if "metrics.jsonl" in names:
            remedy = "it looks like a run, so give the dataset it was made from"
        raise SarsplatError(f"{path} is not a dataset, for it holds no {HEADER}; {remedy}")
    return read_versioned_json(
        path / HEADER, DatasetHeader, schema=SCHEMA, version=SCHEMA_VERSION, remedy="simulate or import it again"
    )


@contextmanager
def _blamed_on(place: object) -> Iterator[None]:
    """Prefix errors in the block with the file or field that causes them."""
    try:
        yield
    except SarsplatError as error:
        raise SarsplatError(f"{place}: {error}") from error


def _entry(index: int, item: ViewHeader) -> DatasetEntry:
    with _blamed_on(f"views[{index}]"):
        if item.apart_deg or item.apart_towards_deg:
            raise SarsplatError("the view is bistatic, which is not supported; give images of one radar")
        view = View(item.azimuth_deg, item.grazing_deg, item.tilt_deg, item.side, item.aloft, item.stretch)
    with _blamed_on(f"views[{index}].stack"):
        stack = None if item.stack is None else Stack(**msgspec.structs.asdict(item.stack))
    with _blamed_on(f"views[{index}].turn"):
        turn = None if item.turn is None else Turn(**msgspec.structs.asdict(item.turn))
        if turn is not None:
            turn.check(view)
    return DatasetEntry(view, item.split, item.name, item.azimuth_std_deg or 0.0, stack, turn)
