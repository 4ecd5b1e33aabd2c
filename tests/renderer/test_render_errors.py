"""Wrong input is named, with its value and what to do."""

import time
from collections.abc import Callable
from functools import partial

import pytest
import torch
from emulated_cuda import Emulator, render_on
from named_scenes import GRID, VIEWS, changed, cloud

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MIN_SCALE
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import render
from sarsplat.renderer.reference import render_reference

TEN = cloud(10, 0)


def by(engine: str, request: pytest.FixtureRequest) -> Callable:
    """Render with an engine; that of CUDA is emulated."""
    if engine != "cuda":
        return partial(render, engine=engine)
    return partial(render_on, Emulator(request.getfixturevalue("library")))


@pytest.mark.parametrize("engine", ["cpu", "reference", "cuda"])
@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("means", (3, 1), float("nan"), r"means\[3\] is \[.*nan.*\]; it must be finite metres"),
        ("quaternions", (4,), 0.0, r"quaternions\[4\] is \[0.0, 0.0, 0.0, 0.0\]; it must be finite and not zero"),
        ("quaternions", (4, 2), float("nan"), r"quaternions\[4\] is \[.*nan.*\]; it must be finite and not zero"),
        ("scales", (9, 2), MIN_SCALE / 2, r"scales\[9\] is \[.*\]; it must be finite and at least MIN_SCALE = 0.0001"),
        ("scales", (3,), 1e10, r"scales\[3\] is .*; it must be finite .* at most 1e\+06 m"),
        ("scales", (9, 0), float("nan"), r"scales\[9\] is \[nan.*\]; it must be finite and at least"),
        ("optical_depth", (2,), 41.0, r"optical_depth\[2\] is 41.0; it must be between 0 and MAX_OPTICAL_DEPTH = 40"),
        ("optical_depth", (2,), -0.1, r"optical_depth\[2\] is -0.1\d*; it must be between 0 and"),
        ("scattering", (7, 15), float("nan"), r"scattering\[7\] is \[.*nan\]; it must be finite"),
    ],
)
def test_values_out_of_range(name, index, value, message, engine, request):
    scene = changed(TEN, name, index, value).to(torch.float64 if engine == "reference" else torch.float32)
    with pytest.raises(SarsplatError, match=message):
        by(engine, request)(scene, VIEWS, GRID)


def test_limits_themselves_are_allowed():
    scene = changed(TEN, "optical_depth", (2,), 40.0)
    scene.scales[4] = MIN_SCALE
    assert torch.isfinite(render(scene, VIEWS, GRID, engine="cpu").images).all()


NOWHERE = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, float("inf")]])
WRONG = torch.ones(3, 10, 1)
WRONG[1, 4] = float("nan")
ANY, CPU, REFERENCE, BOTH = ("auto", "cpu", "reference"), ("cpu",), ("reference",), ("cpu", "cuda")


@pytest.mark.parametrize(
    ("engine", "options", "message"),
    [
        (engine, options, message)
        for engines, options, message in (
            (ANY, {"amplitudes": torch.ones(2, 10, 1)}, r"amplitudes has shape \(2, 10, 1\); .* it must be \(3, 10,"),
            (ANY, {"shift": torch.ones(3)}, r"shift has shape \(3,\); .* it must be \(3, 2\)"),
            (ANY, {"gain": torch.ones(1)}, r"gain has shape \(1,\); .* it must be \(3,\)"),
            (ANY, {"imaging_weight": "round"}, r"imaging_weight 'round' is unknown; choose one of area, peak"),
            (ANY, {"first_return_depth": 0.0}, r"first_return_depth 0.0 must be a positive two-way optical depth"),
            (ANY, {"first_return_depth": float("nan")}, r"first_return_depth nan must be a positive"),
            (ANY, {"gain": torch.ones(3, device="meta")}, "gain is on torch's meta device"),
            (ANY, {"gaussians": TEN.to("meta")}, "means is on torch's meta device, which holds no values"),
            (
                ("cpu", "reference"),
                {"amplitudes": torch.ones(3, 10, 1, dtype=torch.complex64)},
                r"amplitudes is torch.complex64, but render takes real ones; .* sarsplat.splat",
            ),
            (BOTH, {"amplitudes": WRONG}, r"amplitudes\[1, 4\] is \[nan\]; it must be finite"),
            (BOTH, {"shift": NOWHERE}, r"shift\[2\] is \[0.0, inf\]; it must be finite metres"),
            (("gpu",), {}, "engine 'gpu' is unknown; choose one of auto, cpu, cuda, reference"),
            (CPU, {"instruction_set": "sse9"}, "choose one of auto, base, avx2, avx512"),
            (("auto",), {"views": []}, "there are no views to render; give at least one View"),
            (CPU, {"gaussians": TEN.to(torch.float64)}, "means is torch.float64 on cpu; the CPU engine takes"),
            (CPU, {"gain": torch.ones(3).double()}, "gain is torch.float64 on cpu; the CPU"),
            (REFERENCE, {"plane_gradients": True}, r"needs another engine \(cpu, cuda\)"),
            (
                BOTH,
                {"gaussians": changed(TEN, "means", (0, 0), 1e6)},
                r"view 0 would need too many rays .* reach 1e\+06 m .* remove distant or wide ones",
            ),
            (BOTH, {"rays": RayGrid((1e-5, 1e-5))}, "too many rays at a spacing of"),
            (
                CPU,
                {"grid": ImageGrid(80_000, 1, (0.2, 5e-5), (0.3, 0.3)), "rays": RayGrid((0.1, 0.1))},
                "an image of 80000 × 1 pixels is too large",
            ),
        )
        for engine in engines
    ],
)
def test_arguments(engine, options, message, request):
    whole = {"gaussians": TEN, "views": VIEWS, "grid": GRID} | options
    with pytest.raises(SarsplatError, match=message):
        by(engine, request)(**whole)


