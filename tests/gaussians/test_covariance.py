"""Rotation and covariance from quaternion and scales."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.transform import Rotation

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.gaussians.covariance import covariance, rotation_matrix


def test_rotation_is_scipys():
    q = torch.randn(50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = Rotation.from_quat(q.numpy()[:, [1, 2, 3, 0]]).as_matrix()  # scipy: scalar last
    assert rotation_matrix(q).numpy() == pytest.approx(expected, abs=1e-12)
    assert torch.allclose(rotation_matrix(-7.3 * q), rotation_matrix(q), atol=1e-12)


def test_covariance_has_the_scales_along_the_gaussians_axes():
    generator = torch.Generator().manual_seed(1)
    q = torch.randn(50, 4, dtype=torch.float64, generator=generator)
    s = torch.rand(50, 3, dtype=torch.float64, generator=generator) + 0.1
    matrix, axes = covariance(q, s), rotation_matrix(q)
    assert torch.equal(matrix, matrix.transpose(1, 2))
    assert torch.allclose(matrix @ axes, axes * (s**2)[:, None, :], atol=1e-12)


def test_gaussians_select_detach_and_convert():
    n = 5
    scene = Gaussians(
        torch.randn(n, 3).requires_grad_(),
        torch.randn(n, 4),
        torch.ones(n, 3),
        torch.ones(n),
        Harmonics(torch.zeros(n, 9), 0.1),
    )
    assert (len(scene), scene.scattering.degree) == (5, 2)
    some = scene[torch.tensor([True, False, True, False, False])]
    assert len(some) == 2
    assert some.scattering.p_min == 0.1
    assert torch.equal(some.means, scene.means[[0, 2]])
    assert some.means.requires_grad
    assert not some.detach().means.requires_grad
    assert {t.dtype for t in scene.to(torch.float64).tensors().values()} == {torch.float64}
    with pytest.raises(SarsplatError, match="use one floating dtype and one device"):
        scene.detach().with_tensors(**{name: t.long() for name, t in scene.detach().tensors().items()})
