"""The CPU engine: the same bits for any number of threads and order of calls; no memory is kept, or its lack unsaid."""

import gc
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from compared import chained, same_bits
from named_scenes import GRID, MATRIX, VIEWS, Scene, cloud, some_dark
from test_cpu_engine import everything
from test_echoes import everything as of_bounce
from test_stretched import everything as of_stretched
from torch.autograd.graph import saved_tensors_hooks
from torch.utils.checkpoint import checkpoint

from sarsplat import ImageGrid, RayGrid, render
from sarsplat.renderer.engines import cpu
from sarsplat.renderer.operations import Steps

# more Gaussians than fit one task, more views than bands, one view cut into bands; small scenes stay on one thread
SCENES = {
    "many": MATRIX["many"],
    "many views": MATRIX["many views"],
    "ground": lambda: replace(MATRIX["ground, shifted"](), gaussians=cloud(900, 62, scale=0.05)),
    "terrain": lambda: replace(MATRIX["terrain, shifted"](), gaussians=cloud(900, 62, scale=0.05)),
    "one view": lambda: Scene(cloud(2500, 60, size=(6.0, 3.0, 3.0), scale=0.05), VIEWS[:1]),
    "shift and gain": lambda: Scene(
        cloud(900, 61, scale=0.05), shift=torch.full((3, 2), 0.1), gain=torch.tensor([1.3, 0.2, 4.0])
    ),
    "three channels": lambda: Scene(cloud(3000, 5), amplitudes=some_dark(3, 3000)),
    "sixteen channels": lambda: Scene(cloud(3000, 5), amplitudes=some_dark(16, 3000)),
}
WORTH_WAKING = 2048  # as engine.cpp has it


def gains_of_one_large_image() -> dict[str, torch.Tensor]:
    """Gradients, summed over so many pixels that torch would share them out."""
    grid, gain = ImageGrid(256, 250, (0.01, 0.01), (0.1, 0.1)), torch.ones(1, requires_grad=True)
    seeds = torch.rand(20, 1, 256, 250, generator=torch.Generator().manual_seed(2))
    images = render(cloud(60, 1), VIEWS[:1], grid, rays=RayGrid((0.05, 0.05)), gain=gain).channel(0)
    return {"gains": torch.cat([torch.autograd.grad(images, gain, seed, retain_graph=True)[0] for seed in seeds])}


CALLS: dict[str, Callable[[], dict[str, torch.Tensor]]] = {
    **{name: partial(lambda make: everything(make(), render, {}, engine="cpu"), make) for name, make in SCENES.items()},
    "steps of many": lambda: everything(MATRIX["many"](), partial(chained, Steps(cpu.Pass)), {}),
    "steps of many views": lambda: everything(MATRIX["many views"](), partial(chained, Steps(cpu.Pass)), {}),
    "second bounce": lambda: of_bounce(cloud(3000, 8, scale=0.05), torch.float32, render),
    "stretched": lambda: of_stretched(cloud(3000, 8, scale=0.05), torch.float32, render),
    "gains": gains_of_one_large_image,
}


@pytest.mark.parametrize("name", CALLS)
def test_same_bits_for_any_number_of_threads_and_run_to_run(name, threads):
    if name in SCENES:
        scene = SCENES[name]()
        assert len(scene.views) * (len(scene.gaussians) + scene.grid.rows * scene.grid.columns / 16) > WORTH_WAKING
    threads(1)
    expected = CALLS[name]()
    for count in (1, 2, 3):
        threads(count)
        assert same_bits(CALLS[name](), expected), count


def test_passes_between_forward_and_backward_do_not_disturb():
    scenes = [Scene(cloud(count, seed)) for count, seed in ((60, 1), (90, 2), (20, 3), (60, 4))]
    leaves = [[*scene.leaves(torch.float32).values()] for scene in scenes]
    expected = [gradients(images(*own, scene=scene), own) for scene, own in zip(scenes, leaves, strict=True)]
    rendered = [images(*own, scene=scene) for scene, own in zip(scenes, leaves, strict=True)]  # all alive at once
    for k in (2, 0, 3, 1):
        assert equal(gradients(rendered[k], leaves[k]), expected[k])


