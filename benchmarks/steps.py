"""The steps project, attenuate and splat against `render`; several channels against one, splatted and rendered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from clock import in_turn, ratio, spread
from recipes import COUNT, halfway, training_view
from scene import Scene

from sarsplat.renderer import attenuate, project, render, splat
from sarsplat.scenes import paper_grid, paper_views

CHANNELS = 4
MANY = 16


def chain(scene: Scene) -> Callable[[], object]:
    """Images step by step, and the gradients that `Scene.step` has."""

    def step() -> object:
        g = scene.leaves
        projection = project(g, scene.views, scene.grid, rays=scene.rays, engine="cpu")
        lit_area = attenuate(projection, scene.rays, engine="cpu").lit_area
        images = splat(
            projection.pixels, projection.amplitudes * lit_area[..., None], scene.grid, engine="cpu"
        ).squeeze(1)
        return [images.detach(), *scene.gradients(images)]

    return step


def splatting(scene: Scene, channels: int) -> Callable[[], object]:
    """So many channels at once, forward and backward."""
    with torch.no_grad():
        pixels = project(scene.gaussians, scene.views, scene.grid, engine="cpu").pixels
    leaves = [pixels.centers.requires_grad_(), pixels.roots.requires_grad_()]
    generator = torch.Generator().manual_seed(channels)
    cross_sections = torch.rand(*leaves[0].shape[:2], channels, generator=generator).requires_grad_()
    cotangent = torch.rand(len(scene.views), channels, scene.grid.rows, scene.grid.columns, generator=generator)

    def step() -> object:
        images = splat(pixels, cross_sections, scene.grid, engine="cpu")
        return torch.autograd.grad(images, [*leaves, cross_sections], cotangent)

    return step


def rendering(scene: Scene, channels: int) -> Callable[[], object]:
    """A whole rendering of so many channels of given amplitudes, forward and backward."""
    generator = torch.Generator().manual_seed(channels)
    shape = len(scene.views), len(scene.gaussians), channels
    amplitudes = torch.rand(shape, generator=generator).requires_grad_()
    cotangent = torch.rand(len(scene.views), channels, scene.grid.rows, scene.grid.columns, generator=generator)
    leaves = [tensor for name, tensor in scene.leaves.tensors().items() if name != "scattering"]

    def step() -> object:
        made = render(scene.leaves, scene.views, scene.grid, rays=scene.rays, amplitudes=amplitudes, engine="cpu")
        return torch.autograd.grad(made.images, [*leaves, amplitudes], cotangent)

    return step


def measure(quick: bool) -> dict[str, Any]:
    """The chain's time over the fused pass's, and four channels' over one's."""
    count, repeats = (1000, 3) if quick else (COUNT, 60)
    views = tuple(view for view, _ in paper_views()[24:32])
    scenes = {"one view": training_view(count), "8 views": Scene(halfway(count).target(3), views, paper_grid())}
    found: dict[str, Any] = {"ratios": {}, "times": {}, "contenders_s": {}}
    for load, scene in scenes.items():
        contenders = {
            f"`project`, `attenuate`, `splat` / `render`: {load}": {"chain": chain(scene), "render": scene.step},
            f"`splat` of {CHANNELS} channels / one: {load}": {
                f"C = {channels}": splatting(scene, channels) for channels in (CHANNELS, 1)
            },
        } | {
            f"`render` of {channels} channels / harmonics: {load}": {
                f"rendered, C = {channels}": rendering(scene, channels),
                "render": scene.step,
            }
            for channels in (CHANNELS, MANY)
        }
        for name, programs in contenders.items():
            samples = in_turn(programs, repeats)
            found["ratios"][name] = ratio(*samples.values())
            found["contenders_s"][name] = [spread(seconds) for seconds in samples.values()]
            found["times"] |= {f"{who}, {load}": spread(seconds) for who, seconds in samples.items()}
    return found
