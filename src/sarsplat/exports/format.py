"""The interface of a file format for other programs, and what of a run it can hold: Gaussians, points, a mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from sarsplat.data import write_mesh
from sarsplat.data.folders import Recognises
from sarsplat.errors import SarsplatError, counted
from sarsplat.exports.map_system import MapSystem
from sarsplat.geometry import Place
from sarsplat.names import Colour, Content
from sarsplat.runs import Run

Coordinates = Literal["scene", "map", "degrees"]
"""What the coordinates in a file are."""

Write = Callable[[Any, Path, Colour], object]
"""Writes `Gaussians`, `Points`, a trimesh or a `Raster` to a file, whole or not at all; the colour is of
Gaussians."""


@dataclass(frozen=True)
class Format:
    """A file format: the `FORMAT` of a module `format_ENDING.py` beside this one, or an entry point named ENDING.

    Attributes
    ----------
    writers : mapping of Content to Write
        What it can hold, and who writes that; the first is what is written unless asked otherwise.
    opened_with : mapping of Content to str
        Programs that open it.
    recognises : callable (bytes, int) -> bool
        Whether a file that begins with these bytes, and has that many, is of this kind: no other is replaced.
    coordinates : {"scene", "map", "degrees"}
        What its coordinates are: the scene's, and a file beside it says where on earth they are, if the run knows;
        those of a map, if the run knows, or else the scene's; or longitudes and latitudes.
    named_by_content : bool
        A file whose name is, or ends with, what such files can hold, holds that unless asked otherwise, as gamma0.tif
        and village-gamma0.tif.
    up : str
        In which direction meshes stand in it, for those who open them.
    """

    writers: Mapping[Content, Write]
    opened_with: Mapping[Content, str]
    recognises: Recognises
    coordinates: Coordinates = "scene"
    named_by_content: bool = False
    up: str = "z up"


def mesh_format(recognises: Recognises, up: str = "z up") -> Format:
    """A format of meshes that `write_mesh` knows."""
    writers: Mapping[Content, Write] = {"mesh": lambda mesh, path, _: write_mesh(path, mesh)}
    return Format(writers, {"mesh": "any mesh viewer"}, recognises, up=up)


@dataclass(frozen=True)
class Points:
    """Points of a surface.

    Attributes
    ----------
    positions, normals : numpy.ndarray, float32 [P, 3]
        World frame, m, and unit normals.
    gamma0 : numpy.ndarray, float32 [P], or None
        γ⁰, linear, if the method estimates it.
    place : Place or None
        Where on earth the world frame is, if the run knows.
    system : MapSystem or None
        That of the file, where its format holds coordinates of maps and the run knows its place.
    """

    positions: Float32[np.ndarray, "p 3"]
    normals: Float32[np.ndarray, "p 3"]
    gamma0: Float32[np.ndarray, " p"] | None
    place: Place | None = None
    system: MapSystem | None = None

    def columns(self) -> dict[str, Float32[np.ndarray, " p"]]:
        """The columns of the points besides their positions, by name."""
        normals = dict(zip(("nx", "ny", "nz"), self.normals.T, strict=True))
        return normals if self.gamma0 is None else {**normals, "gamma0": self.gamma0}


def content_of(run: Run, content: Content) -> tuple[Any, str]:
    """Return a run's Gaussians, `Points` or mesh, and their description; refused if empty."""
    name = "the run in memory" if run.path is None else str(run.path)
    longer = "train it longer, or look at its report"
    if run.path is None:
        longer = "export the Gaussians themselves, as .ply or .splat, or more and denser ones"
    match content:
        case "gaussians":
            gaussians = run.gaussians
            if gaussians is None:
                raise SarsplatError(
                    f"{name} was made by {run.method}, which learns no Gaussians; export its points or its mesh, such "
                    "as with --format points to a .ply file"
                )
            if len(gaussians) == 0:
                raise SarsplatError(f"{name} has no Gaussians left; reconstruct it again, or look at its report")
            return gaussians, counted(len(gaussians), "Gaussian")
        case "points":
            if len(run.points) == 0:
                raise SarsplatError(f"{name} has no points of a surface yet; {longer}")
            points = Points(run.points.astype(np.float32), run.normals, run.points_gamma0, run.place)
            return points, f"{counted(len(run.points), 'point')}, metres, in the target's own frame"
        case "mesh":
            mesh = run.mesh()
            if len(mesh.faces) == 0:
                raise SarsplatError(f"{name} has too few points of a surface for a mesh; {longer}")
            return mesh, f"{counted(len(mesh.faces), 'triangle')}, metres"
        case _:
            raise AssertionError(f"{content} is a map")