def test_inputs_changed_in_place_are_noticed():
    leaves = SCENE.leaves(torch.float32)
    rendered = SCENE.call(render, leaves, engine="cpu").images
    with torch.no_grad():
        leaves["means"].add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        rendered.sum().backward()


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
def test_memory_does_not_grow():
    scenes = [Scene(cloud(size, size), first_return_depth=depth) for depth in (1.0, 1.0, None) for size in (500, 40)]
    leaves = [[*scene.leaves(torch.float32).values()] for scene in scenes]

    def iterate(count: int) -> None:
        for k in range(count):
            rendered = images(*leaves[k % 6], scene=scenes[k % 6])
            if k % 5:  # now and then a forward pass is dropped without a backward one
                torch.autograd.grad(rendered.square().sum(), leaves[k % 6])

    iterate(60)
    gc.collect()
    before = resident_bytes()
    iterate(200)
    gc.collect()
    assert resident_bytes() - before < 4 << 20  # one pass takes about 1 MB: a leak would be 200


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_autocast_changes_nothing(engine):
    def image_and_gradient(enabled: bool):
        scene = cloud(10, 0)
        scene.means.requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            images = render(scene, VIEWS, GRID, engine=engine).images
        images.square().sum().backward()  # outside, as torch's documentation asks for
        return images.detach(), scene.means.grad

    plain, cast = image_and_gradient(False), image_and_gradient(True)
    for expected, found in zip(plain, cast, strict=True):
        assert found.dtype == torch.float32
        assert torch.equal(found, expected)


# ---- the backward pass reads the tensors that torch hands it ---------------------------------------------------------
SCENE = Scene(cloud(300, 1))


def images(*parameters: torch.Tensor, scene: Scene = SCENE, output: str = "images") -> torch.Tensor:
    made = (tensor * 1.0 for tensor in parameters)
    return getattr(scene.call(render, dict(zip(scene.gaussians.tensors(), made)), engine="cpu"), output)


