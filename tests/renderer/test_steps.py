"""The public steps project, attenuate and splat: against their twins, against `render`, and on their own."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from compared import chained, relative
from emulated_cuda import Emulator
from named_scenes import GRID, MATRIX, VIEWS, Scene, changed, cloud
from test_cpu_engine import AVAILABLE, check, everything, judged, outputs_of, traced
from torch import Tensor

from sarsplat import Harmonics, ImageGrid, NormalLobes, RayGrid, SarsplatError
from sarsplat.renderer import Footprints, Projection, Waves, attenuate, project, render, splat
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.operations import Steps
from sarsplat.renderer.reference import splat_reference

RAYS = RayGrid.for_image(GRID)
STEPPED = [name for name in MATRIX if "ground" not in name and "terrain" not in name]  # which are no steps


def emulated(request: pytest.FixtureRequest, schedule: str = "in order") -> NewPass:
    return partial(cuda.Pass, Emulator(request.getfixturevalue("library"), schedule))


@pytest.mark.parametrize("engine", [*AVAILABLE, "cuda"])
@pytest.mark.parametrize("name", STEPPED)
def test_a_chain_of_steps_matches_the_reference(name, engine, request):
    scene, _, norms, _, maps = judged(name)
    steps = Steps(partial(cpu.Pass, engine) if engine != "cuda" else emulated(request, "shuffled"))
    check(name, everything(scene, traced(maps, partial(chained, steps)), norms))


@pytest.mark.parametrize("law", [Harmonics, NormalLobes])
def test_the_reference_by_steps(law):
    single = replace(cloud(20, 1), scattering=law(torch.randn(20, 1 if law is Harmonics else 3)))
    scene = Scene(single.to(torch.float64))
    leaves = scene.leaves(torch.float64)
    public = SimpleNamespace(project=project, attenuate=attenuate, splat=splat)
    found, expected = (outputs_of(scene.call(by, leaves)) for by in (partial(chained, public), render))
    for key, value in expected.items():
        assert torch.equal(found[key].nan_to_num(), value.nan_to_num()), key


@pytest.mark.parametrize("engine", [*AVAILABLE, "cuda"])
@pytest.mark.parametrize("name", ["overlap", "partly outside", "one pixel", "many views", "peak weight", "many"])
def test_phases_that_turn_across_footprints(name, engine, request):
    """By up to some turns."""
    scene, generator = MATRIX[name](), torch.Generator().manual_seed(96)
    pixels = project(scene.gaussians, scene.views, scene.grid).pixels
    views, n, _ = pixels.centers.shape
    parts, slopes = torch.randn(views, n, 6, generator=generator), torch.randn(views, n, 2, generator=generator)
    inputs = pixels.centers, pixels.roots, parts, slopes * pixels.roots.median()
    numbers = torch.randn(views, 3, generator=generator)
    seeds = torch.randn(views, 6, scene.grid.rows, scene.grid.columns, generator=generator)
    found = []
    new_pass = partial(cpu.Pass, engine) if engine != "cuda" else emulated(request)
    for step, dtype in ((Steps(new_pass).splat, torch.float32), (splat_reference, torch.float64)):
        leaves = [tensor.detach().to(dtype).requires_grad_() for tensor in inputs]
        waves = Waves(numbers.to(dtype), leaves[3])
        images = step(Footprints(*leaves[:2]), leaves[2], scene.grid, waves=waves, imaging_weight=scene.imaging_weight)
        found.append([images, *torch.autograd.grad(images, leaves, seeds.to(dtype))])
    for tolerance, mine, expected in zip((1e-5, *[1e-4] * 4), *found, strict=True):
        assert expected.norm() > 0
        assert relative(mine, expected.detach()) <= tolerance


# ---- channels --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("engine", ["cpu", "reference"])
@pytest.mark.parametrize("channels", [1, 2])
def test_complex_amplitudes_are_two_channels(channels, engine):
    pixels, generator = project(cloud(60, 1), VIEWS, GRID).pixels, torch.Generator().manual_seed(channels)
    cross_sections = torch.randn(3, 60, channels, generator=generator, dtype=torch.complex64).requires_grad_()
    images = splat(pixels, cross_sections.conj(), GRID, engine=engine)
    real, imaginary = (splat(pixels, part, GRID, engine=engine) for part in (cross_sections.real, -cross_sections.imag))
    assert images.dtype == torch.complex64
    assert relative(images.real, real.detach().double()) <= 1e-6
    assert relative(images.imag, imaginary.detach().double()) <= 1e-6
    power, apart = images.abs().square().sum(), real.square().sum() + imaginary.square().sum()
    (found,), (expected,) = (torch.autograd.grad(loss, cross_sections) for loss in (power, apart))
    assert float(expected.norm()) > 0
    assert relative(*(torch.view_as_real(g.resolve_conj()).double() for g in (found, expected))) <= 1e-5


# ---- refusals --------------------------------------------------------------------------------------------------------
def bad(tensor: Tensor, index: tuple[int, ...], value: float) -> Tensor:
    other = tensor.detach().clone()
    other[index] = value
    return other


NAN, INF = float("nan"), float("inf")
TEN, WIDE = cloud(10, 0), ImageGrid(80_000, 1, (0.2, 5e-5), (0.3, 0.3))
FAR = changed(TEN, "means", (0, 0), 1e6)


def part_of(p: Projection, name: str, index: tuple[int, ...], value: float) -> Projection:
    """The projection with one number of a tensor replaced."""
    field, _, part = name.partition(".")
    if not part:
        return replace(p, **{field: bad(getattr(p, field), index, value)})
    footprints = getattr(p, field)
    return replace(p, **{field: replace(footprints, **{part: bad(getattr(footprints, part), index, value)})})


@pytest.fixture(params=["cpu", "reference", "cuda"])
def by(request: pytest.FixtureRequest) -> SimpleNamespace:
    """The steps with an engine; that of CUDA is emulated."""
    if request.param != "cuda":
        public: dict[str, Callable[..., Any]] = {"project": project, "attenuate": attenuate, "splat": splat}
        return SimpleNamespace(**{name: partial(step, engine=request.param) for name, step in public.items()})
    steps = Steps(emulated(request))
    return SimpleNamespace(project=partial(steps.project, rays=RAYS), attenuate=steps.attenuate, splat=steps.splat)


@pytest.mark.parametrize(
    ("name", "index", "value", "words"),
    [
        ("rays.centers", (1, 4, 0), NAN, r"rays.centers\[1, 4\] is \[.*nan.*\]; it must be finite metres"),
        ("rays.roots", (2, 0, 2), 0.0, r"rays.roots\[2, 0\] is .* at least 1e-08"),
        ("rays.roots", (0, 9, 1), -INF, r"rays.roots\[0, 9\]"),
        ("optical_depth", (1, 1), 41.0, r"optical_depth\[1, 1\] is 41.0; it must be between 0"),
        ("range_m", (0, 3), NAN, r"range_m\[0, 3\] is nan"),
        ("tilt", (0, 3, 1), NAN, r"tilt\[0, 3\]"),
        ("pixels.roots", (0, 0, 0), NAN, r"footprints.roots\[0, 0\]"),
        ("cross_sections", (2, 7, 1), INF, r"cross_sections\[2, 7\] is \[1.0, inf\]; it must be finite"),
        ("means", (3, 0), NAN, r"means\[3\] is .*; it must be finite metres"),
        ("scattering", (3, 0), NAN, r"scattering\[3\]"),
        ("far", (0, 0), 1e6, "(view 0 would .* remove distant or wide ones|reference would need too many)"),
    ],
)
def test_values_out_of_range(by, name, index, value, words):
    p, cross_sections = project(FAR if name == "far" else TEN, VIEWS, GRID), torch.ones(3, 10, 2)
    with pytest.raises(SarsplatError, match=words):
        if name in ("means", "scattering"):
            by.project(changed(TEN, name, index, value), VIEWS, GRID)
        elif name == "cross_sections":
            by.splat(p.pixels, bad(cross_sections, index, value), GRID)
        elif name == "pixels.roots":
            by.splat(part_of(p, name, index, value).pixels, cross_sections, GRID)
        else:
            by.attenuate(p if name == "far" else part_of(p, name, index, value), RAYS)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p, x: Footprints(p.rays.centers, p.rays.roots[:, :9]), r"roots has shape \(3, 9, 3\)"),
        (lambda p, x: replace(p, tilt=p.range_m), r"tilt has shape \(3, 10\); for 3 views of 10 Gaussians"),
        (lambda p, x: replace(p, pixels=Footprints(p.pixels.centers[:2], p.pixels.roots[:2])), "pixels.centers has"),
        (lambda p, x: replace(p.rays, roots=p.rays.roots.double()), r"roots is torch.float64 on cpu but centers is"),
        (lambda p, x: replace(p, rays=p.rays.centers), "rays is an object of type Tensor"),
        (lambda p, x: replace(p, optical_depth=[1.0]), "give a torch.Tensor"),
        (lambda p, x: splat(p.pixels, x[..., 0], GRID), r"cross_sections has shape \(3, 10\); .* must be \(3, 10, C\)"),
        (lambda p, x: splat(p.pixels, x[..., :0], GRID), r"cross_sections has shape \(3, 10, 0\)"),
        (lambda p, x: splat(p.pixels, x.double(), GRID), "is torch.float64 on cpu but footprints.centers"),
        (lambda p, x: splat(p.pixels, x.to(torch.complex128), GRID), "cross_sections.real is torch.float64"),
        (lambda p, x: splat(p.pixels, x, GRID, waves=Waves(x[:, 0], x[..., [0, 0]])), "which has no phase"),
        (
            lambda p, x: splat(p.pixels, x * 1j, GRID, waves=Waves(x[:, :2, 0], x[..., [0, 0]])),
            r"numbers \(3, 2\); .* \(3, 1\)",
        ),
        (lambda p, x: splat(p, x, GRID), "give Footprints, such as Projection.pixels"),
        (lambda p, x: splat(p.pixels, x, GRID, imaging_weight="round"), "give one of 'area'"),
        (lambda p, x: splat(Footprints(p.pixels.centers[:0], p.pixels.roots[:0]), x[:0], GRID), "has no views"),
        (lambda p, x: attenuate(p.rays, RAYS), "give what sarsplat.project returned"),
        (lambda p, x: attenuate(p, GRID), "give a RayGrid"),
        (lambda p, x: attenuate(p, RAYS, first_return_depth=0), "give a number above 0"),
        (lambda p, x: project(TEN, [], GRID), "there are no views to render"),
        (lambda p, x: project(TEN, VIEWS, GRID, shift=torch.zeros(3)), r"shift has shape \(3,\)"),
        (lambda p, x: splat(p.pixels, x, WIDE, engine="cpu"), "80000 × 1 pixels is too large"),
        (lambda p, x: project(TEN.to(torch.float64), VIEWS, GRID, engine="cpu"), "the CPU engine takes torch.float32"),
    ],
)
def test_shapes_dtypes_and_options(call, words):
    with pytest.raises(SarsplatError, match=words):
        call(project(TEN, VIEWS, GRID), torch.ones(3, 10, 1))
