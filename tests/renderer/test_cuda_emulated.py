"""The CUDA engine's kernels, emulated on the CPU, against the float64 reference; and all that surrounds them."""

from __future__ import annotations

import logging
import math
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import step_cases
import torch
from emulated_cuda import SCHEDULES, Emulator, compile_emulator, render_on
from named_scenes import GRID, MATRIX, VIEWS, Scene, cloud
from test_cpu_engine import check, judged, loss_of, outputs_of, relative

from sarsplat.errors import SarsplatError
from sarsplat.geometry import RayGrid
from sarsplat.renderer import Footprints, cuda, cuda_device, nvrtc, project, render
from sarsplat.renderer.checks import check_for_cuda
from sarsplat.renderer.engines import _fitting
from sarsplat.renderer.step_functions import attenuate_with, project_with, splat_with


@pytest.fixture(scope="session")
def library(request: pytest.FixtureRequest) -> Path:
    pytest.importorskip("ziglang", reason="the emulator is compiled with ziglang")
    return compile_emulator(Path(request.config.cache.mkdir("cuda-emulator")))


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
def test_matches_the_reference_in_every_schedule(name, library):
    scene, _, norms, _, maps = judged(name)
    found = everything(scene, partial(render_on, Emulator(library)), norms)
    check(name, found)
    for schedule in SCHEDULES:
        again = everything(scene, partial(render_on, Emulator(library, schedule)), norms)
        assert same_bits(again, found), schedule
    with torch.no_grad():
        mine = scene.call(partial(render_on, Emulator(library)), scene.leaves(torch.float32)).ray_maps
    for ours, theirs in zip(mine, maps, strict=True):
        assert ours.transmittance.shape == theirs.transmittance.shape
        assert ours.transmittance.numel() == 0 or ours.origin == pytest.approx(theirs.origin)


@pytest.mark.parametrize("name", MATRIX)
@pytest.mark.parametrize("step", step_cases.STEPS)
def test_every_step_matches_its_twin_in_every_schedule(step, name, library):
    found = step_cases.found_by(partial(cuda.Pass, Emulator(library)), step, name)
    step_cases.check(step, name, found)
    for schedule in ("backwards", "shuffled"):
        again = step_cases.found_by(partial(cuda.Pass, Emulator(library, schedule)), step, name)
        assert same_bits(again, found), schedule


@pytest.mark.parametrize("channels", [1, 4, 5, 9])
def test_channels_are_single_splats(channels, library):
    new_pass, generator = partial(cuda.Pass, Emulator(library)), torch.Generator().manual_seed(channels)
    pixels = project(cloud(40, 1), VIEWS, GRID).pixels

    def run(cross_sections, seeds):
        leaves = [t.detach().clone().requires_grad_() for t in (pixels.centers, pixels.roots, cross_sections)]
        images = splat_with(new_pass, Footprints(*leaves[:2]), leaves[2], GRID, imaging_weight="area")
        return [images.detach().double(), *(g.double() for g in torch.autograd.grad(images, leaves, seeds))]

    cross_sections = torch.randn(3, 40, channels, generator=generator)
    seeds = torch.randn(3, channels, GRID.rows, GRID.columns, generator=generator)
    images, d_centers, d_roots, d_cross_sections = run(cross_sections, seeds)
    single = [run(cross_sections[..., c : c + 1], seeds[:, c : c + 1]) for c in range(channels)]
    assert relative(images, torch.cat([each[0] for each in single], dim=1)) <= 1e-6
    assert relative(d_centers, sum(each[1] for each in single)) <= 1e-5
    assert relative(d_roots, sum(each[2] for each in single)) <= 1e-5
    assert relative(d_cross_sections, torch.cat([each[3] for each in single], dim=2)) <= 1e-6


