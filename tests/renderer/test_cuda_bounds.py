"""The CUDA engine, emulated: with bounds, of lit ground and of terrain, however it is run."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from compared import relative
from emulated_cuda import SCHEDULES, Emulator, guarded, render_on, without_barrier
from named_scenes import GRID, MATRIX, VIEWS, Scene, changed, cloud, random_normal
from test_cpu_engine import everything as all_of
from torch import Tensor

from made import hill
from sarsplat import Gaussians, ImageGrid, RayGrid, SarsplatError, View
from sarsplat.renderer import Bounds, render
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_ground import lit_ground
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.engines import cuda
from sarsplat.renderer.engines.on_device import ChosenViews
from sarsplat.renderer.engines.passes import NewPass


def bounds_of(gaussians: Gaussians) -> Bounds:
    """The narrowest ones."""
    if len(gaussians) == 0:
        return Bounds((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1, 1.0)
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    scale_m, depth = float(gaussians.scales.max()), float(gaussians.optical_depth.max())
    return Bounds((*low.tolist(),), (*high.tolist(),), scale_m, depth)


everything = partial(all_of, norms={}, of=("images", "cross_sections"))
"""Of which none depends on how wide the lattice is."""


@pytest.mark.parametrize("name", MATRIX)
def test_the_same_as_without_in_every_schedule(name, library):
    scene = MATRIX[name]()
    expected = everything(scene, partial(render_on, Emulator(library)))
    bounds, first = bounds_of(scene.gaussians), None
    for schedule in ("backwards", "shuffled"):
        found = everything(scene, partial(render_on, Emulator(library, schedule)), bounds=bounds)
        bounds.check()
        first = first or found
        for output, value in expected.items():
            assert torch.equal(found[output], first[output]), (schedule, output)
            assert relative(found[output], value.double()) <= 5e-6, output  # images: 3e-7


def test_the_lattice_holds_every_ray_that_is_touched_and_few_more(library):
    scene, emulated = MATRIX["oblong rays"](), partial(render_on, Emulator(library))
    without, bounded = (
        [m.transmittance.detach() for m in scene.call(emulated, scene.leaves(torch.float32), bounds=bounds).ray_maps]
        for bounds in (None, bounds_of(scene.gaussians))
    )
    for tight, wide in zip(without, bounded, strict=True):
        assert float((1 - wide).sum()) == pytest.approx(float((1 - tight).sum()), rel=1e-5)
        assert wide.numel() < 4 * tight.numel()


BROKEN = {
    "moved out": (("means", (3, 0), 40.0), "a Gaussian has left its bounds, Bounds.low_m"),
    "moved out of the other side": (("means", (3, 1), -40.0), "a Gaussian has left its bounds"),
    "too large": (("scales", (39,), 8.0), "a Gaussian has left its bounds"),
    "NaN": (
        ("means", (39, 1), math.nan),
        r"^means\[39\] was out of range when it was rendered; it must be finite metres",
    ),
    "too dense": (("optical_depth", (2,), 41.0), r"^optical_depth\[2\] was out of range"),
    "no size": (("scales", (9, 2), math.nan), r"^scales\[9\] was out of range"),
    "no direction": (("quaternions", (6,), 0.0), r"^quaternions\[6\] was out of range"),
}


@pytest.fixture(name="guarded")
def arrays_are_guarded():
    with guarded():
        yield


@pytest.mark.usefixtures("guarded")
@pytest.mark.parametrize("name", BROKEN)
def test_what_breaks_them_is_reported_and_no_memory_is_harmed(name, library):
    change, message = BROKEN[name]
    bounds, emulated = bounds_of(cloud(40, 0)), partial(render_on, Emulator(library))
    everything(Scene(changed(cloud(40, 0), *change)), emulated, bounds=bounds)  # as if nothing were wrong
    everything(Scene(changed(cloud(40, 0), "means", (7, 2), math.inf)), emulated, bounds=bounds)
    with pytest.raises(SarsplatError, match=message):  # still the first
        bounds.check()


@pytest.mark.usefixtures("guarded")
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("scales", 8.0, "a Gaussian has left its bounds"), ("means", math.nan, r"^means\[0\] was out of range")],
)
def test_a_footprint_of_more_tiles_than_there_is_room_for(name, value, message, library):
    """A single Gaussian in a wide image, so that there is no room of others to take."""
    scene = Scene(cloud(1, 13), VIEWS[:1], ImageGrid(300, 300, (0.2, 0.2), (0.3, 0.3)))
    bounds = bounds_of(scene.gaussians)
    worse = scene.gaussians.with_tensors(**{name: torch.full_like(scene.gaussians.tensors()[name], value)})
    everything(replace(scene, gaussians=worse), partial(render_on, Emulator(library)), bounds=bounds)
    with pytest.raises(SarsplatError, match=message):
        bounds.check()


def test_a_bad_amplitude_is_reported(library):
    amplitudes = torch.ones(3, 10, 1)
    amplitudes[1, 4] = math.nan
    bounds = bounds_of(cloud(10, 0))
    render_on(Emulator(library), cloud(10, 0), VIEWS, GRID, amplitudes=amplitudes, bounds=bounds)
    with pytest.raises(SarsplatError, match=r"amplitudes.flatten\(0, 1\)\[14\] was out of range"):
        bounds.check()


def test_a_bad_gain_is_reported_and_not_looked_at(library, monkeypatch):
    bounds, emulated = bounds_of(cloud(10, 0)), partial(render_on, Emulator(library))
    with monkeypatch.context() as patch:
        for method in ("__bool__", "__int__", "__index__", "item", "tolist", "nonzero"):
            patch.setattr(torch.Tensor, method, lambda *_: pytest.fail("looks at a value"))
        emulated(cloud(10, 0), VIEWS, GRID, gain=torch.tensor([1.0, 2.0, 3.0]), bounds=bounds)
    bounds.check()
    emulated(cloud(10, 0), VIEWS, GRID, gain=torch.tensor([1.0, math.inf, math.nan]), bounds=bounds)
    with pytest.raises(SarsplatError, match=r"^gain\[1\] was out of range when it was rendered; it must be finite"):
        bounds.check()


def test_bounds_that_would_take_too_much_memory_are_not_allocated(library):
    scene, bounds = MATRIX["overlap"](), Bounds((-1e5, -1e5, 0.0), (1e5, 1e5, 1.0), 100.0, 10.0)
    assert bounds.capacity(60, VIEWS, GRID, RayGrid.for_image(GRID)) is None
    found, expected = (everything(scene, partial(render_on, Emulator(library)), bounds=b) for b in (bounds, None))
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_the_cpu_engine_needs_none():
    scene = MATRIX["overlap"]()
    bounds = replace(bounds_of(scene.gaussians), scale_m=0.0)
    found, expected = (everything(scene, partial(render, engine="cpu"), bounds=b) for b in (bounds, None))
    assert all(torch.equal(found[name], value) for name, value in expected.items())
    bounds.check()


# ---- lit ground and terrain: right, and the same bits however they are run -------------------------------------------
LIT = ImageGrid(37, 41, (0.3, 0.25), (0.45, 0.4))
STEEP = (View(0.0, 5.0), View(75.0, 35.0), View(140.0, 60.0), View(200.0, 88.0))
SIZES = ((90, 70), (33, 64), (0, 0), (10, 31))
RAYS = RayGrid((0.11, 0.07))
ORIGINS = ((-3.0, -2.0), (-2.0, -0.4), (0.0, 0.0), (1.0, -0.3))


@pytest.fixture
def new_pass(library: Path) -> NewPass:
    return partial(cuda.Pass, Emulator(library))


def check_twin(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """Within this part of the largest number."""
    assert found.keys() == expected.keys()
    for name, right in expected.items():
        if right.numel():
            assert float((found[name] - right).abs().max()) <= tolerance * float(right.abs().max()), name


# ---- level ground ----------------------------------------------------------------------------------------------------
def of_ground(new_pass: NewPass | None, shifted: bool, chosen: Sequence[int] | None = None) -> dict[str, Tensor]:
    """Lit ground and its gradients; of views that are chosen on the device, or of these in order."""
    dtype = torch.float64 if new_pass is None else torch.float32
    which, generator = range(len(STEEP)) if chosen is None else chosen, torch.Generator().manual_seed(0)
    ends = [torch.rand(rows * columns, generator=generator).to(dtype) for rows, columns in SIZES]
    pitch = max(rows for rows, _ in SIZES) * max(columns for _, columns in SIZES)
    parts = [
        ends[v] if chosen is None else torch.cat([ends[v], torch.full((pitch - len(ends[v]),), torch.nan)])
        for v in which
    ]
    left = torch.cat(parts).requires_grad_()
    shift = (0.2 * random_normal(1, 4, 2))[list(which)].to(dtype).requires_grad_()
    views = STEEP if chosen is None else ChosenViews(STEEP, torch.tensor(chosen))
    rays = RayEnds(left, SIZES, ORIGINS)
    found = lit_ground(rays, views, LIT, RAYS, 0.3, shift if shifted else None, new_pass)
    seeds = random_normal(2, len(STEEP), LIT.rows, LIT.columns)[list(which)].to(dtype)
    d_left, *d_shift = torch.autograd.grad((found * seeds).sum(), [left, shift] if shifted else [left])
    own = d_left.split([len(part) for part in parts])
    d_ends = {f"d ends {v}": part[: len(ends[v])] for v, part in zip(which, own, strict=True)}
    lit = {f"lit {v}": image for v, image in zip(which, found.detach(), strict=True)}
    return lit | d_ends | {f"d shift {v}": row for rows in d_shift for v, row in zip(which, rows, strict=True)}


@pytest.mark.parametrize("shifted", [False, True])
def test_ground_is_that_of_the_twin_and_the_same_bits_however_it_is_run(shifted: bool, library: Path, new_pass) -> None:
    right = of_ground(new_pass, shifted)
    check_twin(right, of_ground(None, shifted), 2e-6)
    assert torch.equal(right["lit 2"], torch.ones(LIT.rows, LIT.columns))  # nothing stands there
    with guarded():
        for schedule in SCHEDULES:
            found = of_ground(partial(cuda.Pass, Emulator(library, schedule)), shifted)
            assert all(torch.equal(found[name], one) for name, one in right.items())


def test_the_same_bits_of_views_that_only_the_device_knows(new_pass: NewPass) -> None:
    right = of_ground(new_pass, True)
    with guarded():
        for chosen in ([3, 0], [1, 2, 0], [2]):
            found = of_ground(new_pass, True, chosen)
            assert len(found) == 3 * len(chosen)
            assert all(torch.equal(one, right[name]) for name, one in found.items())


def test_pixels_see_no_more_than_the_band_has_room_for(new_pass: NewPass) -> None:
    """Of fine rays, and of rays that are wider than the response."""
    for spacing in ((0.01, 0.02), (2.0, 1.5)):
        ends = RayEnds(torch.full((60 * 70,), 0.3), [(60, 70)], [(-30 * spacing[0], -35 * spacing[1])])
        kernel, twin = (
            lit_ground(replaced, [STEEP[1]], LIT, RayGrid(spacing), 0.0, None, made)
            for replaced, made in (
                (ends, new_pass),
                (RayEnds(ends.transmittance.double(), ends.sizes, ends.origins), None),
            )
        )
        torch.testing.assert_close(kernel.double(), twin, rtol=0, atol=2e-6)


def test_a_missing_barrier_shows(library: Path, new_pass: NewPass) -> None:
    right = of_ground(new_pass, True)
    with without_barrier(library, "cuda_loss.cuh", 1):
        others = [of_ground(partial(cuda.Pass, Emulator(library, schedule)), True) for schedule in SCHEDULES]
    assert not all(torch.equal(found["d shift 0"], right["d shift 0"]) for found in others)


# ---- terrain ---------------------------------------------------------------------------------------------------------
HILLY = ImageGrid(21, 19, (0.3, 0.25), (0.45, 0.4))
LOOKS = (View(0.0, 25.0), View(75.0, 40.0), View(200.0, 70.0))
COARSE = RayGrid((0.16, 0.13))
TRACED, FIRST = ((20, 24), (0, 0), (200, 9)), ((-10, -8), (0, 0), (3, -70))
"""The second view has no Gaussians; the last one's rays reach beyond the cells."""


