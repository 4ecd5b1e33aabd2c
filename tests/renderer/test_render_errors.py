"""Wrong input is named, with its value and what to do: NaN, infinities, denormals and giants in any of it, too."""

import math
import random
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from emulated_cuda import Emulator, render_on
from named_scenes import GRID, UNUSUAL, VIEWS, Scene, changed, cloud, random_normal
from torch import Tensor

from made import slope, terrain
from refusals import Do, Refusals, check_refused
from sarsplat import MIN_SCALE, Gaussians, Ground, ImageGrid, RayGrid, SarsplatError, Terrain, View
from sarsplat.renderer import Bounds, GroundBounce, project, render
from sarsplat.renderer.engines import cpu
from sarsplat.scenes import ScatteringLaw, simulate_raycast
from sarsplat.tiles import render_tiled

TEN = cloud(10, 0)
NAN, INF = float("nan"), float("inf")
NOWHERE = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, INF]])
WRONG = torch.ones(3, 10, 1)
WRONG[1, 4] = NAN
ONE, PLANE = torch.tensor(1.0), Ground(torch.tensor(0.3), height_m=-0.55)
HILLS = Ground(torch.tensor(0.3), height_m=Terrain(np.zeros((2, 2)), (1.0, 1.0)))
SLOPE = Ground(torch.tensor(0.3), height_m=slope(5.0))
STRETCHED = [View(25.0, 40.0, aloft=True, stretch=1.07)]
WIDE = {"grid": ImageGrid(80_000, 1, (0.2, 5e-5), (0.3, 0.3)), "rays": RayGrid((0.1, 0.1))}
TOO_LONG = terrain(lambda x, y: 3e5 * np.exp(-(x**2) - y**2))


def out(name: str, index: tuple[int, ...], value: float) -> dict[str, Gaussians]:
    return {"gaussians": changed(TEN, name, index, value)}


def with_bounce(*arguments: Tensor) -> dict[str, object]:
    return {"ground": PLANE, "echoes": [GroundBounce(PLANE, *arguments)]}


