"""Covariances as few images: the engine's cross-sections of pairs, and pairs that share an image."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from named_scenes import cloud

from sarsplat import Gaussians, Harmonics, ImageGrid, Polarimetric, Stack, View, render_covariances
from sarsplat.renderer.covariances import elevated, lit_planes
from sarsplat.renderer.rendering import Footprints

VIEWS = [View(20.0, 35.0), View(200.0, 55.0)]
GRID = ImageGrid(12, 10, (0.4, 0.5), (0.6, 0.7))


@pytest.mark.parametrize(
    ("count", "pairs", "shared", "imaginary"), [(1, 1, True, False), (50, 3, True, False), (33, 2, False, True)]
)
def test_cross_sections_of_pairs_and_gradients_are_those_of_plain_torch(count, pairs, shared, imaginary):
    g = torch.Generator().manual_seed(count)
    v = len(VIEWS)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=g)

    inputs = [
        3 * normal(count, 3),
        normal(count, 4),
        0.1 + 0.5 * normal(count, 3).abs(),
        normal(v, count, 3).abs() + 0.3,
        normal(v, count, 1 if shared else pairs),
        *([normal(v, count, pairs)] if imaginary else []),
    ]
    numbers = np.random.default_rng(0).normal(size=(v, pairs))
    numbers[0, 0] = 0.0
    cotangents = normal(v, count, 2 * pairs), normal(v, count, 2)
    found = []
    for engine, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        own = [each.to(dtype).requires_grad_() for each in inputs]
        law = Harmonics(torch.ones(count, 1, dtype=dtype))
        scene = Gaussians(*own[:3], optical_depth=torch.ones(count, dtype=dtype), scattering=law)
        pixels = Footprints(torch.zeros(v, count, 2, dtype=dtype), own[3])
        outputs = elevated(scene, VIEWS, pixels, numbers, own[4], own[5] if imaginary else None, engine)
        gradients = torch.autograd.grad(outputs, own, [each.to(dtype) for each in cotangents])
        found.append([*outputs, *gradients])
    for own, true in zip(*found, strict=True):
        assert float((own.double() - true).detach().norm()) <= 2e-6 * float(true.detach().norm())


def scene(polarimetric: bool) -> Gaussians:
    law = Polarimetric(torch.randn(40, 10, generator=torch.Generator().manual_seed(0))) if polarimetric else None
    flat = cloud(40, 0, size=(6.0, 6.0, 6.0), scale=0.2, degree=0)
    return replace(flat, scattering=law or flat.scattering)


@pytest.mark.parametrize("polarimetric", [False, True])
def test_even_passes_share_images_and_others_do_not(polarimetric):
    names = ("HH", "HV", "VV") if polarimetric else ("",)

    def stack(passes: tuple[float, ...]) -> Stack:
        offsets = tuple(offset for offset in passes for _ in names)
        return Stack(0.031, offsets, polarisations=names * len(passes) if polarimetric else None)

    even, uneven = stack((-0.002, 0.0, 0.002)), stack((-0.002, 0.0007, 0.002))
    of_even, of_uneven = (lit_planes(scene(polarimetric), VIEWS, GRID, [one] * 2)[0] for one in (even, uneven))
    assert len(set(of_even.of_pairs)) < len(set(of_uneven.of_pairs)) <= len(of_uneven.of_pairs)
    assert of_even.powers.shape[1] == len(names)
    for pair in ((0, len(names)), (len(names), 2 * len(names))):  # alone, each has an image of its own
        alone = Stack(
            0.031,
            tuple(even.offsets_rad[i] for i in pair),
            polarisations=tuple(even.of_channels[i] for i in pair) if polarimetric else None,
        )
        whole = render_covariances(scene(polarimetric), VIEWS, GRID, even)
        expected = render_covariances(scene(polarimetric), VIEWS, GRID, alone)
        between = whole[:, pair[0], pair[1]] - expected[:, 0, 1]
        assert float(between.abs().max()) < 1e-4 * float(whole.abs().max())
