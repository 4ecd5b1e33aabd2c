"""What is refused of scenes and of simulations, each in one sentence."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made import slope
from refusals import Do, Refusals, check_refused, stored
from sarsplat import ImageGrid, Mechanisms, ScatteringLaw, Stack, View, simulate_images
from sarsplat.geometry.responses import TAYLOR
from sarsplat.scenes import add_speckle, load_mesh, simulate_raycast, simulate_stack, surface_gaussians, target_mesh
from sarsplat.scenes.meshes import scaled
from sarsplat.scenes.raycast import raycast_mask
from sarsplat.scenes.scattering import part_reflectivity

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

VIEW, GRID, LAW = View(0, 45), ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3)), ScatteringLaw(1.0, 0.0)
BOX = trimesh.creation.box((2.0, 2.0, 1.0))


# ---- meshes ----
def mesh(name: str, text: str) -> Do:
    return stored(text.encode(), load_mesh, name)


CORNERS = "v 0 0 0\nv 2 0 0\nv 2 2 0\n"
SQUARE = CORNERS + "v 0 2 0\n"
MESHES: Refusals = [
    (mesh("points.obj", SQUARE), r"points.obj' .*holds no faces"),
    (mesh("text.stl", "this is not a mesh"), "holds no faces"),
    (mesh("table.csv", "1,2,3"), r"table.csv' is not in a supported mesh format; give an .obj"),
    (mesh("flat.obj", SQUARE + "f 1 1 2\n"), "none of the 1 faces"),
    (mesh("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "none of the 1 faces"),
    (lambda at: load_mesh(at / "nowhere.obj"), r"there is no mesh file at '.*nowhere\.obj'"),
    (mesh("a.stl", "\0" * 80 + "\x07\0\0\0" + "\0" * 100), "is damaged"),
    (mesh("a.stl", "solid\nendsolid\n" * 2000), "2000 solids"),
    (mesh("a.obj", CORNERS + "f -4 -2 -1\n"), "refer to missing vertices"),
    (mesh("a.obj", CORNERS + "f 1 2 9\n"), "cannot be read"),
    (mesh("a.obj", "v 0 0 0\nv 2 0 0\nv 2 1e300 0\nf 1 2 3\n"), r"1e\+300 m from the origin"),
    (mesh("a.obj", CORNERS + "f 1 2 three\n"), "cannot be read"),
    *(
        (lambda _, factor=factor: scaled(BOX, factor), rf"scale. is {factor}; give a number above 0")
        for factor in (0.0, math.nan, math.inf)
    ),
    (lambda _: target_mesh("t73"), r"'t73'.*t72, btr70, 2s1, kraz, slicy, building-a, building-b, building-c"),
    (lambda _: surface_gaussians(BOX, 0), "size is 0"),
    (lambda _: surface_gaussians(trimesh.Trimesh(), 0.1), "area in m² is 0"),
    (lambda _: surface_gaussians(trimesh.creation.box((7000, 3600, 2000)), 0.1), "if it is in millimetres"),
]


# ---- how they scatter ----
def mechanisms(**settings: Any) -> Do:
    return lambda _: Mechanisms(**{"of_faces": np.zeros(12, np.int64), **settings})


NEGATIVE, DIFFERENT = np.diag([1.0, -1.0, 1.0]).astype(complex), "; give different ones of HH, HV"
LAWS: Refusals = [
    *(
        (lambda _, name=name, value=value: ScatteringLaw(**{name: value}), name)
        for name, value in (("floor", -0.1), ("lobe", math.nan), ("lobe", math.inf), ("exponent", -1.0))
    ),
    (lambda _: part_reflectivity(BOX, -1, seed=1), "dB is -1"),
    *(
        (
            lambda _, looks=looks: add_speckle(np.ones((2, 2)), looks, np.random.default_rng(0)),
            f"looks. is {looks}; give a number above 0",
        )
        for looks in (0, math.nan)
    ),
    (mechanisms(of_faces=np.array([0, 3])), "from 0 to 3; give a whole number for each facet, 0 to 2"),
    (mechanisms(of_ground=-1), "from -1 to 0; give"),
    (mechanisms(matrices=np.eye(2)[None] + 0j), r"matrices has shape \(1, 2, 2\); for 3 polarisations give"),
    (mechanisms(matrices=NEGATIVE[None]), "give Hermitian"),
    (mechanisms(matrices=np.full((1, 3, 3), np.inf + 0j)), "give Hermitian"),
    (mechanisms(of_faces=np.array([0.5, 1.7])), "of_faces is float64 of shape .2,., .*; give a whole number for each"),
    (mechanisms(of_ground=1.5), "of_ground is 1.5; give a whole number"),
    (mechanisms(polarisations=("HH", "HH", "VV")), "polarisations is .*" + DIFFERENT),
    (mechanisms(polarisations="HV"), "polarisations is a single one, 'HV'; put it into a list"),
]


# ---- simulations ----
def cast(mesh: Any = BOX, **settings: Any) -> Do:
    return lambda _: simulate_raycast(mesh, VIEW, GRID, LAW, **settings)


def images(mesh: Any = BOX, grid: ImageGrid = GRID, **settings: Any) -> Do:
    return lambda _: simulate_images(mesh, [VIEW], grid, **settings)


PASSES = Stack(0.031, (0.0, 0.0004, 0.001))


def stack(of: Stack = PASSES, **settings: Any) -> Do:
    return lambda _: simulate_stack(BOX, VIEW, GRID, of, LAW, **settings)


BROKEN = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, math.nan, 0]], [[0, 1, 2]], process=False)
BUILDING = target_mesh("building-a")
PAIR = Stack(0.031, (0.0, 0.0), polarisations=("HH", "VV"))
FULL = Stack(0.031, (0.0,) * 3, polarisations=("HH", "HV", "VV"))
SIMULATIONS: Refusals = [
    (cast(ray_spacing=0.0), "ray_spacing. is 0.0; give a number above 0"),
    (cast(ray_offset=(math.nan, 0.0)), r"ray_offset \(nan, 0.0\) must be two finite numbers"),
    (cast(oversample=0), "oversample is 0"),
    (cast(oversample=2.5), "oversample is 2.5; give a whole number"),
    (cast(oversample=1), "too fine for image nodes"),
    (cast(ground_gamma0=-10.0), "ground_gamma0. is -10.0; give a linear"),
    (cast(BROKEN), "has a vertex that is not finite"),
    (cast(terrain=slope(0.0)), "terrain needs the γ⁰"),
    *(
        (simulation(bounces=bounces, ground_gamma0=gamma0, ground_reflectivity=mirror, **more), words)
        for bounces, gamma0, mirror, more, words in (
            (3, None, None, {}, "bounces. is 3"),
            (1, 0.1, 0.5, {}, "ground_reflectivity. is 0.5; give .* and only then"),
            (2, None, 0.5, {}, "ground_reflectivity. is 0.5; give .* and only then"),
            (2, 0.1, None, {}, "ground_reflectivity. is None"),
            (2, 0.1, 1.5, {}, "ground_reflectivity. is 1.5"),
            (2, 0.1, math.nan, {}, "ground_reflectivity. is nan"),
            (2, 0.1, 1, {"terrain": slope(0.0)}, "need flat ground"),
        )
        for simulation in (cast, images)
    ),
    (images(source="splat", bounces=2), "need ground that reflects"),
    (lambda _: raycast_mask(trimesh.Trimesh(), VIEW, GRID), "0 faces"),
    (images(BUILDING, reflectivity=np.ones(9)), r"shape \(9,\).*10 faces"),
    (images(BUILDING, reflectivity=np.full(10, -1.0)), "outside 0 to"),
    (images(BUILDING, reflectivity=np.full(10, np.nan)), "outside 0 to"),
    (images(grid=replace(GRID, response=TAYLOR), source="splat"), "response is Taylor.* choose .source='raycast'"),
    (images(source="splat", ray_spacing=0.1), "leave it out"),
    (images(source="magic"), "source is 'magic'; give one of 'raycast', 'splat'"),
    (stack(noise=1e300), r"noise. is 1e\+300; .* at most 1e\+18"),
    (stack(spacing_m=0.0), "ray_spacing. is 0.0"),
    (stack(seed=-1), "seed. is -1"),
    (stack(PAIR), "are None, but the stack needs .12, 'HH', 'VV'."),
    *(
        (
            stack(of, mechanisms=Mechanisms(np.zeros(faces, np.int64))),
            rf"are .{faces}, 'HH', 'HV', 'VV'., but the stack needs .12, ",
        )
        for of, faces in ((PAIR, 12), (FULL, 5))
    ),
]


@pytest.mark.parametrize(("do", "words"), [*MESHES, *LAWS, *SIMULATIONS])
def test_what_is_refused_in_a_sentence(tmp_path: Path, do: Do, words: str) -> None:
    check_refused(tmp_path, do, words)
