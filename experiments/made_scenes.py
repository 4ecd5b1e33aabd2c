"""Scenes of several objects that experiments simulate: their meshes, and files of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import trimesh
from experiment import Options

from sarsplat import Terrain, target_mesh
from sarsplat.data import write_terrain
from sarsplat.data.mesh import write_mesh
from sarsplat.scenes.village import village


def _placed(mesh: trimesh.Trimesh, x: float, y: float, turn_deg: float = 0.0) -> trimesh.Trimesh:
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn_deg), (0, 0, 1)))
    mesh.apply_translation((x, y, 0))
    return mesh


def _box(width: float, depth: float, height: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((width, depth, height))
    mesh.apply_translation((0, 0, height / 2))
    return mesh


def _vault(width: float, length: float, wall: float, rise: float) -> trimesh.Trimesh:
    """A barrel vault on walls."""
    angle = np.linspace(0, np.pi, 25)
    x, z = (
        np.append(-width / 2 * np.cos(angle), [-width / 2, width / 2]),
        np.append(wall + rise * np.sin(angle), [0, 0]),
    )
    ends = [np.column_stack([x, np.full_like(x, y), z]) for y in (-length / 2, length / 2)]
    return trimesh.convex.convex_hull(np.concatenate(ends))


def _tank(radius: float, height: float) -> trimesh.Trimesh:
    """An upright tank with a domed roof."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rings = [(radius * np.cos(a), height * (1 + np.sin(a) / 4)) for a in np.linspace(0, np.pi / 2, 9)]
    points = [(r * np.cos(a), r * np.sin(a), z) for r, z in [(radius, 0.0), *rings] for a in angle]
    return trimesh.convex.convex_hull(np.array(points))


def _vehicles() -> list[trimesh.Trimesh]:
    parked = {"t72": (-6.0, -5.0, 20.0), "btr70": (6.0, -3.0, 110.0), "kraz": (0.0, 7.0, -35.0)}
    return [_placed(target_mesh(name), *place) for name, place in parked.items()]


def _street() -> list[trimesh.Trimesh]:
    chance, parts = np.random.default_rng(3), []
    for x in (-20.0, 0.0, 20.0):
        for side in (-1, 1):
            parts.append(_placed(_box(*chance.uniform((7, 7, 3), (12, 11, 8))), x, side * 17, chance.normal(0, 6)))
    names = ("t72", "btr70", "kraz", "2s1")
    return parts + [_placed(target_mesh(name), 14.0 * k - 21, (-1) ** k * 4, 10 * k) for k, name in enumerate(names)]


def _depot() -> list[trimesh.Trimesh]:
    halls = [_placed(_vault(12, 18, 3, 4), -13, 2, 15), _placed(_vault(9, 14, 2.5, 3), 10, 9, -40)]
    return [*halls, _placed(_tank(5, 7), 9, -9), _placed(target_mesh("kraz"), -4, -16, 30)]


def _hangars() -> list[trimesh.Trimesh]:
    return [
        _placed(_vault(24, 36, 5, 6), -16, 6, 12),
        _placed(_vault(17, 25, 4, 5), 19, 12, -28),
        _placed(_vault(12, 14, 3, 3), 16, -22, 60),
    ]


def _refinery() -> list[trimesh.Trimesh]:
    tanks = [_placed(_tank(10, 9), -18, 8), _placed(_tank(7, 12), 8, 16), _placed(_tank(5, 6), 20, -4)]
    pipes = [(-26.0, -12.0, 26.0, -12.0), (-26.0, -15.0, 26.0, -15.0), (8.0, -12.0, 8.0, 9.0)]
    return tanks + [trimesh.creation.cylinder(0.6, segment=[(x, y, 2.0), (u, v, 2.0)]) for x, y, u, v in pipes]