AUTO, CPU, REFERENCE, BOTH = ("auto",), ("cpu",), ("reference",), ("cpu", "cuda")
PLAIN, ALL = ("cpu", "reference"), ("cpu", "reference", "cuda")
ARGUMENTS: list[tuple[tuple[str, ...], dict[str, object], str]] = [
    (ALL, out("means", (3, 1), NAN), r"means\[3\] is \[.*nan.*\]; it must be finite metres"),
    (ALL, out("quaternions", (4,), 0.0), r"quaternions\[4\] is .* not zero"),
    (ALL, out("quaternions", (4, 2), NAN), r"quaternions\[4\]"),
    (ALL, out("scales", (9, 2), MIN_SCALE / 2), r"scales\[9\] is .* MIN_SCALE = 0.0001"),
    (ALL, out("scales", (3,), 1e10), r"scales\[3\] is .* at most 1e\+06 m"),
    (ALL, out("scales", (9, 0), NAN), r"scales\[9\]"),
    (ALL, out("optical_depth", (2,), 41.0), r"optical_depth\[2\] is 41.0; .* MAX_OPTICAL_DEPTH = 40"),
    (ALL, out("optical_depth", (2,), -0.1), r"optical_depth\[2\]"),
    (ALL, out("scattering", (7, 15), NAN), r"scattering\[7\]"),
    (ALL, {"amplitudes": WRONG}, r"amplitudes\[1, 4\] is \[nan\]"),
    (ALL, {"shift": NOWHERE}, r"shift\[2\] is \[0.0, inf\]; it must be finite metres"),
    (BOTH, out("means", (0, 0), 1e6), r"view 0 would need too many rays .* reach 1e\+06 m .* remove distant"),
    (BOTH, {"rays": RayGrid((1e-5, 1e-5))}, "too many rays at a spacing of"),
    (PLAIN, {"amplitudes": torch.ones(2, 10, 1)}, r"\(2, 10, 1\); .* it must be \(3, 10, C\)"),
    (PLAIN, {"shift": torch.ones(3)}, r"shift has shape \(3,\); .* it must be \(3, 2\)"),
    (PLAIN, {"gain": torch.ones(1)}, r"gain has shape \(1,\); .* it must be \(3,\)"),
    (PLAIN, {"imaging_weight": "round"}, "give one of 'area', 'peak'"),
    *((PLAIN, {"first_return_depth": bad}, "first_return_depth is .*; give a number above 0") for bad in (0.0, NAN)),
    (PLAIN, {"amplitudes": torch.ones(3, 10, 1).to(torch.complex64)}, r"complex64.* sarsplat.splat"),
    (("gpu",), {}, "choose one of auto, cpu, cpu-base, cpu-avx2, cpu-avx512, cuda, reference"),
    (AUTO, {"views": []}, "there are no views"),
    (CPU, {"gaussians": TEN.to(torch.float64)}, "means is torch.float64 on cpu; the CPU engine takes"),
    (CPU, {"gain": torch.ones(3).double()}, "gain is torch.float64"),
    (REFERENCE, {"plane_gradients": True}, r"\(cpu, cpu-base, cpu-avx2, cpu-avx512, cuda\)"),
    (REFERENCE, {"gaussians": cloud(60, 0), "rays": RayGrid((0.001, 0.001))}, "use coarser rays"),
    (AUTO, {"views": UNUSUAL[:1], "ground": SLOPE}, "tilted by 25°, under which only level ground can be rendered"),
    (PLAIN, {"views": STRETCHED, "first_return_depth": 0.5}, "stretched"),
    (CPU, WIDE, "80000 × 1 pixels is too large"),
    (AUTO, {"ground": 0.3}, "an object of the class Ground"),
    (AUTO, {"ground": Ground(torch.ones((), dtype=torch.float64))}, "ground.gamma0 is torch.float64 on cpu but means"),
    (AUTO, {"ground": PLANE, "imaging_weight": "peak"}, "images without a unit"),
    (AUTO, {"ground": Ground(torch.full((2, 2), INF))}, r"ground.gamma0\[0\] is inf"),
    (AUTO, {"ground": Ground(torch.tensor(0.3), height_m=TOO_LONG)}, r"3e\+05 m high; cut it"),
    (AUTO, with_bounce(ONE.double()), "reflectivity is torch.float64 on cpu but means"),
    (AUTO, with_bounce(ONE, torch.ones(2, 10)), "of 2 views, not of 3"),
    (AUTO, with_bounce(ONE * NAN), r"bounce\.reflectivity"),
    (AUTO, with_bounce(ONE, torch.full((3, 10), INF)), r"bounce\.amplitudes"),
]


@pytest.mark.parametrize(
    ("engine", "options", "words"), [(engine, *row) for engines, *row in ARGUMENTS for engine in engines]
)
def test_arguments(engine: str, options: dict[str, object], words: str, request: pytest.FixtureRequest) -> None:
    renderer = partial(render, engine=engine)
    if engine == "cuda":
        renderer = partial(render_on, Emulator(request.getfixturevalue("library")))
    with pytest.raises(SarsplatError, match=words):
        renderer(**{"gaussians": TEN, "views": VIEWS, "grid": GRID} | options)


