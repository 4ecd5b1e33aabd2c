"""The CUDA engine on a GPU, against the float64 reference; and its source in NVRTC's hands, which needs no GPU."""

import importlib
import re
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
import torch
from compared import same_bits
from named_scenes import MATRIX, Scene, cloud
from test_cpu_engine import check, judged, loss_of, outputs_of

from sarsplat.errors import SarsplatError
from sarsplat.renderer import render
from sarsplat.renderer.engines import nvrtc

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


@needs_gpu
def test_tensors_on_two_devices():
    scene = MATRIX["overlap"]()
    with pytest.raises(SarsplatError, match=r"gain is torch.float32 on cpu; the CUDA engine takes"):
        render(cloud(10, 0).to("cuda"), scene.views, scene.grid, gain=torch.ones(3), engine="cuda")
