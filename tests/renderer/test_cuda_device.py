"""Around the CUDA engine's kernels: what is compiled and kept, the launcher, and the check that `auto` asks for."""

import ctypes
import logging
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache, partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from compared import chained, same_bits
from emulated_cuda import Emulator, render_on
from test_cpu_engine import everything, judged

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.learning import device_choice as training_device
from sarsplat.renderer.engines import choice, cuda, cuda_device, nvrtc, trial
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.operations import Steps

CPU = torch.device("cpu")


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
    nvrtc._warn.cache_clear()
    return tmp_path / "sarsplat"


# ---- compiled once --------------------------------------------------------------------------------------------------
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


def test_a_damaged_file_is_compiled_again(cache_folder):
    compiler = FakeCompiler()
    expected = nvrtc.machine_code("sm_90", compiler)
    (path,) = cache_folder.iterdir()
    good = path.read_bytes()
    for damaged in (b"", b"short", bytes(200), good[:-1], good[:-1] + b"?"):
        path.write_bytes(damaged)
        assert nvrtc.machine_code("sm_90", compiler) == expected
        assert path.read_bytes() == good
    assert len(compiler.asked) == 6


def test_a_cache_folder_that_cannot_be_written(cache_folder):
    cache_folder.touch()
    message = r"cannot be kept in .*/sarsplat \(.*\), so that every program begins with them; make it writable, or name"
    with pytest.warns(SarsplatWarning, match=message) as told:
        for _ in range(2):
            assert nvrtc.machine_code("sm_90", FakeCompiler()).startswith(b"machine code")
    assert len(told) == 1


# ---- the launcher, on an emulated driver ----------------------------------------------------------------------------
@pytest.fixture
def gpu(library, cache_folder, monkeypatch):
    monkeypatch.setattr(cuda_device, "_DRIVER", str(library))
    monkeypatch.setattr(cuda_device, "_driver", cuda_device._driver.__wrapped__)
    monkeypatch.setattr(cuda_device, "Nvrtc", FakeCompiler)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Emulated GPU")
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0x1234))
    return cuda_device.Device(torch.device("cpu", 0))


def test_the_launcher_hands_everything_to_the_driver(gpu, library):
    scene, _, norms, *_ = judged("shift and gain")
    expected = everything(scene, partial(render_on, Emulator(library)), norms)
    assert same_bits(everything(scene, partial(render_on, gpu), norms), expected)
    by_steps, once = (
        everything(scene, partial(chained, Steps(partial(cuda.Pass, launcher))), norms)
        for launcher in (gpu, Emulator(library))
    )
    assert same_bits(by_steps, once)


def test_a_kernel_runs_on_its_gpu_whichever_is_current(gpu, monkeypatch):
    asked = []
    monkeypatch.setattr(torch.cuda, "device", lambda device: asked.append(device) or nullcontext())
    sums = torch.ones(2)
    tiles = ctypes.c_void_p(sums.data_ptr()), ctypes.c_int64(1)
    arguments = api.loss(1, 1, 2, loss=sums[1:].data_ptr()), *tiles, ctypes.c_void_p(), ctypes.c_int64(0)
    gpu.launch("sum_loss", 1, 256, *arguments)
    assert asked == []
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    gpu.launch("sum_loss", 1, 256, *arguments)
    assert asked == [gpu.device]
    assert sums.tolist() == [1.0, 0.5]


def test_a_stream_of_ones_own_is_made_by_the_driver(gpu, monkeypatch):
    monkeypatch.setattr(torch.cuda, "ExternalStream", lambda address, device: (address, device))
    assert gpu.new_stream() == (0x1234, gpu.device)


