"""Where tensors live and under which switches of torch they are rendered."""

from __future__ import annotations

import time

import pytest
import torch
from named_scenes import GRID, VIEWS, cloud

from sarsplat.errors import SarsplatError
from sarsplat.geometry import RayGrid
from sarsplat.renderer import render


@pytest.mark.parametrize("engine", ["auto", "cpu", "reference"])
def test_tensors_without_values_are_refused(engine):
    with pytest.raises(SarsplatError, match="means is on torch's meta device, which holds no values"):
        render(cloud(10, 0).to("meta"), VIEWS, GRID, engine=engine)
    with pytest.raises(SarsplatError, match="gain is on torch's meta device"):
        render(cloud(10, 0), VIEWS, GRID, gain=torch.ones(len(VIEWS), device="meta"), engine=engine)


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


def test_the_reference_refuses_at_once_what_would_take_hours():
    begun = time.monotonic()
    with pytest.raises(SarsplatError, match=r"too many rays at a spacing of \(0.001, 0.001\) m: .* use coarser rays"):
        render(cloud(60, 0), VIEWS, GRID, rays=RayGrid((0.001, 0.001)), engine="reference")
    assert time.monotonic() - begun < 2