def of_terrain(
    new_pass: NewPass | None, shifted: bool, places: tuple[int, int], weight: float = 0.5
) -> dict[str, Tensor]:
    dtype, generator = torch.float64 if new_pass is None else torch.float32, torch.Generator().manual_seed(0)
    left = torch.rand(sum(rows * columns for rows, columns in TRACED), generator=generator)
    gamma0 = torch.rand(len(LOOKS), *places, generator=generator) + 0.1
    shift = 0.2 * torch.randn(len(LOOKS), 2, generator=generator)
    leaves = {"left": left, "gamma0": gamma0} | ({"shift": shift} if shifted else {})
    leaves = {name: tensor.to(dtype).requires_grad_() for name, tensor in leaves.items()}
    origins = [tuple((k + 0.5) * step for k, step in zip(first, COARSE.spacing_m, strict=True)) for first in FIRST]
    ends = RayEnds(leaves["left"], TRACED, origins)
    found = lit_terrain(ends, LOOKS, HILLY, COARSE, hill(), leaves["gamma0"], 0.9, leaves.get("shift"), new_pass)
    seeds = torch.randn(found.shape, generator=generator).to(dtype)
    seeds[1] = weight
    gradients = torch.autograd.grad((found * seeds).sum(), list(leaves.values()))
    return {"lit": found.detach()} | {f"d {name}": one for name, one in zip(leaves, gradients, strict=True)}


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("places", [(1, 1), (7, 9), (1, 4)])
def test_as_the_twin_and_the_same_bits_however_it_is_run(places: tuple[int, int], shifted: bool, library: Path) -> None:
    found, expected = (
        of_terrain(partial(cuda.Pass, Emulator(library)), shifted, places),
        of_terrain(None, shifted, places),
    )
    check_twin(found, expected, 4e-6)
    with guarded():
        for schedule in SCHEDULES:
            again = of_terrain(partial(cuda.Pass, Emulator(library, schedule)), shifted, places)
            assert all(torch.equal(again[name], one) for name, one in found.items()), schedule


@pytest.mark.parametrize("weight", [0.0, torch.nan, torch.inf, 1e-30, 1e30])
def test_gradients_of_any_size(weight: float, library: Path) -> None:
    """Of a view that does not matter, too, and of one whose images have become no numbers."""
    found = of_terrain(partial(cuda.Pass, Emulator(library)), False, (7, 9), weight)["d gamma0"]
    right = of_terrain(None, False, (7, 9), weight)["d gamma0"]
    for v in range(len(LOOKS)):
        scale = float(right[v].abs().max())
        assert (
            bool(found[v].isnan().all()) if scale != scale else float((found[v] - right[v]).abs().max()) <= 4e-6 * scale
        )
