"""Tracked vehicles of true dimensions, a T-72 and a 2S1, from simple closed bodies that may intersect."""

import math

from sarsplat.extras import Trimesh
from sarsplat.scenes._shapes import assembled, barrel, belt, box, cylinder, hull, mirrored, prism, revolved, wheel

_GUN_ELEVATION_DEG = 3.0
_TRUNNION = (1.15, 0.0, 1.68)
_MUZZLE_X = 5.98


def t72() -> Trimesh:
    """T-72: hull 6.9 m × 3.6 m, 2.2 m high, 9.55 m with the gun forward; +x nose, +y left, ground at z = 0.

    Centred on the hull in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    gear = [*_t72_running_gear(+1), *_t72_running_gear(-1)]
    return assembled([*_t72_hull(), *gear, *_t72_fenders(), *_t72_stern(), *_t72_turret(), _t72_gun()])


def _t72_hull() -> list[Trimesh]:
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


def _t72_running_gear(side: int) -> list[Trimesh]:
    """Track, six road wheels, sprocket (rear) and idler (front) of the left (+1) or right (−1) side."""
    track = (side * 1.19, side * 1.75)
    road = [(2.14 - 0.856 * k, 0.42, 0.375) for k in range(6)]
    idler, sprocket = (2.93, 0.70, 0.27), (-2.98, 0.72, 0.31)
    wheels = [*road, idler, sprocket]
    discs = [cylinder(radius, (x, side * 1.24, z), (x, side * 1.68, z)) for x, z, radius in wheels]
    hubs = [cylinder(0.13, (x, side * 1.6, z), (x, side * 1.73, z), sections=12) for x, z, _ in wheels]
    return [belt(wheels, 0.045, track), *discs, *hubs]


def _t72_fenders() -> list[Trimesh]:
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


def _t72_stern() -> list[Trimesh]:
    """Two fuel drums across the stern, their brackets and the unditching log below."""
    drums = [cylinder(0.27, (-3.30, y - 0.45, 1.58), (-3.30, y + 0.45, 1.58)) for y in (-0.55, 0.55)]
    brackets = [box((-3.45, -3.1), (y - 0.04, y + 0.04), (1.15, 1.40)) for y in (-0.85, -0.25, 0.25, 0.85)]
    log = cylinder(0.10, (-3.40, -1.2, 1.02), (-3.40, 1.2, 1.02), sections=12)
    return [*drums, *brackets, log]


def _t72_turret() -> list[Trimesh]:
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


def _t72_gun() -> Trimesh:
    """125 mm-class gun with thermal sleeve, bore evacuator and muzzle collar, inclined upwards."""
    length = (_MUZZLE_X - _TRUNNION[0]) / math.cos(math.radians(_GUN_ELEVATION_DEG))
    profile = [
        (0.0, 0.0), (0.115, 0.0), (0.115, 1.0), (0.092, 1.1), (0.092, 2.55), (0.135, 2.65), (0.135, 3.25),
        (0.088, 3.35), (0.08, length - 0.12), (0.1, length - 0.12), (0.1, length), (0.0, length),
    ]  # fmt: skip
    return barrel(profile, _TRUNNION, _GUN_ELEVATION_DEG)


def s2s1() -> Trimesh:
    """2S1: 7.26 m × 2.85 m, 2.73 m high, howitzer level with the nose; +x nose, +y left, ground at z = 0.

    Centred on the hull in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    sides = [*_s2s1_side(+1), *_s2s1_side(-1)]
    top = [*_s2s1_deck(), *_s2s1_stern(), *_s2s1_turret(), *_s2s1_howitzer()]
    return assembled([*_s2s1_hull(), *sides, *top])


def _s2s1_hull() -> list[Trimesh]:
    tub = [(3.63, 0.98), (3.50, 0.86), (2.75, 0.42), (-3.15, 0.42), (-3.50, 0.60), (-3.50, 1.20), (3.35, 1.08)]
    # Above the tracks the hull is as wide as they are, behind a long sloping bow.
    upper = mirrored(
        (3.63, 1.05, 0.98), (3.55, 1.15, 1.04), (3.05, 1.40, 1.06), (2.62, 1.40, 0.98), (-3.30, 1.40, 0.98),
        (-3.55, 1.32, 1.10), (1.75, 1.30, 1.62), (-3.45, 1.28, 1.62),
    )  # fmt: skip
    return [prism(tub, (-1.0, 1.0)), upper]


def _s2s1_side(side: int) -> list[Trimesh]:
    """Running gear and fender of the left (+1) or right (−1) side: the sprocket is in front, the idler behind."""
    radius, thickness = 0.335, 0.04
    road = [(x, radius + thickness, radius) for x in (2.30 - 0.79 * k for k in range(7))]
    sprocket, idler = (3.02, 0.60, 0.24), (-3.12, 0.56, 0.25)
    track = belt([*road, sprocket, idler], thickness, (side * 1.025, side * 1.425))
    wheels = [wheel(x, (side * 1.07, side * 1.39), r, rim=0.62, z=z) for x, z, r in [*road, sprocket, idler]]
    guard = [(3.05, 1.02), (3.42, 0.86), (3.42, 0.82), (3.05, 0.98)]
    mudguard = hull([(x, side * y, z) for y in (1.02, 1.41) for x, z in guard])
    rear_flap = box((-3.60, -3.50), (side * 1.02, side * 1.41), (0.72, 1.02))
    return [track, *wheels, mudguard, rear_flap]


def _s2s1_deck() -> list[Trimesh]:
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


def _s2s1_stern() -> list[Trimesh]:
    door = box((-3.58, -3.45), (-0.42, 0.42), (0.80, 1.52))
    boxes = [box((-3.63, -3.45), (y - 0.25, y + 0.25), (1.05, 1.45)) for y in (-0.92, 0.92)]
    hooks = [box((-3.60, -3.3), (y - 0.06, y + 0.06), (0.62, 0.76)) for y in (-0.75, 0.75)]
    return [door, *boxes, *hooks]


def _s2s1_turret() -> list[Trimesh]:
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


def _s2s1_howitzer() -> list[Trimesh]:
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
