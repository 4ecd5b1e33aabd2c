"""Gradients that are small beside others are right too: an optimiser like Adam does not see how small they are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from named_scenes import Scene, cloud, with_scales
from test_cpu_engine import AVAILABLE

from sarsplat.gaussians import Gaussians
from sarsplat.renderer import render


def gradient(gaussians: Gaussians, name: str, dtype: torch.dtype, **engine: str) -> torch.Tensor:
    scene = Scene(gaussians)
    leaves = scene.leaves(dtype)
    rendering = scene.call(render, leaves, **engine)
    loss = rendering.images.square().sum() + rendering.cross_sections.sum()
    return torch.autograd.grad(loss, leaves[name])[0]


def worst(gaussians: Gaussians, name: str, instruction_set: str) -> float:
    """Largest error of an element, relative to that element."""
    expected = gradient(gaussians, name, torch.float64, engine="reference")
    found = gradient(gaussians, name, torch.float32, engine="cpu", instruction_set=instruction_set)
    assert (expected != 0).all()
    return float(((found - expected) / expected).abs().max())


@pytest.mark.parametrize("instruction_set", AVAILABLE)
def test_the_thin_axis_of_a_disc(instruction_set):
    thin = with_scales(cloud(8, 3, kappa=(0.5, 2.0)), (0.5, 0.4, 2e-4))
    flat = replace(thin, quaternions=torch.tensor([[0.9, 0.3, 0.2, 0.1]]).expand(8, 4).contiguous())
    assert worst(flat, "scales", instruction_set) < 3e-3


@pytest.mark.parametrize("instruction_set", AVAILABLE)
@pytest.mark.parametrize("activation", [-3.0, -10.0, -20.0, -40.0])
def test_harmonics_far_below_the_least_scattering(activation, instruction_set):
    gaussians = cloud(6, 4, degree=0, kappa=(0.5, 2.0))
    faint = gaussians.with_tensors(scattering=torch.full((6, 1), activation / 0.28209479))
    assert worst(faint, "scattering", instruction_set) < 1e-4
