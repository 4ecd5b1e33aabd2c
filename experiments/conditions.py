"""Real conditions: speckle on ground, several objects, few views; settings chosen by the images, and two presets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from experiment import Experiment, Options, Row

from sarsplat import Terrain, target_mesh
from sarsplat.data import write_terrain
from sarsplat.data.mesh import write_mesh
from sarsplat.scenes.village import village

POINTS = ("cd_m", "accuracy_m", "completeness_m", "f1@0.3", "f1@0.1", "psnr_target_db", "time_s")
ALL_AROUND: Options = {"azimuth": ("0:360:30",), "grazing": ("35", "50"), "test_azimuth": ("15:360:60",)}
CONDITIONS: dict[str, Options] = {
    "1 look": {**ALL_AROUND, "looks": 1},
    "4 looks": {**ALL_AROUND, "looks": 4},
    "16 looks": {**ALL_AROUND, "looks": 16},
    "12 views": {**ALL_AROUND, "azimuth": ("0:360:60",), "looks": 1},
    "120° of azimuth": {**ALL_AROUND, "azimuth": ("-60:61:10",), "test_azimuth": ("-55:60:22",), "looks": 1},
    "between hills": {**ALL_AROUND, "looks": 1, "hills": True},
}
"""Views and looks; ground of γ⁰ = 0.05."""


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


SCENES: dict[str, tuple[int, Callable[[], Sequence[trimesh.Trimesh]]]] = {
    "T-72": (128, lambda: [target_mesh("t72")]),
    "three vehicles": (128, _vehicles),
    "vaulted halls, a tank, a truck": (192, _depot),
    "a street of boxes and vehicles": (224, _street),
    "a village": (192, lambda: [village(37.0, 4)]),
}
"""Side of the images in pixels of 0.3 m, and meshes."""

COMPARED_PRESETS = ("auto", "speckled", "measured")


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


def _rows() -> tuple[Row, ...]:
    rows = []
    for name, (pixels, _) in SCENES.items():
        for condition, views in CONDITIONS.items():
            if "hills" in views and name != "T-72":  # other objects would be buried
                continue
            options: dict[str, Any] = {"scene": name, **views, "pixels": (pixels,), "ground": 0.05, "clean_tests": True}
            rows += [
                Row(preset, (options,), preset, group=f"{name}, {condition}", random=True)
                for preset in COMPARED_PRESETS
            ]
    return tuple(rows)


CONDITIONS_GRID = Experiment(
    "conditions",
    "Real conditions",
    "Simulated single images of speckled ground of γ⁰ = 0.05, level unless said, with one or more objects, 24 views "
    "(12 azimuths at 35 and 50°; 26 within 120°) unless said, clean test images: settings that `reconstruct` chooses "
    "by the images, beside presets by hand. Points against the visible surface. The paper has no figures for these.",
    _rows(),
    (POINTS,),
    judged=("cd_m", "f1@0.3"),
    contest=True,
    seeds=(0,),
)
