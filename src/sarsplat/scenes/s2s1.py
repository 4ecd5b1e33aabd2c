"""A 2S1 Gvozdika self-propelled howitzer of true dimensions, from simple closed bodies that may intersect."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sarsplat.scenes._shapes import assembled, barrel, belt, box, cylinder, hull, mirrored, prism, wheel

if TYPE_CHECKING:
    import trimesh

ROAD_WHEELS_X = tuple(2.30 - 0.79 * k for k in range(7))
"""Seven on either side, without return rollers."""


def s2s1() -> trimesh.Trimesh:
    """2S1: 7.26 m × 2.85 m, 2.73 m high, howitzer level with the nose; +x nose, +y left, ground at z = 0.

    Centred on the hull in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    return assembled([*_hull(), *_side(+1), *_side(-1), *_deck(), *_stern(), *_turret(), *_howitzer()])


def _hull() -> list[trimesh.Trimesh]:
    tub = [(3.63, 0.98), (3.50, 0.86), (2.75, 0.42), (-3.15, 0.42), (-3.50, 0.60), (-3.50, 1.20), (3.35, 1.08)]
    # Above the tracks the hull is as wide as they are, behind a long sloping bow.
    upper = mirrored(
        (3.63, 1.05, 0.98), (3.55, 1.15, 1.04), (3.05, 1.40, 1.06), (2.62, 1.40, 0.98), (-3.30, 1.40, 0.98),
        (-3.55, 1.32, 1.10), (1.75, 1.30, 1.62), (-3.45, 1.28, 1.62),
    )  # fmt: skip
    return [prism(tub, (-1.0, 1.0)), upper]


def _side(side: int) -> list[trimesh.Trimesh]:
    """Running gear and fender of the left (+1) or right (−1) side: the sprocket is in front, the idler behind."""
    radius, thickness = 0.335, 0.04
    road = [(x, radius + thickness, radius) for x in ROAD_WHEELS_X]
    sprocket, idler = (3.02, 0.60, 0.24), (-3.12, 0.56, 0.25)
    track = belt([*road, sprocket, idler], thickness, (side * 1.025, side * 1.425))
    wheels = [wheel(x, (side * 1.07, side * 1.39), r, rim=0.62, z=z) for x, z, r in [*road, sprocket, idler]]
    guard = [(3.05, 1.02), (3.42, 0.86), (3.42, 0.82), (3.05, 0.98)]
    mudguard = hull([(x, side * y, z) for y in (1.02, 1.41) for x, z in guard])
    rear_flap = box((-3.60, -3.50), (side * 1.02, side * 1.41), (0.72, 1.02))
    return [track, *wheels, mudguard, rear_flap]


def _deck() -> list[trimesh.Trimesh]:
    # Driver on the left in front, behind a windscreen; the engine and its grilles on the right.
    slope = (1.62 - 1.04) / (3.55 - 1.75)
    hood = [(2.35, 1.40), (1.95, 1.72), (1.30, 1.72), (1.25, 1.60)]
    driver_hood = hull([(x, y, z) for y in (0.35, 1.0) for x, z in hood])
    hatch = cylinder(0.30, (1.62, 0.68, 1.70), (1.62, 0.68, 1.77))
    grilles = [box((x, x + 0.55), (-1.10, -0.15), (1.60, 1.67)) for x in (0.55, 1.15)]
    louvre = hull(
        [(x, y, 1.62 - (x - 1.75) * slope + dz) for x in (1.85, 2.75) for y in (-1.05, -0.15) for dz in (-0.05, 0.05)]
    )
    exhaust = cylinder(0.09, (0.95, -1.05, 1.70), (0.45, -1.22, 1.72), sections=12)
    lamps = [cylinder(0.10, (3.05, y, 1.34), (3.20, y, 1.34), sections=16) for y in (-1.05, 1.05)]
    lamp_posts = [box((3.02, 3.08), (y - 0.05, y + 0.05), (1.05, 1.34)) for y in (-1.05, 1.05)]
    # Travel lock of the barrel on the bow; trim vane folded across it.
    lock = [box((2.75, 2.83), (y - 0.03, y + 0.03), (1.2, 1.66)) for y in (-0.16, 0.16)]
    vane = hull(
        [(x, y, 1.62 - (x - 1.75) * slope + dz) for x in (3.05, 3.42) for y in (-0.95, 0.95) for dz in (-0.03, 0.05)]
    )
    return [driver_hood, hatch, *grilles, louvre, exhaust, *lamps, *lamp_posts, *lock, vane]


