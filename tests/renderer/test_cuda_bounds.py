"""A CUDA rendering with bounds: the same as without, no wait for the device, and what breaks them is reported."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from compared import relative
from emulated_cuda import Emulator, guarded, render_on
from named_scenes import GRID, MATRIX, VIEWS, Scene, changed, cloud
from test_cpu_engine import everything as all_of

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.renderer import Bounds, render


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
