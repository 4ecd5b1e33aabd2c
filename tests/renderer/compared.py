"""Comparison of renderings: step by step, with their gradients, between engines and with finite differences."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from sarsplat import Gaussians, ImageGrid, RayGrid, View
from sarsplat.renderer import reference


def chained(
    steps: Any,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    imaging_weight: str,
    first_return_depth: float | None,
    amplitudes: Tensor | None = None,
    shift: Tensor | None = None,
    gain: Tensor | None = None,
) -> SimpleNamespace:
    """With these steps; as a rendering is."""
    p = steps.project(gaussians, views, grid, rays=rays, shift=shift)
    lit = steps.attenuate(p, rays, first_return_depth=first_return_depth)
    cross_sections = (p.amplitudes if amplitudes is None else amplitudes) * lit.lit_area[..., None]
    images = steps.splat(p.pixels, cross_sections, grid, imaging_weight=imaging_weight)
    images = images if gain is None else images * gain[:, None, None, None]
    made = {"images": images, "cross_sections": cross_sections, "lit_area": lit.lit_area}
    return SimpleNamespace(**made, ray_maps=lit.ray_maps, echoes=())


def differentiated(
    scene: Gaussians, dtype: torch.dtype, image_of: Callable[..., Tensor], **more: Tensor
) -> dict[str, Tensor]:
    """An image of the scene and of `more` tensors, in this dtype, and its gradients with random cotangents, by name."""
    leaves = {name: t.detach().to(dtype, copy=True).requires_grad_() for name, t in (scene.tensors() | more).items()}
    own = {name: leaves[name] for name in scene.tensors()}
    image = image_of(scene.with_tensors(**own), **{name: leaves[name] for name in more})
    cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64).to(image)
    found = torch.autograd.grad((image * cotangent).sum(), list(leaves.values()), allow_unused=True)
    named = {name: value for name, value in zip(leaves, found, strict=True) if value is not None}
    return {"image": image.detach(), **named}


def check_agreement(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """The image within 1e-5 of what is expected and gradients, of which none is zero, within 1e-4."""
    assert expected.keys() <= found.keys()
    for name, value in expected.items():
        assert float(value.norm()) > 0, name
        assert relative(found[name], value) <= (1e-5 if name == "image" else 1e-4), name


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    expected = expected.detach()
    difference = float((found.detach().double() - expected).norm())
    return difference / float(expected.norm()) if difference else 0.0


def same_bits(first: dict[str, torch.Tensor | None], second: dict[str, torch.Tensor | None]) -> bool:
    return all(
        mine is theirs
        or bool(
            mine is not None and theirs is not None and torch.equal(mine.view(torch.int32), theirs.view(torch.int32))
        )
        for mine, theirs in ((mine, second[name]) for name, mine in first.items())
    )


@contextmanager
def without_cuts() -> Iterator[None]:
    """Meanwhile the reference has no footprint cuts and no early stop, so that finite differences are valid."""
    with pytest.MonkeyPatch.context() as patch:
        # touched rays end where float64 does
        for name, value in {"MIN_RAY_DEPTH": 1e-18, "MIN_TRANSMITTANCE": 0.0, "IMAGE_CUT": math.inf}.items():
            patch.setattr(reference, name, value)
        yield


def check_gradients(function: Callable[..., Sequence[Tensor]], leaves: Sequence[Tensor], step: float = 1e-6) -> None:
    """Each output along three directions of each leaf, float64, to 1e-6 of its size and 1e-9; and twice the same bits.

    No row of a leaf is without gradient. Every element of the leaf changes in every direction. The backward pass, which
    is linear in the cotangents, is differentiated by them, which gives the changes of all outputs at once.
    """

    def flat(*values: Tensor) -> Tensor:
        return torch.cat([output.flatten() for output in function(*values)])

    outputs, generator = flat(*leaves), torch.Generator().manual_seed(12)
    once, twice = (torch.autograd.grad(outputs, leaves, outputs.detach().cos(), retain_graph=True) for _ in range(2))
    cotangents = torch.ones_like(outputs, requires_grad=True)
    gradients = torch.autograd.grad(outputs, leaves, cotangents, create_graph=True)
    for k, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        assert torch.equal(once[k], twice[k]), k
        assert (once[k].reshape(len(leaf) if leaf.ndim else 1, -1).norm(dim=1) > 1e-6).all(), k
        for _ in range(3):
            way = 0.5 + torch.rand(leaf.shape, generator=generator, dtype=leaf.dtype)
            way = torch.where(torch.rand(leaf.shape, generator=generator) < 0.5, way, -way)
            with torch.no_grad():
                above, below = (flat(*leaves[:k], leaf + one * way, *leaves[k + 1 :]) for one in (step, -step))
            expected = (above - below) / (2 * step)
            (found,) = torch.autograd.grad(gradient, cotangents, way, retain_graph=True)
            assert torch.allclose(found, expected, rtol=1e-6, atol=1e-9), (k, float((found - expected).abs().max()))
