"""The reference renderer's gradients against finite differences in float64, cuts off."""

from collections.abc import Callable, Sequence

import pytest
import torch
from named_scenes import GRADCHECK, GRID, VIEWS, cloud
from torch import Tensor

from sarsplat.renderer import Footprints, Waves, project
from sarsplat.renderer.reference import render_reference, splat_reference

SCENES = pytest.mark.parametrize("name", GRADCHECK)


def check_gradients(function: Callable[..., Sequence[Tensor]], leaves: Sequence[Tensor], step: float = 1e-6) -> None:
    """Each output along three directions of each leaf, float64, to 1e-6 of its size and 1e-9; and twice the same bits.

    Every element of the leaf changes in every direction. The backward pass, which is linear in the cotangents, is
    differentiated by them, which gives the changes of all outputs at once.
    """

    def flat(*values: Tensor) -> Tensor:
        return torch.cat([output.flatten() for output in function(*values)])

    outputs, generator = flat(*leaves), torch.Generator().manual_seed(12)
    once, twice = (
        torch.autograd.grad(outputs, leaves, outputs.detach().cos(), retain_graph=True, allow_unused=True)
        for _ in range(2)
    )
    cotangents = torch.ones_like(outputs, requires_grad=True)
    gradients = torch.autograd.grad(outputs, leaves, cotangents, create_graph=True, allow_unused=True)
    for k, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        assert once[k] is None or torch.equal(once[k], twice[k]), k
        for _ in range(3):
            way = 0.5 + torch.rand(leaf.shape, generator=generator, dtype=leaf.dtype)
            way = torch.where(torch.rand(leaf.shape, generator=generator) < 0.5, way, -way)
            with torch.no_grad():
                above, below = (flat(*leaves[:k], leaf + one * way, *leaves[k + 1 :]) for one in (step, -step))
            expected = (above - below) / (2 * step)
            found = torch.zeros_like(expected)
            if gradient is not None:
                (found,) = torch.autograd.grad(gradient, cotangents, way, retain_graph=True)
            assert torch.allclose(found, expected, rtol=1e-6, atol=1e-9), (k, float((found - expected).abs().max()))


@SCENES
def test_every_argument_of_every_output(name):
    scene = GRADCHECK[name]()
    leaves = scene.leaves(torch.float64)

    def outputs(*tensors):
        rendering = scene.call(render_reference, dict(zip(leaves, tensors, strict=True)), cuts=False)
        return (rendering.images, rendering.cross_sections, *(m.transmittance for m in rendering.ray_maps))

    check_gradients(outputs, tuple(leaves.values()))


@SCENES
def test_the_scenes_occlude_and_no_gradient_is_zero(name):
    scene = GRADCHECK[name]()
    leaves = scene.leaves(torch.float64)
    rendering = scene.call(render_reference, leaves, cuts=False)
    assert min(float(m.transmittance.detach().min()) for m in rendering.ray_maps) < 0.3
    # whoever stands in the shadow of others loses a good part of its lit area
    shares = []
    for i in range(len(scene.gaussians)):
        alone = scene.gaussians[i].to(torch.float64)
        free = render_reference(alone, scene.views, scene.grid, rays=scene.rays, cuts=False).lit_area[:, 0]
        shares.append(float((rendering.lit_area[:, i] / free).min()))
    assert min(shares) < 0.7
    for output in (rendering.images, rendering.cross_sections):
        weights = torch.linspace(1, 2, output.numel(), dtype=output.dtype).view_as(output)
        gradients = torch.autograd.grad(
            (output * weights).sum(), list(leaves.values()), retain_graph=True, allow_unused=True
        )
        for argument, gradient in zip(leaves, gradients, strict=True):
            if output is rendering.cross_sections and argument.startswith(("shift", "gain", "ground")):
                assert gradient is None  # they move and scale the image only
            else:
                rows = gradient.reshape(gradient.shape[0] if gradient.ndim else 1, -1)
                assert (rows.norm(dim=1) > 1e-6).all(), argument


def test_waves():
    """Phases that turn across footprints, which no rendering of power has."""
    g = torch.Generator().manual_seed(3)
    pixels = project(cloud(3, 3, scale=0.2).to(torch.float64), VIEWS[:2], GRID).pixels
    numbers = torch.tensor([[2.0], [-3.0]], dtype=torch.float64)
    parts, slopes = (torch.randn(2, 3, 2, dtype=torch.float64, generator=g) for _ in range(2))

    def waves(centers, roots, cross_sections, slopes):
        turned = Waves(numbers, slopes)
        return [splat_reference(Footprints(centers, roots), cross_sections, GRID, waves=turned, cuts=False)]

    leaves = pixels.centers, pixels.roots, parts, slopes
    check_gradients(waves, tuple(t.detach().clone().requires_grad_() for t in leaves))
