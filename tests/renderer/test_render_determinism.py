"""The CPU engine gives the same bits for any number of threads, any order of calls, and keeps no memory."""

import gc
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from compared import chained, same_bits
from named_scenes import GRID, MATRIX, VIEWS, Scene, cloud, some_dark
from test_cpu_engine import everything
from test_ground_bounce import everything as of_bounce
from test_stretched import everything as of_stretched

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.renderer import render
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


def leaves_of(gaussians: Gaussians) -> Gaussians:
    return gaussians.with_tensors(**{name: t.clone().requires_grad_() for name, t in gaussians.tensors().items()})


def gradients_of(images: torch.Tensor, scene: Gaussians) -> list[torch.Tensor]:
    return list(torch.autograd.grad((images**2).sum(), list(scene.tensors().values())))


def test_passes_between_forward_and_backward_do_not_disturb():
    scenes = [leaves_of(cloud(count, seed)) for count, seed in ((60, 1), (90, 2), (20, 3), (60, 4))]
    expected = [gradients_of(render(scene, VIEWS, GRID, engine="cpu").images, scene) for scene in scenes]
    images = [render(scene, VIEWS, GRID, engine="cpu").images for scene in scenes]  # all alive at once
    for k in (2, 0, 3, 1):
        for mine, theirs in zip(gradients_of(images[k], scenes[k]), expected[k], strict=True):
            assert torch.equal(mine, theirs)


def test_inputs_changed_in_place_are_noticed():
    scene = leaves_of(cloud(10, 1))
    images = render(scene, VIEWS, GRID, engine="cpu").images
    with torch.no_grad():
        scene.means.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images.sum().backward()


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
def test_memory_does_not_grow():
    scenes = [leaves_of(cloud(count, count)) for count in (500, 40)]

    def iterate(count: int) -> None:
        for k in range(count):
            scene = scenes[k % 2]
            rendering = render(scene, VIEWS, GRID, engine="cpu", first_return_depth=1.0 if k % 3 else None)
            if k % 5:  # now and then a forward pass is dropped without a backward one
                gradients_of(rendering.images, scene)

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
