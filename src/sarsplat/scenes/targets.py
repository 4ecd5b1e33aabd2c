"""Built-in targets by name: vehicles, a test object, buildings, a village, a satellite and an aircraft."""

from collections.abc import Callable

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.scenes._shapes import Point, assembled, box, cylinder, faces_between
from sarsplat.scenes.aloft import aircraft, satellite
from sarsplat.scenes.buildings import BUILDINGS
from sarsplat.scenes.tracked import s2s1, t72
from sarsplat.scenes.village import village
from sarsplat.scenes.wheeled import btr70, kraz

# ---- SLICY, the test object of the MSTAR collection ----
_SIDE = 1.375  # half the width of both blocks
_FRONT, _STEP, _BACK = 1.2225, 0.9089, -1.2225
_TREAD, _ROOF = 0.4604, 0.774
_LYING = 0.3136  # radius of the cylinder on the step
_STANDING = 0.33  # radius of the cylinder and of the tube on the roof
_STANDING_X = -0.4933
_APEX: Point = (0.1659, 0.3783, _ROOF)  # of the corner reflector
_LEG = 0.2927
_SECTIONS = 64


def slicy() -> Trimesh:
    """SLICY: 2.445 m × 2.750 m, 1.689 m high; +x out of the face with the step, +y left of it, ground at z = 0.

    Centred on the base block. A stepped block; on the step a lying cylinder, a quarter of which shows outside
    the blocks; on the roof a closed and an open standing cylinder, the latter without thickness, and a trihedral corner
    reflector that opens towards +x. Sizes are from someone else's model, not from a drawing.
    """
    base = box((_BACK, _FRONT), (-_SIDE, _SIDE), (0, _TREAD))
    upper = box((_BACK, _STEP), (-_SIDE, _SIDE), (_TREAD, _ROOF))
    lying = cylinder(_LYING, (_STEP, -0.1915, _TREAD), (_STEP, 0.9156, _TREAD), _SECTIONS)
    tall = cylinder(_STANDING, (_STANDING_X, 0.5838, _ROOF), (_STANDING_X, 0.5838, 1.689), _SECTIONS)
    return assembled([base, upper, lying, tall, _slicy_tube(), _slicy_corner()])


def _slicy_tube() -> Trimesh:
    """The wall of a cylinder, open above and below."""
    import trimesh

    angles = np.arange(_SECTIONS) * (2 * np.pi / _SECTIONS)
    ring = np.column_stack([_STANDING_X + _STANDING * np.cos(angles), -0.5821 + _STANDING * np.sin(angles)])
    vertices = np.concatenate([np.column_stack([ring, np.full(_SECTIONS, z)]) for z in (_ROOF, 1.232)])
    faces = np.concatenate(faces_between(0, 1, _SECTIONS)[::-1])
    return trimesh.Trimesh(vertices, faces, process=False)


def _slicy_corner() -> Trimesh:
    """Three right-angled triangles around the apex: one on the roof, two that stand on its legs."""
    import trimesh

    diagonal = _LEG / np.sqrt(2)
    ends = _LEG * np.eye(3)[2], np.array([diagonal, diagonal, 0]), np.array([diagonal, -diagonal, 0])
    vertices = np.array(_APEX) + np.array([np.zeros(3), *ends])
    return trimesh.Trimesh(vertices, [[0, 3, 2], [0, 2, 1], [0, 1, 3]], process=False)


# ---- all targets ----
VEHICLES: dict[str, Callable[[], Trimesh]] = {"t72": t72, "btr70": btr70, "2s1": s2s1, "kraz": kraz}
"""Vehicles and the functions that build them: closed bodies that may intersect, centred on the hull."""

ALOFT: dict[str, Callable[[], Trimesh]] = {"satellite": satellite, "aircraft": aircraft}
"""Targets around the origin, without ground, and the functions that build them."""

TARGETS: dict[str, Callable[[], Trimesh]] = {
    **VEHICLES,
    "slicy": slicy,
    **{name: box.mesh for name, box in BUILDINGS.items()},
    "village": village,
    **ALOFT,
}
"""All built-in targets and the functions that build them."""


@checks_arguments
def target_mesh(name: str) -> Trimesh:
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
