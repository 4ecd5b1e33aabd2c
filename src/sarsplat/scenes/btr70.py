"""A BTR-70 armoured personnel carrier of true dimensions, from simple closed bodies that may intersect."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sarsplat.scenes._shapes import assembled, barrel, box, cylinder, hull, mirrored, prism, revolved, wheel

if TYPE_CHECKING:
    import trimesh

AXLES_X = (2.28, 0.90, -0.75, -2.12)
"""The gap between the second and the third axle is wider: the side doors are there."""

_TURRET_X = 0.72


def btr70() -> trimesh.Trimesh:
    """BTR-70: 7.54 m × 2.80 m, 2.24 m high, eight wheels of 1.12 m; +x nose, +y left, ground at z = 0.

    Centred on the hull in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    return assembled([*_hull(), *_sides(+1), *_sides(-1), *_roof(), *_stern(), *_turret()])


def _hull() -> list[trimesh.Trimesh]:
    # Boat-shaped: narrow between the wheels, widest along a belt line just above them, and drawn in above it.
    boat = mirrored(
        (3.77, 0.95, 1.12), (3.70, 0.92, 0.98), (2.75, 0.85, 0.50), (-3.05, 0.85, 0.475), (-3.77, 0.98, 1.15),
        (3.0, 1.0, 1.15), (-3.2, 1.0, 1.15),
    )  # fmt: skip
    lower_deck = mirrored(
        (3.77, 0.95, 1.12), (2.80, 1.35, 1.10), (-3.10, 1.40, 1.10), (-3.77, 1.15, 1.14),
        (2.45, 1.40, 1.10), (2.45, 1.10, 1.48), (-3.10, 1.12, 1.48), (-3.70, 1.00, 1.30),
    )  # fmt: skip
    upper = mirrored((2.62, 1.02, 1.42), (2.20, 0.88, 1.79), (-0.95, 0.90, 1.82), (-0.95, 1.18, 1.40))
    engine = mirrored(
        (-0.95, 0.90, 1.80), (-0.95, 1.18, 1.40), (-3.05, 0.88, 1.72), (-3.05, 1.14, 1.40), (-3.66, 0.98, 1.32)
    )
    trim_vane = mirrored((3.75, 0.88, 1.00), (3.75, 0.88, 1.06), (3.25, 0.85, 0.68), (3.25, 0.85, 0.74))
    return [boat, lower_deck, upper, engine, trim_vane]


def _sides(side: int) -> list[trimesh.Trimesh]:
    """Wheels, door and everything else along the left (+1) or right (−1) side."""
    wheels = [wheel(x, (side * 1.03, side * 1.37), 0.56, rim=0.5) for x in AXLES_X]
    stubs = [cylinder(0.14, (x, side * 0.8, 0.56), (x, side * 1.1, 0.56), sections=12) for x in AXLES_X]
    # Between the second and the third wheel the side comes down, with the lower half of the door.
    wall = hull(
        [(x, side * y, z) for x in (-0.16, 0.31) for y, z in ((0.8, 0.55), (1.30, 0.62), (1.39, 1.12), (0.8, 1.12))]
    )
    door = prism([(-0.12, 0.62), (0.27, 0.62), (0.27, 1.1), (-0.12, 1.1)], (side * 1.2, side * 1.40))
    splash_rail = box((-3.1, 2.6), (side * 1.33, side * 1.40), (1.10, 1.16))
    lamp = cylinder(0.10, (3.02, side * 0.98, 1.44), (3.16, side * 0.98, 1.42), sections=16)
    lamp_guard = box((2.98, 3.02), (side * 0.84, side * 1.12), (1.25, 1.56))
    # The silencers lie along the rear deck, one on either side.
    silencer = cylinder(0.15, (-1.75, side * 1.10, 1.60), (-3.05, side * 1.10, 1.56), sections=20)
    tail_pipe = cylinder(0.07, (-3.0, side * 1.10, 1.56), (-3.42, side * 1.10, 1.55), sections=12)
    ports = [cylinder(0.10, (x, side * 0.95, 1.62), (x, side * 1.09, 1.66), sections=12) for x in (1.65, -0.1, -0.65)]
    return [*wheels, *stubs, wall, door, splash_rail, lamp, lamp_guard, silencer, tail_pipe, *ports]


def _roof() -> list[trimesh.Trimesh]:
    # Two windscreens under raised shutters, hatches of driver and commander, a row of periscopes, troop hatches.
    shutter = [(2.53, 1.54), (2.60, 1.58), (2.27, 1.78), (2.34, 1.82)]
    shutters = [hull([(x, y, z) for y in (c - 0.24, c + 0.24) for x, z in shutter]) for c in (-0.48, 0.48)]
    hatches = [cylinder(0.27, (1.78, y, 1.76), (1.78, y, 1.84)) for y in (-0.48, 0.48)]
    troop_hatches = [box((-0.72, -0.12), (y - 0.28, y + 0.28), (1.78, 1.85)) for y in (-0.45, 0.45)]
    periscopes = [
        box((2.06, 2.16), (y - 0.07, y + 0.07), (1.76, 1.90)) for y in (-0.72, -0.48, -0.24, 0.24, 0.48, 0.72)
    ]
    searchlight = cylinder(0.10, (1.95, -0.74, 1.88), (2.08, -0.74, 1.88), sections=16)
    grilles = [box((x, x + 0.62), (-0.72, 0.72), (1.70, 1.83)) for x in (-1.85, -2.68)]
    return [*shutters, *hatches, *troop_hatches, *periscopes, searchlight, *grilles]


def _stern() -> list[trimesh.Trimesh]:
    """Outlet of the water jet with its two-part cover, tow hooks, tail lamps."""
    jet = cylinder(0.26, (-3.2, 0.0, 0.84), (-3.66, 0.0, 0.84))
    hooks = [box((-3.70, -3.4), (y - 0.06, y + 0.06), (0.86, 1.02)) for y in (-0.78, 0.78)]
    lamps = [box((-3.76, -3.6), (y - 0.08, y + 0.08), (1.22, 1.34)) for y in (-0.92, 0.92)]
    return [jet, *hooks, *lamps]


def _turret() -> list[trimesh.Trimesh]:
    """Truncated cone with a 14.5 mm gun and, on its left, a rifle-calibre one."""
    cone = revolved([(0.0, 1.75), (0.74, 1.75), (0.72, 1.84), (0.47, 2.16), (0.40, 2.18), (0.0, 2.18)])
    cone.apply_translation((_TURRET_X, 0.0, 0.0))
    mantlet = box((_TURRET_X + 0.30, _TURRET_X + 0.78), (-0.17, 0.22), (1.90, 2.10))
    profile = [
        (0.0, 0.0), (0.062, 0.0), (0.062, 0.75), (0.036, 0.80), (0.036, 1.45), (0.05, 1.47), (0.05, 1.60), (0.0, 1.60)
    ]  # fmt: skip
    second_profile = [(0.0, 0.0), (0.035, 0.0), (0.035, 0.70), (0.0, 0.70)]
    gun = barrel(profile, (_TURRET_X + 0.5, -0.04, 2.0), elevation_deg=2.0, sections=16)
    second = barrel(second_profile, (_TURRET_X + 0.5, 0.14, 2.0), elevation_deg=2.0, sections=12)
    sight = box((_TURRET_X + 0.18, _TURRET_X + 0.36), (0.20, 0.36), (2.10, 2.24))
    return [cone, mantlet, gun, second, sight]
