"""The public steps project, attenuate and splat: against their twins, against `render`, and on their own."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from chain import chained
from emulated_cuda import Emulator
from named_scenes import GRID, MATRIX, VIEWS, Scene, cloud
from test_cpu_engine import AVAILABLE, check, everything, judged, outputs_of, relative, same_bits, traced
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Harmonics, NormalLobes
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.renderer import Footprints, Waves, attenuate, project, render, splat
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.operations import Steps
from sarsplat.renderer.reference import splat_reference

RAYS = RayGrid.for_image(GRID)
STEPPED = [name for name in MATRIX if "ground" not in name and "terrain" not in name]  # which are no steps


def emulated(request: pytest.FixtureRequest) -> NewPass:
    return partial(cuda.Pass, Emulator(request.getfixturevalue("library")))


@pytest.mark.parametrize("instruction_set", AVAILABLE)
@pytest.mark.parametrize("name", STEPPED)
def test_a_chain_of_steps_matches_the_reference(name, instruction_set):
    scene, _, norms, _, maps = judged(name)
    steps = Steps(partial(cpu.Pass, instruction_set))
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


# ---- on their own ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["many", "many views"])
def test_same_bits_for_any_number_of_threads(name, threads):
    threads(1)
    scene, chain = MATRIX[name](), partial(chained, Steps(cpu.Pass))
    expected = everything(scene, chain, {})
    for count in (2, 3, 7):
        threads(count)
        assert same_bits(everything(scene, chain, {}), expected), count


def test_gradients_of_gradients_are_refused():
    g = cloud(10, 1)
    g.means.requires_grad_()
    p = project(g, VIEWS, GRID)
    lit = attenuate(p, RAYS).lit_area
    images = splat(p.pixels, lit[..., None], GRID)
    for output, leaf in ((p.rays.roots, g.means), (lit, p.rays.roots), (images, p.pixels.roots)):
        with pytest.raises(SarsplatError, match="no second derivatives"):
            torch.autograd.grad((output**2).sum(), [leaf], create_graph=True)


def test_steps_between_forward_and_backward_do_not_disturb():
    pixels = project(cloud(60, 1), VIEWS, GRID).pixels
    cross_sections = torch.rand(3, 60, 1, requires_grad=True)
    images = splat(pixels, cross_sections, GRID)
    expected = torch.autograd.grad(images.square().sum(), cross_sections, retain_graph=True)[0]
    for seed in range(4):
        attenuate(project(cloud(90, seed), VIEWS, GRID), RAYS)
        splat(project(cloud(90, seed), VIEWS, GRID).pixels, torch.rand(3, 90, 2), GRID)
    assert torch.equal(torch.autograd.grad(images.square().sum(), cross_sections)[0], expected)


# ---- refusals --------------------------------------------------------------------------------------------------------
def bad(tensor: Tensor, index: tuple[int, ...], value: float) -> Tensor:
    changed = tensor.detach().clone()
    changed[index] = value
    return changed


NAN, INF = float("nan"), float("inf")


@pytest.fixture(params=["cpu", "reference", "cuda"])
def by(request: pytest.FixtureRequest) -> SimpleNamespace:
    """The steps with an engine; that of CUDA is emulated."""
    if request.param != "cuda":
        public: dict[str, Callable[..., Any]] = {"project": project, "attenuate": attenuate, "splat": splat}
        return SimpleNamespace(**{name: partial(step, engine=request.param) for name, step in public.items()})
    steps = Steps(emulated(request))
    return SimpleNamespace(project=partial(steps.project, rays=RAYS), attenuate=steps.attenuate, splat=steps.splat)


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("rays.centers", (1, 4, 0), NAN, r"rays.centers\[1, 4\] is \[.*nan.*\]; it must be finite metres"),
        ("rays.roots", (2, 0, 2), 0.0, r"rays.roots\[2, 0\] is \[.*\]; it must be .* at least 1e-08"),
        ("rays.roots", (0, 9, 1), -INF, r"rays.roots\[0, 9\] is \[.*inf.*\]; it must be"),
        ("optical_depth", (1, 1), 41.0, r"optical_depth\[1, 1\] is 41.0; it must be between 0"),
        ("range_m", (0, 3), NAN, r"range_m\[0, 3\] is nan; it must be finite metres"),
        ("tilt", (0, 3, 1), NAN, r"tilt\[0, 3\] is \[.*nan.*\]; it must be finite"),
    ],
)
def test_projections_out_of_range(by, name, index, value, message):
    p = project(cloud(10, 0), VIEWS, GRID)
    field, _, part = name.partition(".")
    wrong = bad(getattr(p.rays, part) if part else getattr(p, field), index, value)
    with pytest.raises(SarsplatError, match=message):
        by.attenuate(replace(p, **{field: replace(p.rays, **{part: wrong}) if part else wrong}), RAYS)


def test_values_out_of_range(by):
    g, cross_sections = cloud(10, 0), torch.ones(3, 10, 2)
    p = project(g, VIEWS, GRID)
    with pytest.raises(SarsplatError, match=r"cross_sections\[2, 7\] is \[1.0, inf\]; it must be finite"):
        by.splat(p.pixels, bad(cross_sections, (2, 7, 1), INF), GRID)
    with pytest.raises(SarsplatError, match=r"footprints.roots\[0, 0\] is \[nan.*\]; it must be finite"):
        by.splat(replace(p.pixels, roots=bad(p.pixels.roots, (0, 0, 0), NAN)), cross_sections, GRID)
    for name, message in (("means", "finite metres"), ("scattering", "finite")):
        with pytest.raises(SarsplatError, match=rf"{name}\[3\] is \[nan.*\]; it must be {message}"):
            wrong = g.with_tensors(**{name: bad(g.tensors()[name], (3, 0), NAN)})
            by.project(wrong, VIEWS, GRID)


TEN, WIDE = cloud(10, 0), ImageGrid(80_000, 1, (0.2, 5e-5), (0.3, 0.3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p, x: Footprints(p.rays.centers, p.rays.roots[:, :9]), r"roots has shape \(3, 9, 3\); for 3 views of"),
        (lambda p, x: replace(p, tilt=p.range_m), r"tilt has shape \(3, 10\); for 3 views of 10 Gaussians it must be"),
        (
            lambda p, x: replace(p, pixels=Footprints(p.pixels.centers[:2], p.pixels.roots[:2])),
            r"pixels.centers is \(2, 10, 2\) .* does not fit an optical_depth of \(3, 10\)",
        ),
        (lambda p, x: replace(p.rays, roots=p.rays.roots.double()), r"roots is torch.float64 on cpu but centers is"),
        (lambda p, x: replace(p, rays=p.rays.centers), "rays is an object of type Tensor"),
        (lambda p, x: replace(p, optical_depth=[1.0]), "optical_depth is .1.0.; give a torch.Tensor"),
        (lambda p, x: splat(p.pixels, x[..., 0], GRID), r"cross_sections has shape \(3, 10\); .* must be \(3, 10, C\)"),
        (lambda p, x: splat(p.pixels, x[..., :0], GRID), r"cross_sections has shape \(3, 10, 0\); .* at least one"),
        (lambda p, x: splat(p.pixels, x.double(), GRID), "is torch.float64 on cpu but footprints.centers"),
        (lambda p, x: splat(p, x, GRID), "Projection; give Footprints, such as Projection.pixels"),
        (lambda p, x: splat(p.pixels, x, GRID, imaging_weight="round"), "imaging_weight 'round' is unknown"),
        (
            lambda p, x: splat(Footprints(p.pixels.centers[:0], p.pixels.roots[:0]), x[:0], GRID),
            r"shape \(0, 10, 2\), which has no views",
        ),
        (lambda p, x: attenuate(p.rays, RAYS), "Footprints; give what sarsplat.project returned"),
        (lambda p, x: attenuate(p, GRID), "give a RayGrid, such as"),
        (lambda p, x: attenuate(p, RAYS, first_return_depth=0), "first_return_depth 0 must be a positive"),
        (lambda p, x: project(TEN, VIEWS, GRID, engine="gpu"), "engine 'gpu' is unknown"),
        (lambda p, x: project(TEN, [], GRID), "there are no views to render"),
        (lambda p, x: project(TEN, VIEWS, GRID, shift=torch.zeros(3)), r"shift has shape \(3,\); .* it must be \(3,"),
        (lambda p, x: splat(p.pixels, x.to(torch.complex128), GRID), "cross_sections.real is torch.float64 on cpu but"),
        (lambda p, x: splat(p.pixels, x, WIDE, engine="cpu"), "an image of 80000 × 1 pixels is too large"),
        (lambda p, x: project(TEN.to(torch.float64), VIEWS, GRID, engine="cpu"), "the CPU engine takes torch.float32"),
    ],
)
def test_shapes_dtypes_and_options(call, message):
    with pytest.raises(SarsplatError, match=message):
        call(project(TEN, VIEWS, GRID), torch.ones(3, 10, 1))


def test_lattices_that_are_too_large(by):
    far = cloud(10, 0)
    p = project(replace(far, means=bad(far.means, (0, 0), 1e6)), VIEWS, GRID)
    with pytest.raises(
        SarsplatError, match=r"(view 0 would .* remove distant or wide ones|reference would need too many)"
    ):
        by.attenuate(p, RAYS)
