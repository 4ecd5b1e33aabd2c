"""The CUDA engine's kernels, emulated on the CPU, against the float64 reference; and all that surrounds them."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import step_cases
import torch
from emulated_cuda import SCHEDULES, Emulator, guarded, mutated, render_on, without_barrier
from named_scenes import GRID, MATRIX, VIEWS, Scene, cloud
from test_cpu_engine import check, judged, loss_of, outputs_of, relative

from sarsplat.errors import SarsplatError
from sarsplat.renderer import Bounds, render
from sarsplat.renderer.checks import check_for_cuda
from sarsplat.renderer.engines import cuda, cuda_device, nvrtc


@pytest.fixture(scope="session")
def emulated(library):
    return partial(render_on, Emulator(library))


def everything(scene: Scene, renderer, norms: dict[str, float]) -> dict[str, torch.Tensor]:
    """Every output and every gradient, by name."""
    leaves = scene.leaves(torch.float32)
    outputs = outputs_of(scene.call(renderer, leaves))
    gradients = torch.autograd.grad(loss_of(outputs, norms), list(leaves.values()), allow_unused=True)
    return {name: t.detach() for name, t in outputs.items()} | dict(zip(leaves, gradients, strict=True))


def same_bits(first: dict[str, torch.Tensor | None], second: dict[str, torch.Tensor | None]) -> bool:
    return all(
        mine is theirs or torch.equal(mine.view(torch.int32), second[name].view(torch.int32))
        for name, mine in first.items()
        for theirs in (second[name],)
    )


@pytest.mark.parametrize("name", MATRIX)
def test_matches_the_reference_and_backwards_bit_for_bit(name, library):
    """Shuffled, the same kernels run in `test_cuda_bounds.py` and in the steps below."""
    scene, _, norms, _, maps = judged(name)
    traced = []

    def renderer(*arguments, **options):
        rendering = render_on(Emulator(library), *arguments, **options)
        traced.extend(rendering.ray_maps)
        return rendering

    found = everything(scene, renderer, norms)
    check(name, found)
    for ours, theirs in zip(traced, maps, strict=True):
        assert ours.transmittance.shape == theirs.transmittance.shape
        assert ours.transmittance.numel() == 0 or ours.origin == pytest.approx(theirs.origin)
    assert same_bits(everything(scene, partial(render_on, Emulator(library, "backwards")), norms), found)


@pytest.mark.parametrize("name", MATRIX)
@pytest.mark.parametrize("step", step_cases.STEPS)
def test_every_step_matches_its_twin(step, name, library):
    found = step_cases.found_by(partial(cuda.Pass, Emulator(library, "shuffled")), step, name)
    step_cases.check(step, name, found)


@pytest.mark.parametrize("channels", [1, 4, 9])
def test_channels_of_a_whole_rendering(channels, library):
    """Amplitudes of any sign, one of them zero everywhere; rays counted, so that both planes are seeded."""
    generator = torch.Generator().manual_seed(channels)
    amplitudes = torch.randn(3, 40, channels, generator=generator)
    amplitudes[:, 7] = 0.0

    def run(renderer, dtype: torch.dtype, **options) -> dict[str, torch.Tensor]:
        leaves = {
            name: t.detach().to(dtype).requires_grad_()
            for name, t in (cloud(40, 1).tensors() | {"amplitudes": amplitudes}).items()
        }
        *fields, last = leaves
        rendering = renderer(
            cloud(40, 1).with_tensors(**{name: leaves[name] for name in fields}),
            VIEWS,
            GRID,
            amplitudes=leaves[last],
            **options,
        )
        outputs = {"images": rendering.images, "cross_sections": rendering.cross_sections}
        seeds = torch.Generator().manual_seed(4)
        loss = sum((t * torch.randn(t.shape, generator=seeds).to(dtype)).sum() for t in outputs.values())
        gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        named = {f"d {name}": g for name, g in zip(leaves, gradients, strict=True) if name != "scattering"}
        return {name: t.detach() for name, t in outputs.items()} | named

    expected = run(partial(render, engine="reference"), torch.float64)
    means = cloud(40, 1).means
    first = run(partial(render_on, Emulator(library)), torch.float32)
    for schedule in SCHEDULES:
        bounds = Bounds((*means.amin(0).tolist(),), (*means.amax(0).tolist(),), float(cloud(40, 1).scales.max()), 41.0)
        for options in ({}, {"bounds": bounds}):
            computed = run(partial(render_on, Emulator(library, schedule)), torch.float32, **options)
            for name, value in expected.items():
                assert relative(computed[name], value) <= 1e-5, (name, schedule)
            assert options or same_bits(computed, first), schedule
        bounds.check()


def test_plane_gradients_and_a_second_backward(emulated):
    scene = MATRIX["shift and gain"]()
    found = {}
    for name, renderer in (("cuda", emulated), ("cpu", partial(render, engine="cpu"))):
        leaves = scene.leaves(torch.float32)
        rendering = scene.call(renderer, leaves, plane_gradients=True)
        assert not rendering.plane_gradients.any()  # until backward
        loss = (rendering.images**2).sum()
        first = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
        for mine, again in zip(first, torch.autograd.grad(loss, list(leaves.values())), strict=True):
            assert torch.equal(mine, again)
        found[name] = rendering.plane_gradients
    assert float(found["cpu"].norm()) > 0
    assert relative(found["cuda"], found["cpu"].double()) <= 1e-5


def test_a_loss_on_the_cross_sections_alone(emulated):
    scene, gradients = MATRIX["overlap"](), []
    for renderer in (emulated, partial(render, engine="cpu")):
        leaves = scene.leaves(torch.float32)
        gradients.append(torch.autograd.grad((scene.call(renderer, leaves).cross_sections ** 2).sum(), leaves["means"]))
    assert relative(gradients[0][0], gradients[1][0].double()) <= 1e-5


@pytest.mark.parametrize(
    "name", ["overlap", "partly outside", "larger than the image", "one pixel", "many views", "none"]
)
def test_memory_is_written_before_it_is_read_and_never_beyond_its_end(name, emulated, library):
    """Nor do the schedules of steps differ."""
    scene, _, norms, *_ = judged(name)
    expected = everything(scene, emulated, norms)
    steps = {step: step_cases.found_by(partial(cuda.Pass, Emulator(library)), step, name) for step in step_cases.STEPS}
    backwards = partial(cuda.Pass, Emulator(library, "backwards"))
    with guarded():
        assert same_bits(everything(scene, emulated, norms), expected)
        for step, once in steps.items():
            assert same_bits(step_cases.found_by(backwards, step, name), once), step


# ---- the emulator tells right from wrong ----------------------------------------------------------------------------
def runs(library: Path) -> list[dict[str, torch.Tensor]]:
    scene, _, norms, *_ = judged("overlap")
    return [everything(scene, partial(render_on, Emulator(library, schedule)), norms) for schedule in SCHEDULES]


@pytest.mark.parametrize("barrier", range(3))
def test_a_missing_barrier_shows(barrier, library):
    with without_barrier(library, "cuda_rays.cuh", barrier):
        first, *others = runs(library)
    assert not all(same_bits(first, other) for other in others)
    first, *others = runs(library)
    assert all(same_bits(first, other) for other in others)


@pytest.mark.slow
def test_a_divided_warp_shows(tmp_path, library):
    broken = mutated(library.parent, tmp_path / "csrc", "if (__any_sync(kWholeWarp, live))", "if (live)")
    with pytest.raises(RuntimeError, match="attenuate_tiles: threads"):
        runs(broken)


# ---- refusals -------------------------------------------------------------------------------------------------------
def test_no_cuda(monkeypatch):
    cuda_device.require_cuda.cache_clear()
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(SarsplatError, match=r"needs a torch built for CUDA, and this is .*; install one, or use"):
        render(cloud(10, 0), VIEWS, GRID, engine="cuda")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SarsplatError, match=r"finds no usable NVIDIA GPU; install the driver that CUDA 13.0 needs"):
        render(cloud(10, 0), VIEWS, GRID, engine="cuda")


def test_no_driver_and_no_nvrtc(monkeypatch):
    monkeypatch.setattr(cuda_device, "_DRIVER", "libnothing.so.1")
    with pytest.raises(
        SarsplatError, match=r"the NVIDIA driver cannot be loaded .*libnothing.so.1.*; install it, or use"
    ):
        cuda_device._driver.__wrapped__()
    monkeypatch.setattr(nvrtc, "_candidates", lambda: [Path("libnothing.so.2"), Path("libnothing.so.3")])
    with pytest.raises(
        SarsplatError, match=r"NVRTC.* cannot be loaded \(libnothing.so.2: .*; libnothing.so.3: .*; install"
    ):
        nvrtc._load.__wrapped__()


def test_tensors_that_the_engine_does_not_take():
    on_gpu = SimpleNamespace(dtype=torch.float32, device=torch.device("cuda", 0))
    assert check_for_cuda({"means": on_gpu, "amplitudes": None}) == 0
    with pytest.raises(
        SarsplatError, match=r"scales is torch.float32 on cpu; the CUDA engine takes .* on a GPU \(move"
    ):
        check_for_cuda({"means": on_gpu, "scales": torch.ones(3)})
    elsewhere = SimpleNamespace(dtype=torch.float32, device=torch.device("cuda", 1))
    with pytest.raises(SarsplatError, match="gain is on cuda:1 but means is on cuda:0; put them on one GPU"):
        check_for_cuda({"means": on_gpu, "gain": elsewhere})
