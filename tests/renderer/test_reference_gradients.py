"""The reference renderer's gradients against finite differences in float64, cuts off."""

import pytest
import torch
from compared import check_gradients
from named_scenes import GRADCHECK, GRID, VIEWS, cloud

from sarsplat.renderer import Footprints, Waves, project
from sarsplat.renderer.reference import render_reference, splat_reference

SCENES = pytest.mark.parametrize("name", GRADCHECK)


@SCENES
def test_every_argument_of_every_output(name):
    scene = GRADCHECK[name]()
    leaves = scene.leaves(torch.float64)

    def outputs(*tensors):
        rendering = scene.call(render_reference, dict(zip(leaves, tensors, strict=True)), cuts=False)
        return (rendering.images, rendering.cross_sections, *(m.transmittance for m in rendering.ray_maps))

    check_gradients(outputs, tuple(leaves.values()))


@SCENES
def test_the_scenes_occlude(name):
    scene = GRADCHECK[name]()
    rendering = scene.call(render_reference, scene.leaves(torch.float64), cuts=False)
    assert min(float(m.transmittance.detach().min()) for m in rendering.ray_maps) < 0.3
    # whoever stands in the shadow of others loses a good part of its lit area
    shares = []
    for i in range(len(scene.gaussians)):
        alone = scene.gaussians[i].to(torch.float64)
        free = render_reference(alone, scene.views, scene.grid, rays=scene.rays, cuts=False).lit_area[:, 0]
        shares.append(float((rendering.lit_area[:, i] / free).min()))
    assert min(shares) < 0.7


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