def test_steps_refuse_bad_values(library):
    new_pass, p = partial(cuda.Pass, Emulator(library)), project(cloud(10, 0), VIEWS, GRID)
    rays = RayGrid.for_image(GRID)

    def bad(tensor: torch.Tensor, index: tuple[int, ...], value: float) -> torch.Tensor:
        changed = tensor.clone()
        changed[index] = value
        return changed

    wrong = replace(p, rays=replace(p.rays, roots=bad(p.rays.roots, (2, 3, 0), 0.0)))
    with pytest.raises(SarsplatError, match=r"rays.roots\[2, 3\] is \[0.0.*; it must be .* at least 1e-08"):
        attenuate_with(new_pass, wrong, rays, first_return_depth=None)
    with pytest.raises(SarsplatError, match=r"range_m\[1, 0\] is nan; it must be finite metres"):
        attenuate_with(new_pass, replace(p, range_m=bad(p.range_m, (1, 0), math.nan)), rays, first_return_depth=None)
    far = replace(p, rays=replace(p.rays, centers=bad(p.rays.centers, (1, 0, 0), 1e6)))
    with pytest.raises(SarsplatError, match=r"view 1 would need too many rays .* reach 1e\+06 m"):
        attenuate_with(new_pass, far, rays, first_return_depth=None)
    with pytest.raises(SarsplatError, match=r"cross_sections\[0, 9\] is \[inf\]; it must be finite"):
        splat_with(new_pass, p.pixels, bad(torch.ones(3, 10, 1), (0, 9, 0), math.inf), GRID, imaging_weight="area")
    with pytest.raises(SarsplatError, match=r"means\[4\] is \[nan.*\]; it must be finite metres"):
        scene = cloud(10, 0)
        project_with(
            new_pass, replace(scene, means=bad(scene.means, (4, 0), math.nan)), VIEWS, GRID, rays=rays, shift=None
        )


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
def test_memory_is_written_before_it_is_read_and_never_beyond_its_end(name, emulated, library, monkeypatch):
    scene, _, norms, *_ = judged(name)
    expected = everything(scene, emulated, norms)
    guarded, margin = [], 1024

    def new(self: cuda.Pass, key: str, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        whole = torch.full((math.prod(shape) * dtype.itemsize + 2 * margin,), 255, dtype=torch.uint8)  # NaN, or -1
        guarded.append(whole)
        return self._keep(key, whole[margin:-margin].view(dtype).view(shape))

    steps = {step: step_cases.found_by(partial(cuda.Pass, Emulator(library)), step, name) for step in step_cases.STEPS}
    monkeypatch.setattr(cuda.Pass, "_new", new)
    assert same_bits(everything(scene, emulated, norms), expected)
    for step, once in steps.items():
        assert same_bits(step_cases.found_by(partial(cuda.Pass, Emulator(library)), step, name), once), step
    assert len(guarded) > 20
    for whole in guarded:
        assert bool((whole[:margin] == 255).all() and (whole[-margin:] == 255).all())


# ---- the emulator tells right from wrong ----------------------------------------------------------------------------
def mutated(folder: Path, library_folder: Path, before: str, after: str, which: int) -> Path:
    """The emulator with one place of the kernels' source changed."""
    folder.mkdir()
    for path in nvrtc.SOURCES.iterdir():
        if path.suffix in (".cu", ".cuh", ".h"):
            (folder / path.name).write_text(path.read_text())
    rays = folder / "cuda_rays.cuh"
    parts = rays.read_text().split(before)
    assert len(parts) > which + 1
    rays.write_text(before.join(parts[: which + 1]) + after + before.join(parts[which + 1 :]))
    return compile_emulator(library_folder, folder, flags=())


def runs(library: Path) -> list[dict[str, torch.Tensor]]:
    scene, _, norms, *_ = judged("overlap")
    return [everything(scene, partial(render_on, Emulator(library, schedule)), norms) for schedule in SCHEDULES]


@pytest.mark.parametrize(
    "barrier", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_a_missing_barrier_shows(barrier, tmp_path):
    broken = mutated(tmp_path / "csrc", tmp_path, "    __syncthreads();\n", "", barrier)
    first, *others = runs(broken)
    assert not all(same_bits(first, other) for other in others)


@pytest.mark.slow
def test_a_divided_warp_shows(tmp_path):
    broken = mutated(tmp_path / "csrc", tmp_path, "if (__any_sync(kWholeWarp, live))", "if (live)", 0)
    with pytest.raises(RuntimeError, match="attenuate_tiles: threads"):
        runs(broken)


# ---- refusals -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("means", (3, 1), float("nan"), r"means\[3\] is \[.*nan.*\]; it must be finite metres"),
        ("quaternions", (4,), 0.0, r"quaternions\[4\] is \[0.0, 0.0, 0.0, 0.0\]; it must be finite and not zero"),
        ("scales", (9, 2), 5e-5, r"scales\[9\] is \[.*\]; it must be finite and at least MIN_SCALE"),
        ("optical_depth", (2,), 41.0, r"optical_depth\[2\] is 41.0; it must be between 0 and MAX_OPTICAL_DEPTH"),
        ("scattering", (7, 15), float("inf"), r"scattering\[7\] is \[.*inf\]; it must be finite"),
        ("means", (0, 0), 1e6, r"view 0 would need too many rays .* reach 1e\+06 m .* remove distant or wide ones"),
    ],
)
def test_values_out_of_range(name, index, value, message, emulated):
    scene = cloud(10, 0)
    tensor = scene.tensors()[name].clone()
    tensor[index] = value
    with pytest.raises(SarsplatError, match=message):
        emulated(scene.with_tensors(**{name: tensor}), VIEWS, GRID)