REFUSED: Refusals = [
    (lambda _: Ground(0.3), "gamma0 is float"),
    (lambda _: Ground(torch.ones(3)), r"gamma0 has shape \(3,\); give one number, or a lattice"),
    (lambda _: Ground(torch.ones(()), 0.0), "pitch_m is 0.0; give a positive"),
    (lambda _: Ground(torch.ones(()), 1.0, NAN), "height_m is nan"),
    (lambda _: Ground(torch.ones(()), exponent=torch.ones(1)), r"exponent has shape \(1,\); give one number$"),
    (lambda _: Terrain(np.zeros((1, 4)), (1.0, 1.0)), r"heights are float64 of shape \(1, 4\)"),
    (lambda _: Terrain(np.where(np.arange(12).reshape(3, 4) == 6, NAN, 0), (1.0, 1.0)), r"height \(1, 2\) is nan"),
    (lambda _: Terrain(np.zeros((3, 4)), (1.0, -1.0)), "two positive"),
    (lambda _: GroundBounce(HILLS, ONE), "off a plane"),
    (lambda _: GroundBounce(PLANE, torch.ones(2)), "of one number"),
    (lambda _: View(torch.tensor(20.0), 30.0), r"azimuth is an object of type Tensor.* turn the means"),
    (lambda _: project(TEN, STRETCHED, GRID), "stretched"),
    (lambda _: render_tiled(TEN, STRETCHED[0], GRID), "stretched"),
    (lambda _: simulate_raycast(trimesh.creation.box(), STRETCHED[0], GRID, ScatteringLaw()), "a view is stretched"),
    *(
        (lambda _, x=x, s=s: Bounds((x, 0.0, 0.0), (0.0, 0.0, 0.0), s, 1.0), "hold no Gaussian")
        for x, s in ((1.0, 0.1), (NAN, 0.1), (0.0, -1.0), (-INF, 0.1))
    ),
]


@pytest.mark.parametrize(("do", "words"), REFUSED)
def test_what_is_refused_in_a_sentence(tmp_path: Path, do: Do, words: str) -> None:
    check_refused(tmp_path, do, words)


def test_limits_themselves_are_allowed():
    scene = changed(TEN, "optical_depth", (2,), 40.0)
    scene.scales[4] = MIN_SCALE
    assert torch.isfinite(render(scene, VIEWS, GRID, engine="cpu").images).all()


def test_engine_works_after_an_error():
    expected = render(TEN, VIEWS, GRID, engine="cpu").images
    with pytest.raises(SarsplatError, match="too many rays"):
        render(changed(TEN, "means", (0, 0), 1e6), VIEWS, GRID, engine="cpu")
    assert torch.equal(render(TEN, VIEWS, GRID, engine="cpu").images, expected)


def test_torch_defaults_do_not_matter():
    scene = TEN
    expected = render(scene, VIEWS, GRID, first_return_depth=0.1)
    torch.set_default_dtype(torch.float64)
    try:
        again = render(scene, VIEWS, GRID, first_return_depth=0.1)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(again.images, expected.images)
    assert torch.equal(again.ray_maps[0].transmittance, expected.ray_maps[0].transmittance)


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap, torch.func.jacrev])
def test_transforms_of_torch_func_are_refused(transform):
    def total(means: torch.Tensor) -> torch.Tensor:
        return render(TEN.with_tensors(means=means), VIEWS, GRID, engine="cpu").images.sum()

    means = TEN.means.expand(2, -1, -1) if transform is torch.func.vmap else TEN.means
    with pytest.raises(SarsplatError, match=r"no part in torch.func .* or engine='reference'"):
        transform(total)(means)


def test_the_reference_takes_them():
    def total(means: torch.Tensor) -> torch.Tensor:
        return render(two.with_tensors(means=means), VIEWS[:1], GRID, engine="reference").images.sum()

    two = cloud(2, 0)
    means = two.means.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(total(means), means)
    torch.testing.assert_close(torch.func.grad(total)(two.means), wanted)


# ---- values in any argument: refused by name, or proven harmless -----------------------------------------------------
AVAILABLE = cpu.instruction_sets()
ENGINES = [*dict.fromkeys(f"cpu-{AVAILABLE[k]}" for k in (0, -1)), "reference"]
TINY, MIN_NORMAL, LARGEST = 1e-45, 1.1754944e-38, 3.4028234e38