def test_threads_that_ask_for_a_gpu_at_once_compile_it_once(monkeypatch):
    made, all_there = [], threading.Barrier(4, timeout=60)

    class Slow:
        def __init__(self, device: torch.device) -> None:
            made.append(device)
            time.sleep(0.05)

    monkeypatch.setattr(cuda_device, "Device", Slow)
    monkeypatch.setattr(cuda_device, "_device", cache(cuda_device._device.__wrapped__))

    def ask(_: int) -> object:
        all_there.wait()
        return cuda_device.device(3)

    with ThreadPoolExecutor(4) as pool:
        assert len({*pool.map(ask, range(4))}) == 1
    assert made == [torch.device("cuda", 3)]


def test_the_driver_refuses(gpu, monkeypatch):
    with pytest.raises(SarsplatError, match=r"driver failed with error 500 \(said the emulated driver\); restart"):
        gpu.launch("no such kernel", 1, 32)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0))
    with pytest.raises(SarsplatError, match="driver failed with error 1 "):
        gpu.launch("sum_shift", 1, 256)


# ---- what "auto" asks for -------------------------------------------------------------------------------------------
def _forget() -> None:
    for function in (trial.objection, choice._fitting, training_device._automatic):
        function.cache_clear()


class Trials:
    """Asks for the verdict as a new program would; counts the trials."""

    def __init__(self, gpu: cuda_device.Device, monkeypatch: pytest.MonkeyPatch) -> None:
        self.gpu, self.count = gpu, 0
        usual = trial._disagreement

        def counted(launcher: cuda_device.Device) -> str:
            self.count += 1
            return usual(launcher)

        monkeypatch.setattr(trial, "_disagreement", counted)
        monkeypatch.setattr(trial, "require_cuda", lambda: None)
        monkeypatch.setattr(trial, "device", lambda index: self.gpu)
        monkeypatch.setattr(training_device, "require_cuda", lambda: None)

    def __call__(self) -> str:
        _forget()
        return trial.objection(torch.device("cuda", 0))


@pytest.fixture
def trials(gpu, monkeypatch):
    yield Trials(gpu, monkeypatch)
    _forget()


@pytest.fixture
def passed(gpu, monkeypatch):
    """Trials that pass untried, for what is done with verdicts."""
    monkeypatch.setattr(trial, "_disagreement", lambda launcher: "")
    yield Trials(gpu, monkeypatch)
    _forget()


ON_GPU = SimpleNamespace(dtype=torch.float32, device=torch.device("cuda", 0))


def test_auto_takes_a_gpu_that_agrees_and_says_so_once(passed, caplog):
    assert passed() == ""
    with caplog.at_level(logging.INFO, "sarsplat"):
        assert [choice.chosen_engine("auto", ON_GPU) for _ in range(2)] == ["cuda", "cuda"]
    assert caplog.messages == ["engine='auto' is 'cuda' for torch.float32 on cuda:0"]
    assert training_device.device_named("auto") == ON_GPU.device
    elsewhere = SimpleNamespace(dtype=torch.float32, device=torch.device("mps"))
    assert choice.chosen_engine("auto", elsewhere) == "reference"
    double = SimpleNamespace(dtype=torch.float64, device=ON_GPU.device)
    assert choice.chosen_engine("auto", double) == "reference"


def test_the_verdict_is_kept_until_something_changes(passed, monkeypatch, tmp_path):
    assert [passed(), passed()] == ["", ""]
    assert passed.count == 1
    for path in (tmp_path / "sarsplat").glob("trial-*"):
        path.write_bytes(b"damaged")
    assert passed() == ""
    assert passed.count == 2
    monkeypatch.setattr(passed.gpu, "description", "Emulated GPU, sm_90, driver of CUDA 13010")
    assert passed() == ""
    assert passed.count == 3
    changed = nvrtc.sources() | {"pair_math.h": "// another source"}
    monkeypatch.setattr(trial.nvrtc, "sources", lambda: changed)
    assert passed() == ""
    assert passed.count == 4