def gradients(rendered: torch.Tensor, parameters: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    _litter = [torch.full((300, k), 7.0) for k in (1, 3, 4, 16) for _ in range(8)]  # over what was freed
    return torch.autograd.grad(rendered.square().flatten(1).sum(1).sum(0), parameters)


def equal(found: tuple[torch.Tensor, ...], expected: tuple[torch.Tensor, ...]) -> bool:
    return all(torch.equal(mine, theirs) for mine, theirs in zip(found, expected, strict=True))


@pytest.mark.parametrize("output", ["images", "cross_sections"])
def test_checkpointing_and_saved_tensors_that_were_put_elsewhere(output):
    parameters, of_output = [*SCENE.leaves(torch.float32).values()], partial(images, output=output)
    expected = gradients(of_output(*parameters), parameters)
    again = checkpoint(of_output, *parameters, use_reentrant=False)
    assert equal(gradients(again, parameters), expected)
    with saved_tensors_hooks(lambda tensor: tensor.numpy().copy(), torch.from_numpy):
        rendered = of_output(*parameters)
    assert equal(gradients(rendered, parameters), expected)


def test_backward_passes_of_one_graph_on_two_threads():
    """Torch holds its lock during a backward pass in Python; ctypes lets go of it."""
    scene = Scene(cloud(3000, 3))
    parameters = [*scene.leaves(torch.float32).values()]
    rendered = images(*parameters, scene=scene)
    seeds = torch.randn(2, *rendered.shape, generator=torch.Generator().manual_seed(1))
    expected = [torch.autograd.grad(rendered, parameters, seed, retain_graph=True) for seed in seeds]
    right: list[bool] = []

    def work(k: int) -> None:
        for _ in range(60):
            right.append(equal(torch.autograd.grad(rendered, parameters, seeds[k], retain_graph=True), expected[k]))

    workers = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(right) == 120
    assert all(right)


# ---- what could end or starve the process, in a program of its own, which forks for most of it -----------------------
PROGRAM = """
import json, os, sys
sys.path.insert(0, sys.argv[1])
import torch
from named_scenes import GRID, VIEWS, cloud
from sarsplat import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import RayGrid
from sarsplat.renderer import render

def refused(call):
    try:
        call()
    except SarsplatError as error:
        return str(error)

def rows_went_away():
    parameters = [torch.nn.Parameter(tensor) for tensor in cloud(3000, 1).tensors().values()]
    images = render(Gaussians(*parameters[:4], Harmonics(parameters[4])), VIEWS, GRID, engine="cpu").images
    for parameter in parameters:
        parameter.data = parameter.data[:10].clone()
    said = refused(lambda: images.sum().backward())
    del images
    [torch.full((k,), 1.0) for k in range(3000)]
    return said

def leave(megabytes):
    size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (megabytes << 20), resource.RLIM_INFINITY))

def everything(count, spacing=0.1):
    scene = cloud(count, 1, degree=0)
    scene.means.requires_grad_()
    rays = RayGrid((spacing, spacing))
    return render(scene, VIEWS, GRID, first_return_depth=1.0, rays=rays).images

def starved(which):
    if which == "forward":
        leave(100)
        return refused(lambda: everything(300_000))
    if which == "rays":
        leave(100)
        return refused(lambda: everything(3, 0.0005))
    images = everything(240_000)  # whose backward pass outgrows what the forward pass left over
    leave(30)  # for the gradients themselves
    said = refused(lambda: images.sum().backward(retain_graph=True))
    leave(500)
    images.sum().backward()
    return said

def child(which):
    torch.set_num_threads(1)
    said = None
    if which != "forked":
        said = starved(which)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    print(json.dumps([which, said, torch.equal(render(small, VIEWS, GRID).images, before)]), flush=True)

torch.set_num_threads(1)  # threads have memory of their own, which would be left over
small = cloud(60, 1)
before = render(small, VIEWS, GRID, engine="cpu").images
for which in sys.argv[2:]:
    if which == "forked":
        torch.set_num_threads(2)
        render(small, VIEWS, GRID, engine="cpu")
    else:
        import resource
    if not (process := os.fork()):
        child(which)
        os._exit(0)
    os.waitpid(process, 0)
print(json.dumps(["rows went away", rows_went_away(), True]), flush=True)
"""
LIMITED = ["forward", "rays", "backward"]
"""Address space as Linux limits it; sanitizers need all of it."""


@pytest.fixture(scope="module")
def done() -> dict[str, tuple[str | None, bool]]:
    """What was said in each case, and whether the engine rendered the same afterwards."""
    cases = LIMITED if sys.platform == "linux" and "SARSPLAT_TEST_ENGINE" not in os.environ else []
    cases = [*cases, *["forked"] * hasattr(os, "fork")]
    arguments = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), *cases]
    program = subprocess.run(arguments, capture_output=True, text=True, timeout=100)
    assert program.returncode == 0, program.stderr
    found = {which: tuple(rest) for which, *rest in map(json.loads, program.stdout.splitlines())}
    return dict.fromkeys(cases, (program.stderr, False)) | found


def test_parameters_whose_rows_went_away_between_the_passes(done):
    said, _ = done["rows went away"]
    assert said.startswith("means had shape (3000, 3) when rendered and now has shape (10, 3)")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_renders_too(done):
    """On one thread, as torch's data loaders set it: OpenMP's threads do not survive a fork, with or without us."""
    assert done["forked"] == (None, True)


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space as Linux does")
@pytest.mark.skipif("SARSPLAT_TEST_ENGINE" in os.environ, reason="sanitizers need the address space")
@pytest.mark.parametrize("which", LIMITED)
def test_out_of_memory(which, done):
    sentence, same = done[which]
    assert sentence.startswith("there is not enough memory for the rendering; render fewer views")
    assert same
