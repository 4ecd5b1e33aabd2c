"""`sarsplat info`: what is this file or folder?"""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import OptionalFile
from sarsplat.cli.importers import recognised, to_replace
from sarsplat.cli.info_chips import chips_in, describe_chips
from sarsplat.cli.info_dataset import describe_dataset
from sarsplat.cli.info_run import describe_contents, describe_run, extent
from sarsplat.errors import SarsplatError, counted

if TYPE_CHECKING:
    import trimesh

    from sarsplat.data.geotiff import Georeference

_MARKERS = ("config.json", "contact-sheet.png")
"""Of folders that we make, besides datasets."""

_GEO_KEYS = 34735
"""The tag of TIFFs that lie on a map."""
_EXPORTED = (".geojson", ".las", ".laz", ".npz", ".pcd", ".xyz")
"""Endings of files that we write and do not read."""

_PLACE = ".place.json"
"""Of what lies beside those with the scene's own coordinates."""
_LISTED = 5
"""Names that are listed of a file that is none of ours."""
_SUNK = 0.02  # of the size of a mesh: wheels may sink in
_UNDERSTOOD = (
    "a dataset, a run, rendered images, generated chips, images to import, a PLY of Gaussians or points, a power TIFF "
    "or a mesh"
)


def info(
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")], *, plot: OptionalFile = None
) -> None:
    """Describe a file or folder: dataset with its views, run, folder of these, images to import, PLY, TIFF or mesh.

    Parameters
    ----------
    path
        File or folder to describe.
    plot
        For a dataset: also draw its views on the sky, to a .png or .svg file, which is replaced if it exists.
    """
    if plot is None and (place := chips_in(path)) is not None:
        describe_chips(path, place)
        return
    if not path.exists():
        raise SarsplatError(f"{path} does not exist; give {_UNDERSTOOD}")
    if path.is_dir() and (path / "dataset.json").is_file():
        describe_dataset(path, plot)
        return
    if plot is not None:
        raise SarsplatError(f"--plot {plot} draws the views of a dataset, and {path} is none; omit it")
    if path.is_dir() and not (path / "config.json").is_file() and describe_contents(path):
        return
    ours = any((path / name).is_file() for name in _MARKERS) or _part_of(path) is not None
    if not ours and (importable := recognised(path)) is not None:
        console.facts(f"{path}: {importable.kind}", importable.facts)
        if importable.command is not None:
            console.say(f"import with: {importable.command}")
            for text in to_replace(importable.command):
                console.say(f"  {text}")
        for purpose, typed in importable.also.items():
            console.say(f"{purpose}: {typed}")
        return
    if (path / "config.json").is_file():
        describe_run(path)
        return
    if path.suffix.lower() == ".toml" and path.is_file():
        _describe_plan(path)
        return
    kind, rows = _folder(path) if path.is_dir() else _file(path)
    if path.with_name(f"{path.name}{_PLACE}").is_file():
        from sarsplat.exports.place_file import read_place  # takes torch, which other files need not wait for

        rows["on earth"] = str(read_place(path))
    console.facts(f"{path}: {kind}", rows)


def _folder(path: Path) -> tuple[str, dict[str, str]]:
    if (path / "contact-sheet.png").is_file():
        return _renderings(path)
    _refuse_part(path)
    raise SarsplatError(
        f"{path} is a folder but neither a dataset nor a run, and there are no images in it; give {_UNDERSTOOD}"
    )


def _refuse_part(path: Path) -> None:
    """Point from a part of a dataset or run to the whole."""
    if (whole := _part_of(path)) is not None:
        raise SarsplatError(f"{path} is part of the {whole}; give that folder instead")


def _part_of(path: Path) -> str | None:
    for folder in path.absolute().parents[:2]:
        for header, whole in (("dataset.json", "dataset"), ("config.json", "run")):
            if (folder / header).is_file():
                return f"{whole} {folder}"
    return None


def _file(path: Path) -> tuple[str, dict[str, str]]:
    match path.suffix.lower():
        case ".tif" | ".tiff":
            return _tiff(path)
        case ".ply":
            return _ply(path)
        case ".splat":
            return _gaussians(path)
        case ".png" | ".jpg" | ".jpeg":
            raise SarsplatError(
                f"{path} is a picture without units; give its folder, and info reports whether it can be imported"
            )
        case ".json" | ".geojson" | ".jsonl" | ".safetensors" | ".html" | ".csv" | ".txt" | ".md":
            _refuse_part(path)
            _refuse_export(path)
            if path.suffix.lower() == ".json" and (settings := _settings(path)) is not None:
                return settings
            raise SarsplatError(f"{path} is not a file that this command recognises; give {_UNDERSTOOD}")
        case ".obj" | ".stl" | ".off" | ".glb":
            return _mesh(path)
    from sarsplat.data.foreign_splats import refuse_foreign

    refuse_foreign(path)
    _refuse_export(path)
    raise SarsplatError(f"{path} is not a file that this command recognises by its ending; give {_UNDERSTOOD}")


