"""The CUDA engine's kernels against the float64 reference: emulated on the CPU, in NVRTC's hands, and on a GPU."""

import importlib
import re
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from compared import chained, relative, same_bits
from emulated_cuda import SCHEDULES, Emulator, guarded, mutated, render_on, without_barrier
from named_scenes import GRID, MATRIX, VIEWS, Scene, cloud
from test_cpu_engine import check, everything, judged, loss_of, outputs_of, traced

from sarsplat import SarsplatError, render
from sarsplat.renderer.checks import check_for_cuda
from sarsplat.renderer.engines import cuda, cuda_device, cuda_tiles, nvrtc
from sarsplat.renderer.operations import Steps


@pytest.fixture(scope="session")
def emulated(library):
    return partial(render_on, Emulator(library))


@pytest.fixture(scope="session")
def in_short_chunks(library, tmp_path_factory) -> Path:
    """The emulator whose lists, short as they are in tests, are of several chunks."""
    folder = tmp_path_factory.mktemp("sources") / "csrc"
    return mutated(library.parent, folder, "cuda_state.cuh", "kChunk = 128", "kChunk = 32")


@pytest.fixture
def short_chunks(in_short_chunks, monkeypatch) -> Path:
    monkeypatch.setattr(cuda_tiles, "_CHUNK", 32)
    return in_short_chunks


@pytest.mark.parametrize("name", MATRIX)
def test_matches_the_reference_and_backwards_bit_for_bit(name, library):
    """Shuffled, the same kernels run in `test_cuda_bounds.py` and `test_steps.py`."""
    scene, _, norms, _, maps = judged(name)
    found = everything(scene, traced(maps, partial(render_on, Emulator(library))), norms)
    check(name, found)
    assert same_bits(everything(scene, partial(render_on, Emulator(library, "backwards")), norms), found)


@pytest.mark.parametrize("name", ["overlap", "opaque", "darkest", "depth ties", "three channels", "many", "many views"])
def test_lists_of_several_chunks_whether_ranked_or_sorted(name, short_chunks, monkeypatch):
    scene, _, norms, *_ = judged(name)
    found = [everything(scene, partial(render_on, Emulator(short_chunks, schedule)), norms) for schedule in SCHEDULES]
    check(name, found[0])
    assert all(same_bits(other, found[0]) for other in found[1:])
    monkeypatch.setattr(cuda_tiles, "_MAX_RANKED", 0)
    assert same_bits(everything(scene, partial(render_on, Emulator(short_chunks)), norms), found[0])


def chain_on(library: Path, schedule: str) -> partial:
    return partial(chained, Steps(partial(cuda.Pass, Emulator(library, schedule))))


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
    by_steps = everything(scene, chain_on(library, "in order"), norms)
    with guarded():
        assert same_bits(everything(scene, emulated, norms), expected)
        assert same_bits(everything(scene, chain_on(library, "backwards"), norms), by_steps)


# ---- the emulator tells right from wrong ----------------------------------------------------------------------------
def runs(library: Path) -> list[dict[str, torch.Tensor]]:
    scene, _, norms, *_ = judged("overlap")
    return [everything(scene, partial(render_on, Emulator(library, schedule)), norms) for schedule in SCHEDULES]


@pytest.mark.parametrize("barrier", range(6))  # all but the last, which threads that take turns hardly ever need
def test_a_missing_barrier_shows(barrier, short_chunks):
    right = runs(short_chunks)[0]
    with without_barrier(short_chunks, "cuda_rays.cuh", barrier):
        assert not all(same_bits(right, other) for other in runs(short_chunks))
    assert all(same_bits(right, other) for other in runs(short_chunks))


@pytest.mark.slow
def test_a_divided_warp_shows(tmp_path, library):
    before = "const unsigned all = near_warp"
    after = f"if (lane() == 0) continue;\n    {before}"
    broken = mutated(library.parent, tmp_path / "csrc", "cuda_rays.cuh", before, after)
    with pytest.raises(RuntimeError, match="attenuate_chunks: threads"):
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
    with pytest.raises(SarsplatError, match=r"the NVIDIA driver cannot be loaded .*libnothing.so.1.*; install it, or"):
        cuda_device._driver.__wrapped__()
    monkeypatch.setattr(nvrtc, "_candidates", lambda: [Path("libnothing.so.2"), Path("libnothing.so.3")])
    with pytest.raises(SarsplatError, match=r"NVRTC.* cannot be loaded \(libnothing.so.2: .*; libnothing.so.3"):
        nvrtc._load.__wrapped__()


