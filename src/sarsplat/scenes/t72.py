"""A T-72 main battle tank of true dimensions, from simple closed bodies that may intersect."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sarsplat.scenes._shapes import assembled, barrel, belt, box, cylinder, hull, prism, revolved

if TYPE_CHECKING:
    import trimesh

_GUN_ELEVATION_DEG = 3.0
_TRUNNION = (1.15, 0.0, 1.68)
_MUZZLE_X = 5.98


def t72() -> trimesh.Trimesh:
    """T-72: hull 6.9 m × 3.6 m, 2.2 m high, 9.55 m with the gun forward; +x nose, +y left, ground at z = 0.

    Centred on the hull in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    return assembled([*_hull(), *_running_gear(+1), *_running_gear(-1), *_fenders(), *_stern(), *_turret(), _gun()])


def _hull() -> list[trimesh.Trimesh]:
    body = [(3.45, 0.92), (2.35, 1.38), (-3.18, 1.38), (-3.45, 0.80), (-2.95, 0.47), (2.85, 0.47)]
    glacis_slope = (1.38 - 0.92) / (3.45 - 2.35)
    guards = [[(2.75, 0.0), (2.45, side), (2.71, 0.0), (2.41, side)] for side in (-1.0, 1.0)]
    splash_guard = [
        hull([(x, y, 0.92 + (3.45 - x) * glacis_slope + dz) for x, y in guard for dz in (0, 0.1)]) for guard in guards
    ]
    lamps = [box((2.70, 2.85), (y - 0.11, y + 0.11), (1.1, 1.37)) for y in (-0.85, 0.85)]
    driver_hatch = cylinder(0.27, (2.05, 0.0, 1.36), (2.05, 0.0, 1.43))
    engine_deck = [box((-2.15, -1.45), (-0.95, 0.95), (1.37, 1.42)), box((-3.05, -2.3), (-1.05, 1.05), (1.37, 1.44))]
    return [prism(body, (-1.15, 1.15)), *splash_guard, *lamps, driver_hatch, *engine_deck]


def _running_gear(side: int) -> list[trimesh.Trimesh]:
    """Track, six road wheels, sprocket (rear) and idler (front) of the left (+1) or right (−1) side."""
    track = (side * 1.19, side * 1.75)
    road = [(2.14 - 0.856 * k, 0.42, 0.375) for k in range(6)]
    idler, sprocket = (2.93, 0.70, 0.27), (-2.98, 0.72, 0.31)
    wheels = [*road, idler, sprocket]
    discs = [cylinder(radius, (x, side * 1.24, z), (x, side * 1.68, z)) for x, z, radius in wheels]
    hubs = [cylinder(0.13, (x, side * 1.6, z), (x, side * 1.73, z), sections=12) for x, z, _ in wheels]
    return [belt(wheels, 0.045, track), *discs, *hubs]


def _fenders() -> list[trimesh.Trimesh]:
    parts = []
    for side in (-1.0, 1.0):
        inner, outer = side * 1.1, side * 1.78
        parts.append(box((-3.25, 2.95), (inner, outer), (1.08, 1.11)))
        # Front mudguard, sloping down to the nose; skirt over the upper run of the track.
        parts.append(prism([(2.95, 1.11), (2.95, 1.08), (3.38, 0.93), (3.38, 0.96)], (inner, outer)))
        parts.append(box((-2.9, 2.75), (side * 1.77, side * 1.80), (0.66, 1.10)))
    # Right: a row of fuel cells. Left: stowage boxes with gaps and the exhaust in front of the last one.
    cells = [box((x, x + 1.02), (-1.72, -1.12), (1.10, 1.36)) for x in (-2.75, -1.65, -0.55, 0.55)]
    lengths = {-2.95: 0.75, -1.25: 1.1, 0.05: 1.5}
    stowage = [box((x, x + length), (1.12, 1.70), (1.10, 1.38)) for x, length in lengths.items()]
    return [*parts, *cells, *stowage, box((-2.0, -1.4), (1.2, 1.76), (1.10, 1.30))]


def _stern() -> list[trimesh.Trimesh]:
    """Two fuel drums across the stern, their brackets and the unditching log below."""
    drums = [cylinder(0.27, (-3.30, y - 0.45, 1.58), (-3.30, y + 0.45, 1.58)) for y in (-0.55, 0.55)]
    brackets = [box((-3.45, -3.1), (y - 0.04, y + 0.04), (1.15, 1.40)) for y in (-0.85, -0.25, 0.25, 0.85)]
    log = cylinder(0.10, (-3.40, -1.2, 1.02), (-3.40, 1.2, 1.02), sections=12)
    return [*drums, *brackets, log]


def _turret() -> list[trimesh.Trimesh]:
    profile = [
        (0.0, 1.34), (0.98, 1.34), (1.12, 1.42), (1.20, 1.54), (1.17, 1.68),
        (1.05, 1.82), (0.84, 1.94), (0.55, 2.02), (0.25, 2.05), (0.0, 2.06),
    ]  # fmt: skip
    dome = revolved(profile)
    dome.apply_scale((1.08, 1.0, 1.0))
    dome.apply_translation((0.22, 0.0, 0.0))
    mantlet = hull(
        [(0.75, y, z) for y in (-0.42, 0.42) for z in (1.45, 1.95)]
        + [(1.52, y, z) for y in (-0.24, 0.24) for z in (1.52, 1.84)]
        + [(1.66, y, z) for y in (-0.16, 0.16) for z in (1.57, 1.80)]
    )
    # Commander on the right with his cupola (the highest point), gunner on the left.
    cupola = [
        cylinder(0.38, (0.02, -0.48, 1.85), (0.02, -0.48, 2.12)),
        cylinder(0.27, (0.02, -0.48, 2.1), (0.02, -0.48, 2.20)),
    ]
    gunner = [cylinder(0.30, (0.12, 0.50, 1.85), (0.12, 0.50, 2.06)), box((0.62, 0.85), (0.35, 0.62), (1.85, 2.10))]
    searchlight = cylinder(0.19, (1.22, -0.55, 1.80), (1.48, -0.55, 1.80))
    snorkel = cylinder(0.12, (-1.08, -0.85, 1.72), (-1.08, 0.95, 1.72), sections=16)
    stowage = [
        box((-1.25, -0.72), (-1.05, -0.35), (1.46, 1.66)),
        box((-1.22, -0.70), (0.15, 0.95), (1.46, 1.66)),
        box((-0.75, -0.10), (0.92, 1.25), (1.48, 1.80)),
        box((-0.70, -0.15), (-1.25, -0.92), (1.48, 1.78)),
    ]
    return [dome, mantlet, *cupola, *gunner, searchlight, snorkel, *stowage]


def _gun() -> trimesh.Trimesh:
    """125 mm-class gun with thermal sleeve, bore evacuator and muzzle collar, inclined upwards."""
    length = (_MUZZLE_X - _TRUNNION[0]) / math.cos(math.radians(_GUN_ELEVATION_DEG))
    profile = [
        (0.0, 0.0), (0.115, 0.0), (0.115, 1.0), (0.092, 1.1), (0.092, 2.55), (0.135, 2.65), (0.135, 3.25),
        (0.088, 3.35), (0.08, length - 0.12), (0.1, length - 0.12), (0.1, length), (0.0, length),
    ]  # fmt: skip
    return barrel(profile, _TRUNNION, _GUN_ELEVATION_DEG)