def test_a_wrong_kernel_means_one_warning_and_the_cpu(trials, monkeypatch):
    usual = trials.gpu.launch

    def launch(name: str, blocks: int, threads: int, problem: ctypes.Structure, *others: "ctypes._CData") -> None:
        if name == "attenuate_chunks":  # whose rays stop far too early
            problem = type(problem).from_buffer_copy(problem)
            problem.min_transmittance = 0.9
        usual(name, blocks, threads, problem, *others)

    monkeypatch.setattr(trials.gpu, "launch", launch)
    reason = trials()
    assert reason.startswith("its images of harmonics differ from the CPU engine's by a part of 0.")
    assert (trials(), trials.count) == (reason, 1)
    with pytest.warns(SarsplatWarning, match="the CPU is used, because the CUDA engine did not pass its") as told:
        assert [training_device.device_named("auto") for _ in range(3)] == [CPU] * 3
    assert len(told) == 1
    assert training_device.device_named("cuda") == ON_GPU.device
    assert choice.chosen_engine("cuda", ON_GPU) == "cuda"
    message = r"engine='auto' does not use the cuda engine on cuda:0: its images .*; move the tensors to the CPU, or"
    with pytest.raises(SarsplatError, match=message):
        choice.chosen_engine("auto", ON_GPU)


@pytest.mark.parametrize(
    ("error", "reason", "again"),
    [
        (RuntimeError("CUDA error: illegal access\nCompile with"), "it failed when it was tried (CUDA error: ", False),
        (torch.OutOfMemoryError("CUDA out of memory. Tried"), "it could not be tried (", True),
    ],
)
def test_a_gpu_that_fails_is_not_asked_again_but_one_that_is_full(trials, monkeypatch, error, reason, again):
    def launch(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(trials.gpu, "launch", launch)
        said = trials()
    assert said.startswith(reason) and "\n" not in said
    assert trials() == ("" if again else said)
    assert trials.count == 1 + again


def test_what_prevents_the_check_is_not_kept(passed, monkeypatch):
    def missing(index: int) -> None:
        raise SarsplatError("NVRTC, which compiles the CUDA engine, cannot be loaded; install it")

    with monkeypatch.context() as patch:
        patch.setattr(trial, "device", missing)
        assert passed().startswith("NVRTC, which compiles")
    assert passed() == ""


def test_the_check_runs_whatever_torch_is_set_to(trials):
    with torch.inference_mode(), torch.device("meta"):
        assert trials() == ""


# ---- libraries ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("platform", "wheel", "inside_torch", "system"),
    [
        ("linux", "lib/libnvrtc.so", "libnvrtc.so", "libnvrtc.so"),
        ("win32", "bin/x86_64/nvrtc64_", "nvrtc64_", "nvrtc64_"),
    ],
)
def test_where_nvrtc_is_looked_for(platform, wheel, inside_torch, system, tmp_path, monkeypatch):
    """Of torch's own CUDA first, without those for other drivers."""
    ending = {"linux": (".12", ".13"), "win32": ("120_0.dll", "130_0.dll")}[platform]
    own = (tmp_path / "nvidia" / "cu13" / (wheel + ending[1]), tmp_path / "torch" / "lib" / (inside_torch + ending[1]))
    other = tmp_path / "nvidia" / "cuda_nvrtc" / (wheel + ending[0]).replace("x86_64/", "")
    for path in (*own, other):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        path.with_name(path.name.replace("64_130_0.", "64_130_0.alt.").replace(".so.", ".alt.so.")).touch()
    monkeypatch.setattr(sys, "platform", platform)
    spec = spec_from_file_location("nvrtc_elsewhere", nvrtc.__file__)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    wheels = SimpleNamespace(submodule_search_locations=[str(tmp_path / "nvidia")])
    monkeypatch.setattr(module, "find_spec", lambda name: wheels)
    monkeypatch.setattr(torch, "__file__", str(tmp_path / "torch" / "__init__.py"))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert module._candidates() == [*own, other, Path(system + ending[1])]