def _stern() -> list[trimesh.Trimesh]:
    door = box((-3.58, -3.45), (-0.42, 0.42), (0.80, 1.52))
    boxes = [box((-3.63, -3.45), (y - 0.25, y + 0.25), (1.05, 1.45)) for y in (-0.92, 0.92)]
    hooks = [box((-3.60, -3.3), (y - 0.06, y + 0.06), (0.62, 0.76)) for y in (-0.75, 0.75)]
    return [door, *boxes, *hooks]


def _turret() -> list[trimesh.Trimesh]:
    """Large, low and flat-roofed, near the stern; sides and front slope."""
    base = [(0.42, 0.55), (0.10, 0.98), (-0.75, 1.22), (-1.90, 1.24), (-2.65, 1.00), (-2.95, 0.55)]
    roof = [(-0.22, 0.48), (-0.45, 0.72), (-0.95, 0.94), (-1.90, 0.98), (-2.48, 0.82), (-2.68, 0.45)]
    body = mirrored(*((x, y, 1.66) for x, y in base), *((x, y, 2.38) for x, y in roof))
    ring = cylinder(1.12, (-1.25, 0.0, 1.58), (-1.25, 0.0, 1.70), sections=40)
    # Commander's cupola with its searchlight on the left behind the gunner's sight, the loader's hatch on the right.
    cupola = [
        cylinder(0.42, (-1.45, 0.48, 2.38), (-1.45, 0.48, 2.54)),
        cylinder(0.31, (-1.50, 0.48, 2.5), (-1.50, 0.48, 2.60)),
        cylinder(0.12, (-1.12, 0.48, 2.61), (-0.98, 0.48, 2.61), sections=16),
        box((-1.26, -1.12), (0.40, 0.56), (2.50, 2.63)),
    ]
    sight = [box((-0.85, -0.55), (0.42, 0.72), (2.36, 2.60)), box((-0.78, -0.64), (0.50, 0.66), (2.56, 2.73))]
    loader = cylinder(0.32, (-1.20, -0.50, 2.38), (-1.20, -0.50, 2.48))
    ventilator = cylinder(0.17, (-2.15, -0.40, 2.38), (-2.15, -0.40, 2.52), sections=16)
    bustle = box((-3.10, -2.60), (-0.55, 0.55), (1.80, 2.12))
    return [body, ring, *cupola, *sight, loader, ventilator, bustle]


def _howitzer() -> list[trimesh.Trimesh]:
    """122 mm howitzer with bore evacuator and a double-baffle muzzle brake."""
    mantlet = hull(
        [(-0.3, y, z) for y in (-0.42, 0.42) for z in (1.72, 2.26)]
        + [(0.48, y, z) for y in (-0.26, 0.26) for z in (1.80, 2.16)]
    )
    length = 3.62
    profile = [
        (0.0, 0.0), (0.19, 0.0), (0.19, 0.62), (0.125, 0.68), (0.115, 1.55), (0.165, 1.62), (0.165, 2.25),
        (0.105, 2.32), (0.095, length - 0.55), (0.165, length - 0.53), (0.165, length - 0.32), (0.10, length - 0.30),
        (0.10, length - 0.22), (0.165, length - 0.20), (0.165, length), (0.0, length),
    ]  # fmt: skip
    return [mantlet, barrel(profile, (-0.05, 0.0, 1.98), elevation_deg=0.0)]
