"""A satellite and an aircraft for inverse SAR, of simple closed bodies that may intersect, around the origin."""

import math

import numpy as np

from sarsplat.extras import Trimesh
from sarsplat.scenes._shapes import Point, assembled, box, cylinder, hull, mirrored, revolved


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
