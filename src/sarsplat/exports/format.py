"""Interface of a file format for other programs, and its contents from a run: Gaussians, points, a mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from sarsplat.data import write_mesh
from sarsplat.data.folders import Recognises
from sarsplat.errors import SarsplatError, counted
from sarsplat.exports.georeference import Coordinates, MapSystem
from sarsplat.geometry import Place
from sarsplat.names import Colour, Content
from sarsplat.runs import Run

Write = Callable[[Any, Path, Colour], object]
"""Writer of `Gaussians`, `Points`, a trimesh or a `Raster` to a file; the colour is for Gaussians."""


@dataclass(frozen=True)
class Format:
    """File format: the `FORMAT` of a module `format_ENDING.py` in this folder, or an entry point named ENDING."""

    writers: Mapping[Content, Write]
    """Writers by content; the first content is the default."""
    opened_with: Mapping[Content, str]
    """Programs that open it, by content."""
    recognises: Recognises
    """Predicate of a file of the format, by its first bytes and its size: no other file is replaced."""
    coordinates: Coordinates = "scene"
    """Coordinate system: "scene", with the georeference in a sidecar file; "map" if the run has a georeference, or else
    the scene's; or "degrees", longitudes and latitudes."""
    named_by_content: bool = False
    """True if names of files that end with a content choose it, as gamma0.tif and village-gamma0.tif."""
    up: str = "z up"
    """Vertical axis of meshes, for the summary."""


def mesh_format(recognises: Recognises) -> Format:
    """Return a format of meshes that `write_mesh` supports."""
    writers: Mapping[Content, Write] = {"mesh": lambda mesh, path, _: write_mesh(path, mesh)}
    return Format(writers, {"mesh": "any mesh viewer"}, recognises)


@dataclass(frozen=True)
class Points:
    """Points of a surface."""

    positions: Float32[np.ndarray, "p 3"]
    """World frame, m."""
    normals: Float32[np.ndarray, "p 3"]
    """Unit normals."""
    gamma0: Float32[np.ndarray, " p"] | None
    """γ⁰, linear, if the method estimates it."""
    place: Place | None = None
    """Georeference of the world frame, if known."""
    system: MapSystem | None = None
    """Coordinate system of the file, if its format and the run support maps."""

    def columns(self) -> dict[str, Float32[np.ndarray, " p"]]:
        """Return columns besides positions, by name."""
        normals = dict(zip(("nx", "ny", "nz"), self.normals.T, strict=True))
        return normals if self.gamma0 is None else {**normals, "gamma0": self.gamma0}


def content_of(run: Run, content: Content) -> tuple[Any, str]:
    """Return a run's Gaussians, `Points` or mesh, and their description; raise if empty."""
    longer = "train it longer, or look at its report"
    if run.path is None:
        longer = "export the Gaussians themselves, as .ply or .splat, or more and denser ones"
    data: Any
    match content:
        case "gaussians":
            if run.gaussians is None:
                raise SarsplatError(
                    f"{name_of(run)} was made by {run.method}, which learns no Gaussians; export its points or its mesh"
                )
            data, count, noun, frame = run.gaussians, len(run.gaussians), "Gaussian", ""
            longer = "reconstruct it again, or look at its report"
        case "points":
            data = Points(run.points.astype(np.float32), run.normals, run.points_gamma0, run.place)
            count, noun, frame = len(run.points), "point", ", metres, in the target's own frame"
        case "mesh":
            data = run.mesh()
            count, noun, frame = len(data.faces), "triangle", ", metres"
        case _:
            raise AssertionError(f"{content} is a map")
    if not count:
        raise SarsplatError(f"{name_of(run)} has no {noun}s yet; {longer}")
    return data, f"{counted(count, noun)}{frame}"


def name_of(run: Run) -> str:
    """Name of a run in messages."""
    return "the run in memory" if run.path is None else str(run.path)