def test_tensors_that_the_engine_does_not_take():
    on_gpu = SimpleNamespace(dtype=torch.float32, device=torch.device("cuda", 0))
    assert check_for_cuda({"means": on_gpu, "amplitudes": None}) == 0
    with pytest.raises(SarsplatError, match=r"scales is torch.float32 on cpu; the CUDA engine takes .* on a GPU"):
        check_for_cuda({"means": on_gpu, "scales": torch.ones(3)})
    elsewhere = SimpleNamespace(dtype=torch.float32, device=torch.device("cuda", 1))
    with pytest.raises(SarsplatError, match=r"gain is torch.float32 on cuda:1 but means is torch.float32 on cuda:0"):
        check_for_cuda({"means": on_gpu, "gain": elsewhere})


# ---- on a GPU; and the source in NVRTC's hands, which needs none -----------------------------------------------------
HERE = Path(__file__).parent
DOCS = HERE.parents[1] / "docs"
PAGE = (DOCS / "concepts" / "engines.md").read_text(encoding="utf-8")
KERNELS = re.findall(r"^KERNEL\((\w+)\)", (HERE / "emulator" / "kernels.h").read_text(), re.MULTILINE)

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")


@pytest.fixture(scope="module")
def registers() -> ModuleType:
    """The script that writes the table of docs/concepts/engines.md, where there is NVRTC."""
    try:
        nvrtc.Nvrtc()
    except SarsplatError as error:
        pytest.skip(f"{error}")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(DOCS)
        return importlib.import_module("write_registers")


def test_nvrtc_compiles_every_kernel_and_spills_nothing(registers):
    """Of the very sources of the page's table, the page is believed: four architectures take seven seconds."""
    known = f"<!-- of the sources {registers.digest()} -->" in PAGE
    block = re.search("<!-- registers: begin.*?<!-- registers: end", PAGE, re.DOTALL)
    table = block[0] if known else registers.table()
    assert sorted(re.findall(r"^\| `(\w+)`", table, re.MULTILINE)) == sorted(KERNELS)
    assert "spilled" not in table
    if f"NVRTC {nvrtc.Nvrtc().version}:" in PAGE:  # others count differently
        assert table in PAGE, "run python docs/write_registers.py"


def test_nvrtc_says_what_is_wrong(registers):
    wrong = nvrtc.sources() | {"pair_math.h": "#error no"}
    with pytest.raises(SarsplatError, match=r"cannot compile the CUDA engine for sm_75 \(.*error.*; install a torch"):
        nvrtc.Nvrtc().compile(wrong, "sm_75")
    with pytest.raises(SarsplatError, match=r"cannot compile the CUDA engine for sm_999 \(.*; install a torch"):
        nvrtc.Nvrtc().compile(nvrtc.sources(), "sm_999")


def on_gpu(scene: Scene, norms: dict[str, float], device: str = "cuda") -> dict[str, torch.Tensor]:
    """Every output and every gradient, brought back."""

    def renderer(gaussians, *arguments, **options):
        return render(gaussians.to(device), *arguments, engine="cuda", **options)

    leaves = scene.leaves(torch.float32)
    placed = {name: leaf.detach().to(device).requires_grad_() for name, leaf in leaves.items()}
    outputs = {name: t.cpu() for name, t in outputs_of(scene.call(renderer, placed)).items()}
    gradients = torch.autograd.grad(loss_of(outputs, norms), list(placed.values()), allow_unused=True)
    found = {name: t if t is None else t.cpu() for name, t in zip(placed, gradients, strict=True)}
    return {name: t.detach() for name, t in outputs.items()} | found


@needs_gpu
@pytest.mark.parametrize("name", MATRIX)
def test_matches_the_reference(name):
    scene, _, norms, _, _ = judged(name)
    found = on_gpu(scene, norms)
    check(name, found)


@needs_gpu
@pytest.mark.parametrize("name", ["many", "many views", "shift and gain"])
def test_same_bits_from_run_to_run(name):
    scene, _, norms, *_ = judged(name)
    first, *others = (on_gpu(scene, norms) for _ in range(5))
    assert all(same_bits(first, other) for other in others)


@needs_gpu
def test_auto_takes_the_gpu():
    scene = MATRIX["overlap"]()
    moved = scene.gaussians.to("cuda")
    call = partial(render, moved, scene.views, scene.grid)
    assert torch.equal(call().images, call(engine="cuda").images)