def test_values_beside_the_gaussians(emulated):
    bad = torch.ones(3, 10, 1)
    bad[1, 4] = bad[2, 2] = float("nan")
    with pytest.raises(SarsplatError, match=r"amplitudes\[1, 4\] is \[nan\]; it must be finite"):
        emulated(cloud(10, 0), VIEWS, GRID, amplitudes=bad)
    with pytest.raises(SarsplatError, match=r"shift\[2\] is \[0.0, inf\]; it must be finite metres"):
        emulated(cloud(10, 0), VIEWS, GRID, shift=torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, float("inf")]]))
    with pytest.raises(SarsplatError, match="too many rays at a spacing of"):
        emulated(cloud(10, 0), VIEWS, GRID, rays=RayGrid((1e-5, 1e-5)))


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


def test_auto_takes_the_gpu_and_says_so_once(caplog):
    _fitting.cache_clear()
    with caplog.at_level(logging.INFO, "sarsplat"):
        for _ in range(2):
            assert _fitting(torch.float32, "cuda") == "cuda"
            assert _fitting(torch.float64, "cuda") == "reference"
            assert _fitting(torch.float32, "mps") == "reference"
    assert caplog.messages.count("engine='auto' is 'cuda' for torch.float32 on cuda") == 1


# ---- compiled once --------------------------------------------------------------------------------------------------
class FakeCompiler:
    """Counts; "compiles" to a few bytes."""

    def __init__(self, version: str = "13.0") -> None:
        self.version, self.asked = version, []

    def compile(self, sources, architecture):
        assert "__global__" in sources["cuda_rays.cuh"]
        assert {"cstdint", nvrtc.MAIN} < set(sources)
        self.asked.append(architecture)
        return b"machine code\0for " + architecture.encode()


@pytest.fixture
def cache_folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "sarsplat"


def test_machine_code_is_kept(cache_folder, monkeypatch):
    compiler = FakeCompiler()
    for _ in range(3):
        assert nvrtc.machine_code("sm_90", compiler) == b"machine code\0for sm_90"
    assert compiler.asked == ["sm_90"]
    assert nvrtc.machine_code("sm_80", compiler) == b"machine code\0for sm_80"
    nvrtc.machine_code("sm_90", newer := FakeCompiler("13.1"))
    changed = nvrtc.sources() | {"pair_math.h": "// another source"}
    monkeypatch.setattr(nvrtc, "sources", lambda: changed)
    nvrtc.machine_code("sm_90", compiler)
    assert compiler.asked == ["sm_90", "sm_80", "sm_90"]
    assert newer.asked == ["sm_90"]
    assert len(list(cache_folder.iterdir())) == 4  # and nothing half-written


@pytest.mark.parametrize("content", [b"", b"short", bytes(200)])
def test_a_damaged_file_is_compiled_again(content, cache_folder):
    compiler = FakeCompiler()
    expected = nvrtc.machine_code("sm_90", compiler)
    (kept,) = cache_folder.iterdir()
    good = kept.read_bytes()
    for damaged in (content, good[:-1], good[:-1] + b"?"):
        kept.write_bytes(damaged)
        assert nvrtc.machine_code("sm_90", compiler) == expected
        assert kept.read_bytes() == good
    assert len(compiler.asked) == 4


def test_a_cache_folder_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(SarsplatError, match=r"cannot be kept in .*file/sarsplat .*; make it writable, or name another"):
        nvrtc.machine_code("sm_90", FakeCompiler())


# ---- the launcher, on an emulated driver ----------------------------------------------------------------------------
@pytest.fixture
def gpu(library, cache_folder, monkeypatch):
    monkeypatch.setattr(cuda_device, "_DRIVER", str(library))
    monkeypatch.setattr(cuda_device, "_driver", cuda_device._driver.__wrapped__)
    monkeypatch.setattr(cuda_device, "Nvrtc", FakeCompiler)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0x1234))
    return cuda_device.Device(torch.device("cpu", 0))


def test_the_launcher_hands_everything_to_the_driver(gpu, library):
    scene, _, norms, *_ = judged("shift and gain")
    expected = everything(scene, partial(render_on, Emulator(library)), norms)
    assert same_bits(everything(scene, partial(render_on, gpu), norms), expected)
    for step in step_cases.STEPS:
        first = step_cases.found_by(partial(cuda.Pass, Emulator(library)), step, "shift and gain")
        assert same_bits(step_cases.found_by(partial(cuda.Pass, gpu), step, "shift and gain"), first), step


def test_the_driver_refuses(gpu, monkeypatch):
    with pytest.raises(SarsplatError, match=r"driver failed with error 500 \(said the emulated driver\); restart"):
        gpu.launch("no such kernel", 1, 32)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0))
    with pytest.raises(SarsplatError, match="driver failed with error 1 "):
        gpu.launch("sum_shift", 1, 256)
