"""Built-in targets by name: vehicles, a test object, buildings, a village, a satellite and an aircraft."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.scenes.aloft import aircraft, satellite
from sarsplat.scenes.btr70 import btr70
from sarsplat.scenes.buildings import BUILDINGS
from sarsplat.scenes.kraz import kraz
from sarsplat.scenes.s2s1 import s2s1
from sarsplat.scenes.slicy import slicy
from sarsplat.scenes.t72 import t72
from sarsplat.scenes.village import village

if TYPE_CHECKING:
    import trimesh

VEHICLES: dict[str, Callable[[], trimesh.Trimesh]] = {"t72": t72, "btr70": btr70, "2s1": s2s1, "kraz": kraz}
"""Vehicles and the functions that build them: closed bodies that may intersect, centred on the hull."""

ALOFT: dict[str, Callable[[], trimesh.Trimesh]] = {"satellite": satellite, "aircraft": aircraft}
"""Targets around the origin, without ground, and the functions that build them."""

TARGETS: dict[str, Callable[[], trimesh.Trimesh]] = {
    **VEHICLES,
    "slicy": slicy,
    **{name: box.mesh for name, box in BUILDINGS.items()},
    "village": village,
    **ALOFT,
}
"""All built-in targets and the functions that build them."""


@checks_arguments
def target_mesh(name: str) -> trimesh.Trimesh:
    """Build the triangle mesh of a built-in target; `village` makes villages of any size.

    Parameters
    ----------
    name : str
        One of `TARGETS`.

    Returns
    -------
    trimesh.Trimesh
        Metres, z up, ground at z = 0 except for `ALOFT`; noses, SLICY's step and buildings' near walls towards +x.

    Raises
    ------
    SarsplatError
        If there is no target of that name.
    """
    if name not in TARGETS:
        raise SarsplatError(f"there is no target named '{name}'; choose one of {', '.join(TARGETS)}")
    return TARGETS[name]()
