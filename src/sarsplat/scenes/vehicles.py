"""Procedural targets by name: +x nose, +y left, +z up, ground at z = 0, metres."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sarsplat.errors import SarsplatError
from sarsplat.scenes.btr70 import btr70
from sarsplat.scenes.kraz import kraz
from sarsplat.scenes.s2s1 import s2s1
from sarsplat.scenes.t72 import t72

if TYPE_CHECKING:
    import trimesh

VEHICLES: dict[str, Callable[[], trimesh.Trimesh]] = {"t72": t72, "btr70": btr70, "2s1": s2s1, "kraz": kraz}
"""Known targets and the functions that build them."""


def vehicle(name: str) -> trimesh.Trimesh:
    """Triangle mesh of a procedural target.

    Parameters
    ----------
    name : str
        One of `VEHICLES`.

    Returns
    -------
    trimesh.Trimesh
        Closed bodies that may intersect; metres, +x nose, +y left, +z up, ground at z = 0, centred on the hull.

    Raises
    ------
    SarsplatError
        If the name is not known.
    """
    if name not in VEHICLES:
        raise SarsplatError(f"there is no target named '{name}'; known targets: {', '.join(sorted(VEHICLES))}")
    return VEHICLES[name]()
