"""Wrong input is named, with its value and what to do."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
import torch
from named_scenes import GRID, VIEWS, cloud

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MIN_SCALE, Gaussians
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.renderer import render
from sarsplat.renderer.reference import render_reference


def changed(name: str, index: tuple[int, ...], value: float) -> Gaussians:
    scene = cloud(10, 0)
    tensor = scene.tensors()[name].clone()
    tensor[index] = value
    return scene.with_tensors(**{name: tensor})


@pytest.mark.parametrize(("engine", "dtype"), [("cpu", torch.float32), ("reference", torch.float64)])
@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("means", (3, 1), float("nan"), r"means\[3\] is \[.*nan.*\]; it must be finite metres"),
        ("means", (0, 0), float("inf"), r"means\[0\] is \[inf.*\]; it must be finite metres"),
        ("quaternions", (4,), 0.0, r"quaternions\[4\] is \[0.0, 0.0, 0.0, 0.0\]; it must be finite and not zero"),
        ("quaternions", (4, 2), float("nan"), r"quaternions\[4\] is \[.*nan.*\]; it must be finite and not zero"),
        (
            "scales",
            (9, 2),
            MIN_SCALE / 2,
            r"scales\[9\] is \[.*\]; it must be finite and at least MIN_SCALE = 0.0001 m",
        ),
        ("scales", (3,), 1e10, r"scales\[3\] is .*; it must be finite .* at most 1e\+06 m"),
        ("scales", (9, 0), float("nan"), r"scales\[9\] is \[nan.*\]; it must be finite and at least"),
        ("optical_depth", (2,), 41.0, r"optical_depth\[2\] is 41.0; it must be between 0 and MAX_OPTICAL_DEPTH = 40"),
        ("optical_depth", (2,), -0.1, r"optical_depth\[2\] is -0.1\d*; it must be between 0 and"),
        ("scattering", (7, 15), float("nan"), r"scattering\[7\] is \[.*nan\]; it must be finite"),
    ],
)
def test_values_out_of_range(name, index, value, message, engine, dtype):
    with pytest.raises(SarsplatError, match=message):
        render(changed(name, index, value).to(dtype), VIEWS, GRID, engine=engine)


def test_limits_themselves_are_allowed():
    scene = changed("optical_depth", (2,), 40.0)
    scene.scales[4] = MIN_SCALE
    assert torch.isfinite(render(scene, VIEWS, GRID, engine="cpu").images).all()


def test_values_beside_the_gaussians():
    scene = cloud(10, 0)
    bad = torch.ones(3, 10, 1)
    bad[1, 4] = float("nan")
    with pytest.raises(SarsplatError, match=r"amplitudes\[1, 4\] is \[nan\]; it must be finite"):
        render(scene, VIEWS, GRID, amplitudes=bad, engine="cpu")
    with pytest.raises(SarsplatError, match=r"shift\[2\] is \[0.0, inf\]; it must be finite metres"):
        render(scene, VIEWS, GRID, shift=torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, float("inf")]]), engine="cpu")


@pytest.mark.parametrize("engine", ["cpu", "reference", "auto"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"amplitudes": torch.ones(2, 10, 1)}, r"amplitudes has shape \(2, 10, 1\); .* it must be \(3, 10, C\)"),
        ({"shift": torch.ones(3)}, r"shift has shape \(3,\); .* it must be \(3, 2\)"),
        ({"gain": torch.ones(1)}, r"gain has shape \(1,\); .* it must be \(3,\)"),
        ({"imaging_weight": "round"}, r"imaging_weight 'round' is unknown; choose one of area, peak"),
        ({"first_return_depth": 0.0}, r"first_return_depth 0.0 must be a positive two-way optical depth"),
        ({"first_return_depth": float("nan")}, r"first_return_depth nan must be a positive"),
    ],
)
def test_arguments(engine, options, message):
    with pytest.raises(SarsplatError, match=message):
        render(cloud(10, 0), VIEWS, GRID, engine=engine, **options)


@pytest.mark.parametrize(
    ("dtype", "views", "options", "message"),
    [
        (torch.float32, VIEWS, {"engine": "gpu"}, "engine 'gpu' is unknown; choose one of auto, cpu, cuda, reference"),
        (torch.float32, VIEWS, {"engine": "cpu", "instruction_set": "sse9"}, "choose one of auto, base, avx2, avx512"),
        (torch.float32, [], {}, "there are no views to render; give at least one View"),
        (torch.float64, VIEWS, {"engine": "cpu"}, "means is torch.float64 on cpu; the CPU engine takes torch.float32"),
        (
            torch.float32,
            VIEWS,
            {"engine": "cpu", "gain": torch.ones(3).double()},
            "gain is torch.float64 on cpu; the CPU",
        ),
        (torch.float32, VIEWS, {"engine": "reference", "plane_gradients": True}, r"needs another engine \(cpu, cuda\)"),
    ],
)
def test_engine_views_and_dtype(dtype, views, options, message):
    with pytest.raises(SarsplatError, match=message):
        render(cloud(10, 0).to(dtype), views, GRID, **options)


def test_far_away_gaussian():
    with pytest.raises(
        SarsplatError, match=r"view 0 would need too many rays .* reach 1e\+06 m .* remove distant or wide ones"
    ):
        render(changed("means", (0, 0), 1e6), VIEWS, GRID, engine="cpu")
    with pytest.raises(SarsplatError, match="too many rays at a spacing of"):
        render(cloud(10, 0), VIEWS, GRID, rays=RayGrid((1e-5, 1e-5)), engine="cpu")


def test_image_with_too_many_rows():
    grid = ImageGrid(80_000, 1, (0.2, 5e-5), (0.3, 0.3))
    with pytest.raises(SarsplatError, match="an image of 80000 × 1 pixels is too large"):
        render(cloud(2, 0), VIEWS[:1], grid, rays=RayGrid((0.1, 0.1)), engine="cpu", instruction_set="base")


def test_engine_works_after_an_error():
    expected = render(cloud(10, 0), VIEWS, GRID, engine="cpu").images
    with pytest.raises(SarsplatError, match="too many rays"):
        render(changed("means", (0, 0), 1e6), VIEWS, GRID, engine="cpu")
    assert torch.equal(render(cloud(10, 0), VIEWS, GRID, engine="cpu").images, expected)


def test_engine_auto_follows_the_dtype():
    scene = cloud(10, 0)
    assert torch.equal(render(scene, VIEWS, GRID).images, render(scene, VIEWS, GRID, engine="cpu").images)
    double = scene.to(torch.float64)
    assert torch.equal(render(double, VIEWS, GRID).images, render_reference(double, VIEWS, GRID).images)


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("means", torch.zeros(10, 2), r"means has shape \(10, 2\); for 10 Gaussians it must be \(10, 3\)"),
        ("scales", torch.zeros(9, 3), r"scales has shape \(9, 3\); for 10 Gaussians it must be \(10, 3\)"),
        ("optical_depth", torch.zeros(10, 1), r"optical_depth has shape \(10, 1\); .* it must be \(10,\)"),
        ("scattering", torch.zeros(10, 5), r"scattering has shape \(10, 5\); .* K = 1, 4, 9 or 16"),
        (
            "scales",
            torch.zeros(10, 3, dtype=torch.float64),
            "scales is torch.float64 on cpu but means is torch.float32",
        ),
    ],
)
def test_gaussians_that_do_not_fit_together(name, tensor, message):
    with pytest.raises(SarsplatError, match=message):
        cloud(10, 0).with_tensors(**{name: tensor})
    with pytest.raises(SarsplatError, match=r"p_min -0.1 must be finite and at least 0"):
        replace(cloud(10, 0).scattering, p_min=-0.1)


def test_torch_defaults_do_not_matter():
    scene = cloud(10, 0)
    expected = render(scene, VIEWS, GRID, first_return_depth=0.1)
    torch.set_default_dtype(torch.float64)
    try:
        again = render(scene, VIEWS, GRID, first_return_depth=0.1)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(again.images, expected.images)
    assert torch.equal(again.ray_maps[0].transmittance, expected.ray_maps[0].transmittance)


@pytest.mark.parametrize("engine", ["auto", "cpu", "reference"])
def test_tensors_without_values_are_refused(engine):
    with pytest.raises(SarsplatError, match="means is on torch's meta device, which holds no values"):
        render(cloud(10, 0).to("meta"), VIEWS, GRID, engine=engine)
    with pytest.raises(SarsplatError, match="gain is on torch's meta device"):
        render(cloud(10, 0), VIEWS, GRID, gain=torch.ones(len(VIEWS), device="meta"), engine=engine)


def test_the_reference_refuses_at_once_what_would_take_hours():
    begun = time.monotonic()
    with pytest.raises(SarsplatError, match=r"too many rays at a spacing of \(0.001, 0.001\) m: .* use coarser rays"):
        render(cloud(60, 0), VIEWS, GRID, rays=RayGrid((0.001, 0.001)), engine="reference")
    assert time.monotonic() - begun < 2


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_complex_amplitudes_are_for_splat(engine):
    amplitudes = torch.ones(len(VIEWS), 10, 1, dtype=torch.complex64)
    with pytest.raises(
        SarsplatError, match=r"amplitudes is torch.complex64, but render takes real ones; .* sarsplat.splat"
    ):
        render(cloud(10, 0), VIEWS, GRID, amplitudes=amplitudes, engine=engine)
