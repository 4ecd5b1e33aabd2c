"""Wheeled vehicles of true dimensions, a BTR-70 and a KrAZ-255B, from simple closed bodies that may intersect."""

from sarsplat.extras import Trimesh
from sarsplat.scenes._shapes import assembled, barrel, box, cylinder, hull, mirrored, prism, revolved, strip, wheel

_BTR70_AXLES_X = (2.28, 0.90, -0.75, -2.12)
"""The gap between the second and the third axle is wider: the side doors are there."""

_TURRET_X = 0.72


def btr70() -> Trimesh:
    """BTR-70: 7.54 m × 2.80 m, 2.24 m high, eight wheels of 1.12 m; +x nose, +y left, ground at z = 0.

    Centred on the hull in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    return assembled(
        [*_btr70_hull(), *_btr70_sides(+1), *_btr70_sides(-1), *_btr70_roof(), *_btr70_stern(), *_btr70_turret()]
    )


def _btr70_hull() -> list[Trimesh]:
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


def _btr70_sides(side: int) -> list[Trimesh]:
    """Wheels, door and everything else along the left (+1) or right (−1) side."""
    wheels = [wheel(x, (side * 1.03, side * 1.37), 0.56, rim=0.5) for x in _BTR70_AXLES_X]
    stubs = [cylinder(0.14, (x, side * 0.8, 0.56), (x, side * 1.1, 0.56), sections=12) for x in _BTR70_AXLES_X]
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


def _btr70_roof() -> list[Trimesh]:
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


def _btr70_stern() -> list[Trimesh]:
    """Outlet of the water jet with its two-part cover, tow hooks, tail lamps."""
    jet = cylinder(0.26, (-3.2, 0.0, 0.84), (-3.66, 0.0, 0.84))
    hooks = [box((-3.70, -3.4), (y - 0.06, y + 0.06), (0.86, 1.02)) for y in (-0.78, 0.78)]
    lamps = [box((-3.76, -3.6), (y - 0.08, y + 0.08), (1.22, 1.34)) for y in (-0.92, 0.92)]
    return [jet, *hooks, *lamps]


def _btr70_turret() -> list[Trimesh]:
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


_KRAZ_AXLES_X = (3.30, -1.30, -2.70)  # wheelbase 4.6 m, bogie 1.4 m; single wide tyres of 1.30 m all round

_BED = (-4.32, 0.24)
_FLOOR, _BOARDS = 1.60, 2.42


def kraz() -> Trimesh:
    """KrAZ-255B: 8.65 m × 2.75 m, 2.94 m high at the cab, six wheels; +x nose, +y left, ground at z = 0.

    Centred in x and y. Written from published overall dimensions; details are plausible, not surveyed.
    """
    return assembled([*_kraz_chassis(), *_kraz_side(+1), *_kraz_side(-1), *_kraz_bonnet(), *_kraz_cab(), *_kraz_bed()])


def _kraz_chassis() -> list[Trimesh]:
    rails = [box((-4.15, 4.05), (y - 0.06, y + 0.06), (0.98, 1.24)) for y in (-0.45, 0.45)]
    axles = [cylinder(0.11, (x, -0.95, 0.65), (x, 0.95, 0.65), sections=16) for x in _KRAZ_AXLES_X]
    corners = [(dx, dy, dz) for dx in (-0.26, 0.26) for dy in (-0.24, 0.24) for dz in (-0.2, 0.2)]
    differentials = [hull([(x + dx, dy, 0.65 + dz) for dx, dy, dz in corners]) for x in _KRAZ_AXLES_X]
    gearbox = box((0.2, 1.3), (-0.30, 0.30), (0.70, 1.10))
    bumper = box((4.18, 4.325), (-1.25, 1.25), (0.92, 1.20))
    hooks = [box((4.05, 4.30), (y - 0.06, y + 0.06), (1.18, 1.32)) for y in (-0.5, 0.5)]
    crossbar = box((-4.20, -4.08), (-0.9, 0.9), (0.95, 1.20))
    tow_hook = cylinder(0.08, (-4.30, 0.0, 1.08), (-4.10, 0.0, 1.08), sections=12)
    spare = wheel(0.0, (-0.26, 0.26), 0.62, rim=0.5)  # upright behind the cab, its axis along the vehicle
    spare.vertices = spare.vertices[:, [1, 0, 2]] * (1, -1, 1) + (0.50, 0.45, 1.26)
    rack = box((0.28, 0.72), (-1.0, 1.1), (1.20, 1.28))
    air_filter = cylinder(0.20, (0.52, -0.65, 1.28), (0.52, -0.65, 2.10), sections=16)
    return [*rails, *axles, *differentials, gearbox, bumper, *hooks, crossbar, tow_hook, spare, rack, air_filter]


def _kraz_side(side: int) -> list[Trimesh]:
    """Wheels, front wing, step and tank of the left (+1) or right (−1) side."""
    wheels = [wheel(x, (side * 0.815, side * 1.345), 0.65, rim=0.48) for x in _KRAZ_AXLES_X]
    # The wing rises from the bumper, runs flat over the wheel and falls to the step below the cab's door.
    path = [(4.20, 1.20), (4.05, 1.42), (3.72, 1.55), (2.95, 1.55), (2.55, 1.36), (2.25, 1.02)]
    wing = strip(path, 0.05, (side * 0.62, side * 1.36))
    step = box((0.95, 2.28), (side * 0.85, side * 1.30), (0.90, 0.98))
    section = [(0.62, 0.72), (0.62, 1.30), (1.22, 0.78), (1.28, 0.9), (1.28, 1.2), (1.22, 1.30)]
    tank = hull([(x, side * y, z) for x in (-0.25, 0.92) for y, z in section])
    lamp = cylinder(0.14, (3.92, side * 0.98, 1.66), (4.10, side * 0.98, 1.66), sections=20)
    lamp_post = box((3.96, 4.02), (side * 0.94, side * 1.02), (1.40, 1.56))
    mirror = box((2.02, 2.06), (side * 1.22, side * 1.36), (2.15, 2.48))
    mirror_arm = box((2.02, 2.05), (side * 1.0, side * 1.3), (2.3, 2.33))
    return [*wheels, *wing, step, tank, lamp, lamp_post, mirror, mirror_arm]


def _kraz_bonnet() -> list[Trimesh]:
    """Long, narrowing to the radiator, its top falling a little forwards."""
    hood = mirrored(
        (2.15, 0.72, 1.20), (2.15, 0.72, 1.98), (2.15, 0.58, 2.12), (4.02, 0.52, 1.20), (4.02, 0.52, 1.86),
        (4.02, 0.42, 1.98),
    )  # fmt: skip
    frame = [
        box((4.0, 4.08), (-0.56, 0.56), (1.84, 1.99)),
        box((4.0, 4.08), (-0.56, 0.56), (1.14, 1.24)),
        *(box((4.0, 4.08), (side * 0.46, side * 0.56), (1.14, 1.99)) for side in (-1, 1)),
    ]
    bars = [box((4.02, 4.06), (y - 0.02, y + 0.02), (1.2, 1.86)) for y in (-0.36, -0.24, -0.12, 0.0, 0.12, 0.24, 0.36)]
    return [hood, *frame, *bars]


def _kraz_cab() -> list[Trimesh]:
    """Lower half, pillars and roof, so that the windows are open."""
    rear, front, belt = 0.82, 2.20, 2.06
    body = prism([(rear, 1.05), (front, 1.05), (front, belt), (rear, belt)], (-1.16, 1.16))
    doors = [box((1.12, 2.10), (side * 1.15, side * 1.18), (1.10, belt)) for side in (-1, 1)]
    back = box((rear, rear + 0.06), (-1.12, 1.12), (belt, 2.85))
    ends = [(front - 0.08, 1.06, belt), (front - 0.22, 1.0, 2.84)]
    corners = [(x + dx, y + dy, z) for x, y, z in ends for dx in (0.0, 0.08) for dy in (0.0, 0.08)]
    pillars = [hull([(x, side * y, z) for x, y, z in corners]) for side in (-1, 1)]
    pillars += [box((x, x + 0.10), (side * 1.02, side * 1.12), (belt, 2.84)) for side in (-1, 1) for x in (rear, 1.08)]
    pillars.append(box((front - 0.17, front - 0.10), (-0.03, 0.03), (belt, 2.84)))
    roof = mirrored(
        (rear, 1.14, 2.78), (rear + 0.05, 0.98, 2.94), (front - 0.10, 1.10, 2.76), (front - 0.22, 0.95, 2.93),
        (rear, 1.14, 2.70), (front - 0.10, 1.10, 2.70),
    )  # fmt: skip
    return [body, *doors, back, *pillars, roof]


def _kraz_bed() -> list[Trimesh]:
    """Flat floor on cross bearers, slatted boards all round and a solid tailboard."""
    rear, front = _BED
    floor = box(_BED, (-1.33, 1.33), (_FLOOR - 0.10, _FLOOR))
    bearers = [box((x - 0.06, x + 0.06), (-1.25, 1.25), (1.24, 1.52)) for x in (-3.9, -3.0, -2.0, -1.0, -0.1)]
    rails = [(_FLOOR + 0.02, _FLOOR + 0.40), (_FLOOR + 0.44, _FLOOR + 0.58), (_BOARDS - 0.16, _BOARDS)]
    boards = [box(_BED, (side * 1.325, side * 1.365), z) for side in (-1, 1) for z in rails]
    places = [(x, side) for side in (-1, 1) for x in (-4.2, -3.3, -2.4, -1.5, -0.6, 0.15)]
    posts = [box((x - 0.05, x + 0.05), (side * 1.31, side * 1.375), (1.48, _BOARDS)) for x, side in places]
    front_end = box((front - 0.05, front), (-1.33, 1.33), (_FLOOR, _BOARDS))
    tailboard = box((rear, rear + 0.05), (-1.33, 1.33), (_FLOOR, _FLOOR + 0.62))
    bench = (rear + 0.2, front - 0.2)
    benches = [box(bench, (side * 0.95, side * 1.30), (_FLOOR + 0.42, _FLOOR + 0.46)) for side in (-1, 1)]
    return [floor, *bearers, *boards, *posts, front_end, tailboard, *benches]
