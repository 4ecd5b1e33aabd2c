"""Rotation and covariance from quaternion and scales."""

import pytest
import torch
from scipy.spatial.transform import Rotation

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