def test_engine_works_after_an_error():
    expected = render(TEN, VIEWS, GRID, engine="cpu").images
    with pytest.raises(SarsplatError, match="too many rays"):
        render(changed(TEN, "means", (0, 0), 1e6), VIEWS, GRID, engine="cpu")
    assert torch.equal(render(TEN, VIEWS, GRID, engine="cpu").images, expected)


def test_engine_auto_follows_the_dtype():
    scene = TEN
    assert torch.equal(render(scene, VIEWS, GRID).images, render(scene, VIEWS, GRID, engine="cpu").images)
    double = scene.to(torch.float64)
    assert torch.equal(render(double, VIEWS, GRID).images, render_reference(double, VIEWS, GRID).images)


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


def test_the_reference_refuses_at_once_what_would_take_hours():
    begun = time.monotonic()
    with pytest.raises(SarsplatError, match=r"too many rays at a spacing of \(0.001, 0.001\) m: .* use coarser rays"):
        render(cloud(60, 0), VIEWS, GRID, rays=RayGrid((0.001, 0.001)), engine="reference")
    assert time.monotonic() - begun < 2


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap, torch.func.jacrev])
def test_transforms_of_torch_func_are_refused(transform):
    def total(means: torch.Tensor) -> torch.Tensor:
        return render(TEN.with_tensors(means=means), VIEWS, GRID, engine="cpu").images.sum()

    means = TEN.means.expand(2, -1, -1) if transform is torch.func.vmap else TEN.means
    with pytest.raises(SarsplatError, match=r"no part in torch.func .* or engine='reference'"):
        transform(total)(means)


def test_the_reference_takes_them_but_for_vmap():
    def total(means: torch.Tensor) -> torch.Tensor:
        return render(two.with_tensors(means=means), VIEWS[:1], GRID, engine="reference").images.sum()

    two = cloud(2, 0)
    means = two.means.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(total(means), means)
    torch.testing.assert_close(torch.func.grad(total)(two.means), wanted)
    with pytest.raises(SarsplatError, match=r"looks at values, which torch.func.vmap .* loop over scenes"):
        torch.func.vmap(total)(two.means[None])


def test_views_are_not_learned_but_means_may_be_turned():
    """By the line of code that the refusal says."""
    angle = torch.tensor(20.0)
    with pytest.raises(SarsplatError, match=r"azimuth is a tensor, but views have no .* turn the") as refused:
        View(angle, 30.0)
    round_ones = TEN.with_tensors(scales=torch.full((10, 3), 0.2), scattering=torch.ones(10, 1))
    known = {"means": round_ones.means, "a": angle.deg2rad(), "torch": torch}
    exec(str(refused.value).partition("azimuth: ")[2].replace("; means", "\nmeans"), known)
    turned = render(round_ones.with_tensors(means=known["means"]), [View(10.0, 30.0)], GRID)
    torch.testing.assert_close(turned.images, render(round_ones, [View(30.0, 30.0)], GRID).images, rtol=1e-3, atol=1e-4)
