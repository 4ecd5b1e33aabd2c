"""`sarsplat info`: describe a file or folder."""

import math
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import COMPRESSED, OptionalFile
from sarsplat.cli.importers import recognised
from sarsplat.cli.info_dataset import describe_dataset
from sarsplat.cli.info_run import describe_contents, describe_run, extent
from sarsplat.errors import SarsplatError, counted
from sarsplat.extras import Trimesh

_MAX_SUNK = 0.02  # maximum depth below the ground, relative to a mesh's size: wheels may sink in
_UNDERSTOOD = (
    "a dataset, a run, a folder of these, images to import, a PLY or .splat file, a mesh, or the plan of a sweep"
)


def info(
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")], *, plot: OptionalFile = None
) -> None:
    """Describe a dataset with its views, a run, a folder of these, images to import, a PLY, a mesh or a plan.

    Parameters
    ----------
    path
        File or folder to describe.
    plot
        For a dataset: also draw its views on the sky, to a .png or .svg file, which is replaced if it exists.
    """
    if not path.exists():
        raise SarsplatError(f"{path} does not exist; give {_UNDERSTOOD}")
    if (path / "dataset.json").is_file():
        describe_dataset(path, plot)
        return
    if plot is not None:
        raise SarsplatError(f"--plot {plot} draws the views of a dataset, but {path} is not a dataset; omit it")
    if (path / "config.json").is_file():
        describe_run(path)
    elif path.is_dir() and describe_contents(path):
        pass
    elif (found := recognised(path)) is not None:
        importer, it = found
        console.facts(f"{path}: {it.kind}", it.facts)
        console.say(f"import with: sarsplat import {importer} (see sarsplat import {importer} --help)")
    elif path.suffix.lower() == ".toml" and path.is_file():
        _describe_plan(path)
    else:
        _describe_file(path)


def _describe_file(path: Path) -> None:
    match path.suffix.lower() if path.is_file() else "":
        case ".ply":
            kind, rows = _ply(path)
        case suffix if suffix in (".splat", *COMPRESSED):
            kind, rows = _gaussians(path)
        case ".obj" | ".stl" | ".off":
            kind, rows = _mesh(path)
        case ".glb":
            from sarsplat.data.gltf_splats import holds_gaussians  # imports torch

            kind, rows = (_gaussians if holds_gaussians(path) else _mesh)(path)
        case _:
            raise SarsplatError(f"{path} cannot be described; give {_UNDERSTOOD}")
    if path.with_name(f"{path.name}.place.json").is_file():
        from sarsplat.exports.georeference import read_place  # imports torch

        rows["on earth"] = str(read_place(path))
    console.facts(f"{path}: {kind}", rows)


def _describe_plan(path: Path) -> None:
    from sarsplat.sweeps.plan import Plan

    plan = Plan.read(path)
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


def _ply(path: Path) -> tuple[str, dict[str, str]]:
    from sarsplat.data.files import open_file

    with open_file(path) as file:
        header = file.read(65_536).partition(b"end_header")[0]
    if b"property list" in header:
        return _mesh(path)
    if b" f_dc_0" in header or b" packed_position" in header:
        return _gaussians(path)
    from sarsplat.data import read_points_ply

    points, columns = read_points_ply(path)
    return "points", {"points": extent(points), "other columns": ", ".join(columns) or "none"}


def _gaussians(path: Path) -> tuple[str, dict[str, str]]:
    from sarsplat.data.ply import read_centred_gaussians
    from sarsplat.runs.own_gaussians import without_strays

    centred, moved = read_centred_gaussians(path)
    near, left_out = without_strays(centred)
    filled = len(centred) > 0
    rows = {
        "centres": extent(centred.means.double().numpy() + moved),
        **({"of the others": extent(near.means.double().numpy() + moved), "apart": left_out} if left_out else {}),
        "scales": f"median {centred.scales.median():.3g} m" if filled else "none",
        "optical depth": f"median {centred.optical_depth.median():.3g} (two-way, peak)" if filled else "–",
        "scattering": f"{centred.scattering.kind}, {counted(centred.scattering.parameters.shape[1], 'number')} each; "
        f"p_min {centred.scattering.p_min:g} (γ⁰)",
    }
    if moved.any():
        middle = ", ".join(f"{value:.10g}" for value in moved)
        rows["place"] = f"far from the origin; images are made after ({middle}) m has been subtracted"
    if path.suffix.lower() in (".splat", ".glb"):
        rows["colours"] = "taken as γ⁰; such files keep no more than a shade of it, a .ply of ours keeps all"
    return f"{len(centred)} Gaussians", rows


def _mesh(path: Path) -> tuple[str, dict[str, str]]:
    from sarsplat.scenes import load_mesh

    mesh = load_mesh(path)
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)  # an STL repeats vertices in every face
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


def _place(mesh: Trimesh) -> str | None:
    """Return a remark if a mesh is off the origin or below the ground."""
    low, high = mesh.bounds
    size = math.dist(low, high)
    if max(abs(low[:2] + high[:2])) / 2 > size or low[2] > size:
        return "away from the origin, on which images are centred; simulate it with --recentre"
    if low[2] < -_MAX_SUNK * size:
        return f"reaches {-low[2]:.3g} m below z = 0, where the ground is; raise it, or simulate it with --recentre"
    return None