SCENE = Scene(
    cloud(12, 0, size=(1.0, 1.0, 1.0)), shift=0.1 * random_normal(1, 3, 2), gain=torch.tensor([1.3, 0.7, 2.0])
)
DIRECT = Scene(cloud(12, 0, size=(1.0, 1.0, 1.0)), amplitudes=random_normal(2, 3, 12, 1).abs())
NAMED = ["means", "quaternions", "scales", "optical_depth", "scattering", "shift", "gain", "amplitudes"]


def with_value(argument: str, index: int, value: float, engine: str) -> tuple[Scene, dict[str, torch.Tensor]]:
    """The scene with one number of one argument replaced, as leaves of the engine's dtype."""
    scene = DIRECT if argument == "amplitudes" else SCENE
    leaves = scene.leaves(torch.float64 if engine == "reference" else torch.float32)
    with torch.no_grad():
        leaves[argument].view(-1)[index % leaves[argument].numel()] = value
    return scene, leaves


def run(scene: Scene, leaves: dict[str, torch.Tensor], engine: str) -> list[torch.Tensor]:
    """Images, cross-sections and all gradients."""
    rendering = scene.call(render, leaves, engine=engine)
    outputs = [rendering.images, rendering.cross_sections]
    generator = torch.Generator().manual_seed(3)
    loss = sum((output * torch.randn(output.shape, generator=generator)).sum() for output in outputs)
    gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    return [*(output.detach() for output in outputs), *(g for g in gradients if g is not None)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("argument", [name for name in NAMED if name != "scales"])
@pytest.mark.parametrize("value", [TINY, MIN_NORMAL, -0.0])
def test_denormals_are_zeros(argument, value, engine):
    """What lies below the least normal number changes nothing, in values or gradients."""
    found = run(*with_value(argument, 7, value, engine), engine)
    expected = run(*with_value(argument, 7, 0.0, engine), engine)
    for mine, theirs in zip(found, expected, strict=True):
        assert torch.isfinite(mine).all()
        assert float((mine - theirs).norm()) <= 1e-6 * float(theirs.norm())


NUMBERS = [0.0, TINY, MIN_NORMAL, MIN_SCALE, 1e9, 1e15, LARGEST, -LARGEST, 1e-20, 1e20, -1.0, 1.0]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("argument", NAMED)
def test_any_number_is_refused_by_name_or_gives_finite_results(argument, engine):
    rng, large = random.Random(argument), 5.0 if argument == "scales" else 40.0
    for value in [*NUMBERS, large, *struct.unpack("8f", rng.randbytes(32)), NAN, INF, -INF]:
        scene, leaves = with_value(argument, rng.randrange(200), value, engine)
        try:
            results = run(scene, leaves, engine)
        except SarsplatError as error:
            words = ("too many rays", "needs rays", "pairs") if argument in ("means", "scales") else ()
            by_name = str(error).startswith(f"{argument}[") and "; it must be " in str(error)
            assert by_name or (math.isfinite(value) and any(word in str(error) for word in words)), (value, error)
        else:
            assert math.isfinite(value)
            assert all(torch.isfinite(result).all() for result in results), value


def test_a_cotangent_that_is_not_finite_stays_in_its_view():
    leaves = DIRECT.leaves(torch.float32)
    images = DIRECT.call(render, leaves, engine="cpu").images
    seed = torch.ones_like(images)
    seed[0].view(-1)[images[0].argmax()] = math.nan
    (gradient,) = torch.autograd.grad(images, [leaves["amplitudes"]], seed, retain_graph=True)
    assert torch.isnan(gradient[0]).any()
    assert torch.isfinite(gradient[1:]).all()
    (gradient,) = torch.autograd.grad(images, [leaves["amplitudes"]], torch.ones_like(images))  # the next call is clean
    assert torch.isfinite(gradient).all()


def test_the_scenes_are_seen():
    """Otherwise nothing above could go wrong."""
    for scene in (SCENE, DIRECT):
        results = run(scene, scene.leaves(torch.float32), "cpu")
        assert all(float(result.norm()) > 0 for result in results)