def _refuse_export(path: Path) -> None:
    """Point from what `export` writes, and nothing here reads, to who reads it."""
    if path.name.endswith(_PLACE):
        raise SarsplatError(f"{path} says where on earth {path.name.removesuffix(_PLACE)} is; read it as text")
    if path.suffix.lower() in _EXPORTED:
        from sarsplat.exports import FORMATS  # takes torch, which other files need not wait for

        programs = " or ".join(FORMATS[path.suffix.lower().removeprefix(".")].opened_with.values())
        raise SarsplatError(f"{path} is of a kind that is exported for other programs; open it with {programs}")


def _settings(path: Path) -> tuple[str, dict[str, str]] | None:
    """Settings of a reconstruction, as --print-config writes them; None if it holds something else."""
    from sarsplat.data import read_json
    from sarsplat.settings.config import DEFAULT_METHOD

    try:
        content = read_json(path, dict[str, Any])
    except SarsplatError:
        return None
    settings = content.get("config", content)
    if not isinstance(settings, dict) or not {"preset", "iterations"} <= settings.keys():
        return None
    method = str(content.get("method", DEFAULT_METHOD))
    typed = ["--config", str(path), *(["--method", method] if method != DEFAULT_METHOD else [])]
    return "settings of a reconstruction", {
        "method": method,
        "preset": str(settings["preset"]),
        "iterations": str(settings["iterations"]),
        "reconstruct by them": shlex.join(["sarsplat", "reconstruct", "DATASET", *typed, "--out", "RUN"]),
    }


def _describe_plan(path: Path) -> None:
    from sarsplat.sweeps.plan import Plan, read_toml

    if "datasets" not in (content := read_toml(path)):  # as every plan has
        holds = ", ".join(list(content)[:_LISTED]) + ", …" * (len(content) > _LISTED)
        raise SarsplatError(
            f"{path} is a TOML file that holds {holds or 'nothing'}, but no plan of a sweep, which names datasets; "
            f"give {_UNDERSTOOD}"
        )
    plan = Plan.from_dict(content, str(path))
    rows = {
        "datasets": f"{', '.join(plan.datasets)} (below {path.absolute().parent})",
        "methods": ", ".join(plan.methods),
        "preset": plan.preset if isinstance(plan.preset, str) else ", ".join(plan.preset),
        "seeds": ", ".join(map(str, plan.seeds)),
        "parts": str(len(plan.parts)) if plan.parts else "none",
    }
    console.facts(f"{path}: a plan of a sweep", rows)
    out = f"{path.absolute().parent.name}-runs"
    console.say(f"reconstruct by it: sarsplat sweep {shlex.quote(str(path))} --out {shlex.quote(out)}")


def _renderings(path: Path) -> tuple[str, dict[str, str]]:
    images = sorted(path.glob("az*_gr*.tif"))
    if not images:
        raise SarsplatError(
            f"{path} no longer contains its images; render them again with `sarsplat render RUN "
            f"--azimuth DEGREES --grazing DEGREES --out {shlex.quote(str(path))}`"
        )
    rows = {"images": f"{images[0].stem} … {images[-1].stem}, degrees", "pixels": _tiff(images[0])[1]["pixels"]}
    return f"{counted(len(images), 'rendered image')}, β⁰ in linear power (TIFF) and decibels (PNG)", rows


def _tiff(path: Path) -> tuple[str, dict[str, str]]:
    import tifffile

    from sarsplat.data import read_tiff
    from sarsplat.data.files import open_file
    from sarsplat.data.image import power_of

    with open_file(path) as file:
        try:
            with tifffile.TiffFile(file) as tiff:
                page = tiff.pages.first
                shape, description, on_map = page.shape, str(page.description), _GEO_KEYS in page.tags
                kind = "complex64" if page.dtype == "complex64" else "float32"
                ours = page.software == "sarsplat"
        except Exception as error:  # a garbled TIFF can fail anywhere inside the parser, with any exception
            raise SarsplatError(f"{path} is not a readable TIFF ({error}); give {_UNDERSTOOD}") from error
    if on_map and ours:
        return _map(path, description)
    if on_map:
        return _others_map(path, description)
    if len(shape) != 2:
        raise SarsplatError(f"{path} is a TIFF of shape {shape}; give a power image, which has only rows and columns")
    pixels = read_tiff(path, (shape[0], shape[1]), kind)
    power = power_of(pixels) if kind == "complex64" else pixels
    rows = {
        "pixels": f"{shape[0]} rows × {shape[1]} columns, {kind}",
        "power": f"mean {power.mean():.4g}, largest {power.max():.4g}, linear",
        "description": description or "none",
    }
    return f"a {'complex' if kind == 'complex64' else 'power'} image", rows


