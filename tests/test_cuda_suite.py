"""The GPU's measuring program without a GPU: the emulator in its place, in small; and its time, errors and files."""

import ast
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from emulated_cuda import Emulator, on_emulated_gpu
from torch.profiler import DeviceType

from programs import ROOT
from sarsplat.scenes.targets import TARGETS
from sarsplat.settings.presets import PRESETS

BENCHMARKS = ROOT / "benchmarks"
ON_A_GPU_BOX = ("cuda_suite", "clock", "gpu", "naive_torch", "results", "scene", "work")


@pytest.fixture
def suite(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("benchmarks/cuda_suite")


@pytest.fixture
def emulator(library: Path) -> Iterator[Emulator]:
    """On the CPU, all that a GPU would do is emulated."""
    with on_emulated_gpu(emulator := Emulator(library)):
        yield emulator


@pytest.fixture
def gpu(suite: ModuleType, emulator: Emulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What the sections measure: it has no clock, no memory and no queue of its own."""
    rows = [
        SimpleNamespace(device_type=place, key=str(place), self_device_time_total=ms * 1e3)
        for place, ms in ((DeviceType.CUDA, 2.0), (DeviceType.CPU, 1.0))
    ]
    monkeypatch.setattr("gpu.profile", lambda: nullcontext(SimpleNamespace(key_averages=lambda: rows)))
    monkeypatch.setitem(TARGETS, "t72", cache(TARGETS["t72"]))

    class Emulated(suite.Gpu):
        device, launcher = "cpu", emulator

        def about(self) -> dict[str, Any]:
            return {"device": "Emulated GPU", "torch": torch.__version__, "nvrtc": "none"}

        def properties(self) -> dict[str, Any]:
            return {}

        def synchronise(self) -> None:
            pass

        def moment(self) -> SimpleNamespace:
            now = time.perf_counter()
            return SimpleNamespace(now=now, elapsed_time=lambda later: 1e3 * (later.now - now))

        def begin_queue(self) -> None:
            pass

        def peak_bytes(self, program: Callable[[], object]) -> int:
            return 0

        def waits(self, program: Callable[[], object]) -> dict[str, int]:
            program()
            return {}

    return Emulated(tmp_path, quick=True)


def kept(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_a_quick_run_fills_every_section_and_the_page(suite, gpu, module, tmp_path, monkeypatch):
    (tool := tmp_path / "compute-sanitizer").write_text("#!/bin/sh\necho ========= ERROR SUMMARY: 0 errors\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    path = suite.measure(gpu, tmp_path)
    assert path.name == "cuda-emulated-gpu-quick.json"
    results = kept(path)
    assert {name: section.get("error") for name, section in results["sections"].items()} == dict.fromkeys(
        suite.SECTIONS
    )
    assert all(section["done"] and section["found"] for section in results["sections"].values())
    found = {name: section["found"] for name, section in results["sections"].items()}
    for scene in found["scenes"].values():
        assert scene["values"] < 1e-5
        assert scene["gradients"] < 1e-4
        assert scene["same_bits"]
    assert found["steps"].keys() == {"default", "paper", "measured", "default with ground"}
    for name, part in found["recording"].items():
        assert part["same_bits"]
        assert part["recorded"], name
        assert min(part["recorded_ms"], part["launched_ms"]) > 0
    assert [part["training_s"] > 0 for part in found["paper"].values()] == [True, True]
    assert found["fleet"].keys() == {"1", "2"}
    assert all(part["same_bits"] and part["per_minute"] > 0 for part in found["fleet"].values())
    assert found["waits"].keys() == {*PRESETS, "default with ground", "default with terrain"}
    paced = [part for name in ("steps", "kernels") for part in found[name].values() if "views" in part]
    assert len(paced) == 4 + 5
    for part in paced:
        assert part["step_ms"] == pytest.approx(part["views"] * part["per_view_ms"])
        assert part["busy_ms"] == {"all": 2.0, "DeviceType.CUDA": 2.0}
        assert part["kernel_ms_per_view"]["attenuate_chunks"] > 0
        assert part.get("same_bits", True)
        for plane in part["lists"].values():
            assert 0 < plane["longest"] <= plane["used"] <= plane["slots"]
            assert plane["filled"] <= plane["tiles"]
    text = module("benchmarks/performance_page").cuda(results).replace("\n", " ")
    assert text.startswith("Emulated GPU: 2 scenes agree")
    for said in (
        "a training step: demo, 4 rays",
        "a training step: preset measured",
        "memcheck, racecheck find no fault",
        "Steps that the GPU replays as a CUDA graph, instead of kernels that Python launches, take: `default` ",
        "they learn the same bits",
        " (1 at a time), ",
    ):
        assert said in text
    assert not [word for word in ("nan", "FAULTS", "Not measured") if word in text]


@pytest.fixture
def stub(suite: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A GPU for sections that ask nothing of it: its clock, and how to run them."""
    clock = SimpleNamespace(now=0.0)  # advances when it is told
    monkeypatch.setattr(suite.time, "monotonic", lambda: clock.now)

    def run(seconds: float = 100.0, only: tuple[str, ...] = (), **sections: tuple[Any, float]) -> Path:
        monkeypatch.setattr(suite, "SECTIONS", sections)
        gpu = SimpleNamespace(quick=False, about=lambda: {"device": "Wheel 3"})
        return suite.measure(gpu, tmp_path, seconds, only)

    return SimpleNamespace(clock=clock, run=run, path=tmp_path / "cuda-wheel-3.json")


def test_a_section_that_fails_keeps_what_it_found_and_stops_no_other(stub):
    def broken(gpu):
        yield "first", 1
        assert kept(stub.path)["sections"]["broken"]["found"] == {"first": 1}  # at once
        raise SystemExit("it is over")

    def whole(gpu):
        assert kept(stub.path)["sections"]["broken"]["error"] == "SystemExit: it is over"
        yield "second", {"a": 2.0}

    sections = kept(stub.run(broken=(broken, 1), whole=(whole, 1)))["sections"]
    assert not sections["broken"]["done"]
    assert sections["broken"]["found"] == {"first": 1}
    assert sections["whole"]["done"]
    assert sections["whole"]["found"] == {"second": {"a": 2.0}}
    assert "error" not in sections["whole"]


def test_the_time_is_kept(stub, capsys):
    def slow(gpu):
        for k in range(1000):
            stub.clock.now += 30
            yield f"{k}", k

    def none(gpu):
        yield from ()

    sections = kept(stub.run(100, short=(none, 100), long=(none, 101), slow=(slow, 50), last=(none, 1)))["sections"]
    assert sections.keys() == {"short", "slow"}  # what was not run is absent
    assert len(sections["slow"]["found"]) == 4
    assert sections["slow"]["error"] == "TimeoutError: the time was used up"
    said = capsys.readouterr().out
    assert "long: not run; it takes about 101 s, and 100 s are left" in said
    assert "last: not run; it takes about 1 s, and 0 s are left" in said


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_it_says_in_a_sentence_that_there_is_no_gpu(suite, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["cuda_suite.py"])
    with pytest.raises(SystemExit, match="2"):
        suite.main()
    out, said = capsys.readouterr()
    assert out == ""
    assert said.startswith("cuda_suite runs only where there is an NVIDIA GPU: ")
    assert said.endswith("; the CPU is measured by `make bench`\n")
    assert said.count("\n") == 1


def test_what_runs_on_a_gpu_box_begins_with_torch_numpy_and_the_renderer_only():
    """The sections that prove and time kernels need none of the extras."""
    allowed = {"torch", "numpy", *ON_A_GPU_BOX, *sys.stdlib_module_names}
    ours = {"errors", "gaussians", "geometry", "renderer"}
    for name in ON_A_GPU_BOX:
        tree = ast.parse((BENCHMARKS / f"{name}.py").read_text(encoding="utf-8"))
        found = {alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names}
        found |= {node.module for node in tree.body if isinstance(node, ast.ImportFrom) and node.module}
        assert {each.split(".")[1] for each in found if each.startswith("sarsplat.")} <= ours, name
        assert {each.split(".")[0] for each in found} - {"sarsplat"} <= allowed, name


def test_sections_run_alone_leave_the_others_as_they_were(stub):
    def counted(number):
        def section(gpu):
            yield "number", number

        return section, 1

    stub.run(one=counted(1), two=counted(2))
    sections = kept(stub.run(only=("two",), one=counted(3), two=counted(4)))["sections"]
    assert {name: section["found"]["number"] for name, section in sections.items()} == {"one": 1, "two": 4}
    assert kept(stub.run(two=counted(5)))["sections"].keys() == {"two"}


def test_waits_are_counted_by_line(suite, tmp_path, monkeypatch):
    modes = []
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)

    def program() -> None:
        for _ in range(3):
            warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
        warnings.warn("something else", stacklevel=1)

    ((line, count),) = suite.Gpu(tmp_path, quick=True).waits(program).items()
    assert line.startswith("test_cuda_suite.py:")
    assert count == 3
    assert modes == ["warn", "default"]
