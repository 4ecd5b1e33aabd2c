"""The interface of a file format for other programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sarsplat.data import write_mesh
from sarsplat.data.folders import Recognises
from sarsplat.names import Colour
from sarsplat.names import Content as Names

Content = Names | Literal["everything"]
"""The part of a run that a file holds."""

Write = Callable[[Any, Path, Colour], object]
"""Writes `Gaussians`, `Points`, a trimesh or the `Run` to a file, whole or not at all; the colour is of Gaussians."""


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
    """

    writers: Mapping[Content, Write]
    opened_with: Mapping[Content, str]
    recognises: Recognises


def mesh_format(recognises: Recognises) -> Format:
    """A format of meshes that `write_mesh` knows."""
    return Format({"mesh": lambda mesh, path, _: write_mesh(path, mesh)}, {"mesh": "any mesh viewer"}, recognises)