def _others_map(path: Path, description: str) -> tuple[str, dict[str, str]]:
    """A GeoTIFF of another program, of which nobody but who wrote it knows whether it is heights or a picture."""
    heights = (
        f"give heights as --terrain or to `sarsplat export {shlex.quote(str(path))} layover-shadow.tif --azimuth "
        "DEGREES --grazing DEGREES`"
    )
    picture = (
        "pictures with a table to `sarsplat import folder --geocoded`, which `sarsplat info` of their folder writes out"
    )
    try:
        kind, rows = _map(path, description)
    except SarsplatError as error:  # a picture may hold what no heights do
        if (lies := _in_degrees(path)) is not None:
            rows = {
                "pixels": f"{lies.pixel} (columns × rows)",
                "system": lies.system,
                "description": description or "none",
            }
            return "a map in degrees (GeoTIFF)", {**rows, "if heights": str(error), "if power": f"give {picture}"}
        raise SarsplatError(f"{path} lies on a map (GeoTIFF); {heights}, and {picture}") from error
    return kind, {**rows, "if heights": heights, "if power": f"give {picture}"}


def _in_degrees(path: Path) -> Georeference | None:
    """Where a GeoTIFF's pixels lie, if that is by longitude and latitude."""
    from sarsplat.importers.rasters import first_georeference

    lies = first_georeference([path])
    return lies if lies is not None and lies.geographic else None


def _map(path: Path, description: str) -> tuple[str, dict[str, str]]:
    """What a GeoTIFF of one band holds: a map that `export` wrote, a dataset's terrain, or anyone's heights."""
    import numpy as np

    from sarsplat.data.geotiff import LEVELS, read_heights

    found = read_heights(path)
    values, (width, height), place = found.raster.values, found.raster.pitch_m, found.place
    above = found.raster.height_above
    known = values[np.isfinite(values)]
    return "a map (GeoTIFF)", {
        "pixels": f"{values.shape[0]} rows × {values.shape[1]} columns of {width:.6g} m × {height:.6g} m",
        "numbers": f"{known.min():.6g} … {known.max():.6g}" if len(known) else "none",
        "no data": f"{1 - len(known) / values.size:.0%}",
        "middle": f"latitude {place.latitude_deg:.6f}°, longitude {place.longitude_deg:.6f}°" if place else "not known",
        **({} if above is None else {"heights": f"above {LEVELS[above]}"}),
        "description": description or "none",
    }


def _ply(path: Path) -> tuple[str, dict[str, str]]:
    from sarsplat.data.files import open_file

    with open_file(path) as file:
        header = file.read(65_536).partition(b"end_header")[0]
    if b"property list" in header:
        return _mesh(path)
    if b" f_dc_0" in header or b" packed_" in header:
        return _gaussians(path)
    from sarsplat.data import read_points_ply

    points, columns = read_points_ply(path)
    return "points", {"points": extent(points), "other columns": ", ".join(columns) or "none"}


def _gaussians(path: Path) -> tuple[str, dict[str, str]]:
    from sarsplat.data.ply import read_centred_gaussians
    from sarsplat.runs.own_gaussians import without_strays

    centred, moved = read_centred_gaussians(path)
    near, left_out = without_strays(centred)
    some = len(centred) > 0
    rows = {
        "centres": extent(centred.means.double().numpy() + moved),
        **({"of the others": extent(near.means.double().numpy() + moved), "apart": left_out} if left_out else {}),
        "scales": f"median {centred.scales.median():.3g} m" if some else "none",
        "optical depth": f"median {centred.optical_depth.median():.3g} (two-way, peak)" if some else "–",
        "scattering": f"{centred.scattering.kind}, {counted(centred.scattering.parameters.shape[1], 'number')} each; "
        f"p_min {centred.scattering.p_min:g} (γ⁰)",
    }
    if moved.any():
        middle = ", ".join(f"{value:.10g}" for value in moved)
        rows["place"] = f"far from the origin; images are made after ({middle}) m has been subtracted"
    if path.suffix.lower() == ".splat":
        rows["colours"] = "taken as γ⁰; .splat keeps no more than a shade of it, a .ply of ours keeps all"
    return f"{len(centred)} Gaussians", rows


def _mesh(path: Path) -> tuple[str, dict[str, str]]:
    from sarsplat.scenes import load_mesh

    mesh = load_mesh(path)
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)  # an STL repeats each in every face
    rows = {
        "vertices": extent(mesh.vertices),
        "faces": str(len(mesh.faces)),
        "surface": f"{mesh.area:.4g} m²",
        "closed": "yes" if merged.is_watertight else "no (fine for ray casting)",
        "unit": "assumed to be metres; +x nose, +y left, +z up, ground at z = 0",
    }
    if path.suffix.lower() == ".glb":
        rows["upright"] = "y is up in the file, as in every glTF; if the mesh lies on its side, z was: export it again"
    if (place := _place(mesh)) is not None:
        rows["place"] = place
    return "a mesh", rows


def _place(mesh: trimesh.Trimesh) -> str | None:
    """What is odd about where a mesh stands, if anything is."""
    low, high = mesh.bounds
    size = math.dist(low, high)
    if max(abs(low[:2] + high[:2])) / 2 > size or low[2] > size:
        return "away from the origin, on which images are centred; simulate it with --recentre"
    if low[2] < -_SUNK * size:
        return f"reaches {-low[2]:.3g} m below z = 0, where the ground is; raise it, or simulate it with --recentre"
    return None
