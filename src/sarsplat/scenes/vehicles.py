"""Procedural targets by name: +x nose, +y left, +z up, ground at z = 0, metres."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sarsplat.scenes.btr70 import btr70
from sarsplat.scenes.kraz import kraz
from sarsplat.scenes.s2s1 import s2s1
from sarsplat.scenes.t72 import t72

if TYPE_CHECKING:
    import trimesh

VEHICLES: dict[str, Callable[[], trimesh.Trimesh]] = {"t72": t72, "btr70": btr70, "2s1": s2s1, "kraz": kraz}
"""Known vehicles and the functions that build them: closed bodies that may intersect, centred on the hull."""
