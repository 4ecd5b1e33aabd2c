"""Built-in targets by name: vehicles, a test object, buildings, a village, a satellite and an aircraft."""

import math
from collections.abc import Callable

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.scenes._shapes import Point, assembled, box, cylinder, faces_between, hull, mirrored, revolved
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


# ---- a satellite and an aircraft for inverse SAR, of simple closed bodies that may intersect, around the origin ----
def satellite() -> Trimesh:
    """A satellite of a bus of 1.8 m × 1.8 m × 2.6 m, two wings of solar panels, 12.6 m across (y), and a dish (+x)."""
    bus = box((-0.9, 0.9), (-0.9, 0.9), (-1.3, 1.3))
    thruster = revolved([(0.0, -1.75), (0.34, -1.75), (0.16, -1.25), (0.0, -1.25)])
    boom = cylinder(0.05, (0.5, 0.4, 1.2), (1.0, 0.8, 3.1), sections=12)
    tip = box((0.9, 1.1), (0.7, 0.9), (3.05, 3.25))
    wings = [body for side in (+1, -1) for body in _wing(side)]
    return assembled([bus, thruster, boom, tip, *wings, *_dish()])


def _wing(side: int) -> list[Trimesh]:
    """Three panels on a yoke, tilted towards the sun."""
    bodies = [cylinder(0.06, (0.0, side * 0.8, 0.2), (0.0, side * 1.7, 0.2), sections=12)]
    slope = math.tan(math.radians(20.0))
    for k in range(3):
        inner, outer = side * (1.7 + 1.55 * k), side * (3.15 + 1.55 * k)
        corners = [(x, y, 0.2 + slope * x + z) for x in (-0.9, 0.9) for y in (inner, outer) for z in (-0.03, 0.03)]
        bodies.append(hull(corners))
        if k:
            bodies.append(cylinder(0.04, (0.0, side * (1.55 + 1.55 * k), 0.2), (0.0, inner, 0.2), sections=12))
    return bodies


def _dish() -> list[Trimesh]:
    """A paraboloid of 1.5 m on a strut, with its feed."""
    radii = np.linspace(0.0, 0.75, 7)
    back = [(float(r), float(0.55 * r**2)) for r in radii]
    front = [(float(r), float(0.55 * r**2 + 0.04)) for r in radii[::-1]]
    bowl = revolved([*back, *front])
    bowl.vertices = bowl.vertices[:, [2, 1, 0]] * (1, 1, -1) + (1.25, 0.0, -0.4)  # it opens to +x
    strut = cylinder(0.06, (0.8, 0.0, -0.4), (1.27, 0.0, -0.4), sections=12)
    feed = cylinder(0.07, (1.7, 0.0, -0.4), (1.95, 0.0, -0.4), sections=12)
    ends = ((0.55, 0.0), (-0.28, 0.48), (-0.28, -0.48))
    legs = [cylinder(0.02, (1.5, y, z - 0.4), (1.75, 0.0, -0.4), sections=8) for y, z in ends]
    return [bowl, strut, feed, *legs]


def aircraft() -> Trimesh:
    """A twin-engined aircraft, 15.2 m long (+x nose), 14 m across and 5 m high."""
    profile = [(0.0, -7.6), (0.25, -7.4), (0.75, -4.0), (0.95, -1.0), (0.95, 4.0), (0.7, 6.4), (0.25, 7.5), (0.0, 7.6)]
    fuselage = revolved(profile)
    fuselage.vertices = fuselage.vertices[:, [2, 1, 0]] * (1, 1, -1)
    engines = []
    for side in (+1, -1):
        nacelle = revolved([(0.0, -1.5), (0.3, -1.4), (0.42, 0.4), (0.38, 0.9), (0.0, 0.9)])
        nacelle.vertices = nacelle.vertices[:, [2, 1, 0]] * (1, 1, -1) + (1.0, side * 2.6, -0.75)
        pylon = hull([(x, side * 2.6 + y, z) for x in (0.2, 1.2) for y in (-0.06, 0.06) for z in (-0.75, -0.3)])
        engines += [nacelle, pylon]
    fin = hull([(x, y, z) for y in (-0.08, 0.08) for x, z in ((-4.6, 0.6), (-7.3, 0.2), (-6.6, 3.3), (-7.5, 3.3))])
    cockpit = mirrored((5.0, 0.35, 1.0), (6.3, 0.3, 0.55), (4.2, 0.45, 0.85), (4.2, 0.3, 1.1))
    wings = _plane((2.2, 0.0, -0.35), 7.0, (3.0, 1.2), 2.4, 0.9, 0.22)
    tail = _plane((-5.4, 0.0, 0.35), 2.6, (1.7, 0.8), 1.1, 0.1, 0.12)
    return assembled([fuselage, *engines, fin, cockpit, wings, tail])


def _plane(
    root: Point, half_span: float, chords: tuple[float, float], sweep: float, rise: float, thickness: float
) -> Trimesh:
    """Both halves of a wing from the leading edge of its root; `sweep` and `rise` move the tips back and up, m."""
    x, _, z = root
    halves = []
    for side in (+1, -1):
        corners = [
            (x - back - share * chord, side * out, z + up + h * thickness * (1 - 0.6 * (out > 0)))
            for out, chord, back, up in ((0.0, chords[0], 0.0, 0.0), (half_span, chords[1], sweep, rise))
            for share, h in ((0.0, 0.0), (0.3, 0.5), (0.3, -0.5), (1.0, 0.0))
        ]
        halves.append(hull(corners))
    return assembled(halves)


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