def _ship() -> list[trimesh.Trimesh]:
    """A flared hull, its superstructure, a funnel and two masts."""
    along = np.linspace(-30, 30, 25)
    beam = np.where(along < 8, 1.0, np.sqrt(np.maximum(1 - ((along - 8) / 22) ** 2, 0)))
    sides = [
        (along, sign * half * beam, np.full_like(along, z)) for half, z in ((4.0, 0.0), (5.5, 5.0)) for sign in (-1, 1)
    ]
    hull = trimesh.convex.convex_hull(np.concatenate([np.column_stack(side) for side in sides]))
    decks = [_placed(_box(14, 8, 9), -14, 0), _placed(_box(9, 6, 12), -13, 0)]
    round_parts = [(1.5, 14.0, -19.0), (0.25, 18.0, -9.0), (0.25, 13.0, 18.0)]
    return [hull, *decks] + [_placed(_column(radius, height), x, 0) for radius, height, x in round_parts]


def _column(radius: float, height: float) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, segment=[(0, 0, 0), (0, 0, height)])


def _courtyard() -> list[trimesh.Trimesh]:
    blocks = [(44, 10, 18, 0, 20), (44, 10, 15, 0, -20), (10, 30, 21, -17, 0), (10, 30, 12, 17, 0)]
    return [_placed(_box(width, depth, height), x, y) for width, depth, height, x, y in blocks]


def _trees() -> list[trimesh.Trimesh]:
    chance, parts = np.random.default_rng(5), []
    for x in range(-24, 25, 12):
        for y in range(-24, 25, 12):
            across, rise = chance.uniform(2, 4.5), chance.uniform(2, 5)
            crown = trimesh.creation.icosphere(3)
            crown.apply_scale((across, across, rise))
            crown.apply_translation((0, 0, 1.5 + rise))
            parts += [_placed(one, x + chance.normal(0, 1), y) for one in (crown, _column(0.3, 2.5))]
    return parts


def _flat_roofs() -> list[trimesh.Trimesh]:
    chance, parts = np.random.default_rng(7), []
    for x in range(-70, 71, 28):
        for y in range(-70, 71, 35):
            size = chance.uniform((9, 9, 3), (20, 24, 14))
            parts.append(_placed(_box(*size), x, y, chance.uniform(-30, 30)))
    return parts


SCENES: dict[str, tuple[int, Callable[[], Sequence[trimesh.Trimesh]]]] = {
    "T-72": (128, lambda: [target_mesh("t72")]),
    "three vehicles": (128, _vehicles),
    "vaulted halls, a tank, a truck": (192, _depot),
    "a street of boxes and vehicles": (224, _street),
    "a village": (192, lambda: [village(37.0, 4)]),
    "domed tanks and pipes": (352, _refinery),
    "vaulted hangars": (352, _hangars),
    "a ship": (352, _ship),
    "a courtyard of tall blocks": (352, _courtyard),
    "trees": (352, _trees),
    "flat roofs": (640, _flat_roofs),
}
"""Side of the images in pixels of 0.3 m, and meshes."""


def hills(half_m: float = 60.0, pitch_m: float = 0.5) -> Terrain:
    """Level ground around the origin, two hills and a slope that begins 11 m from it."""
    x, y = np.meshgrid(*2 * [np.arange(-half_m, half_m + pitch_m / 2, pitch_m)])
    heights = 0.2 * np.clip(x + y / 2 - 11, 0, 12)
    for peak_m, x0, y0, width_m in ((2.5, -8.0, 10.0, 2.0), (1.5, 7.0, -11.0, 2.5)):
        heights += peak_m * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width_m**2))
    return Terrain(heights - heights[len(y) // 2, len(x) // 2], (pitch_m, pitch_m))


def written(options: Options, folder: Path) -> Options:
    """Options with the files of their scene and terrain, which are written."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {"mesh": folder / f"{options['scene']}.ply"}
    write_mesh(files["mesh"], cast(trimesh.Trimesh, trimesh.util.concatenate(SCENES[options["scene"]][1]())))
    if options.get("hills"):
        files["terrain"] = folder / "hills.tif"
        write_terrain(files["terrain"], hills())
    return {**files, **{name: value for name, value in options.items() if name not in ("scene", "hills")}}
