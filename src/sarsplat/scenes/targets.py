"""Built-in targets by name: vehicles, a test object and buildings."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sarsplat.errors import SarsplatError
from sarsplat.scenes.buildings import BUILDINGS
from sarsplat.scenes.slicy import slicy
from sarsplat.scenes.vehicles import VEHICLES

if TYPE_CHECKING:
    import trimesh

TARGETS: dict[str, Callable[[], trimesh.Trimesh]] = {
    **VEHICLES,
    "slicy": slicy,
    **{name: box.mesh for name, box in BUILDINGS.items()},
}
"""Known targets and the functions that build them."""


def target_mesh(name: str) -> trimesh.Trimesh:
    """Triangle mesh of a built-in target.

    Parameters
    ----------
    name : str
        One of `TARGETS`.

    Returns
    -------
    trimesh.Trimesh
        Metres, z up, ground at z = 0; a vehicle's nose, SLICY's step, or a building's near wall, towards +x.

    Raises
    ------
    SarsplatError
        If the name is not known.
    """
    if name not in TARGETS:
        raise SarsplatError(f"there is no target named '{name}'; known targets: {', '.join(TARGETS)}")
    return TARGETS[name]()
