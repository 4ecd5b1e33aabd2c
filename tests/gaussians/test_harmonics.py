"""Real spherical harmonics: an orthonormal basis, with the signs of 3D Gaussian splatting's files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sarsplat.gaussians.harmonics import harmonic_basis


def quadrature() -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights, exact for polynomials up to degree 15."""
    z, weight_z = np.polynomial.legendre.leggauss(8)
    phi = 2 * np.pi * np.arange(16) / 16
    ring = np.sqrt(1 - z**2)[:, None]
    u = np.stack([ring * np.cos(phi), ring * np.sin(phi), np.broadcast_to(z[:, None], (8, 16))], axis=-1)
    return torch.tensor(u.reshape(-1, 3)), torch.tensor(np.repeat(weight_z, 16) * 2 * np.pi / 16)


def test_orthonormal_on_the_sphere():
    u, weight = quadrature()
    basis = harmonic_basis(u, 3)
    assert torch.allclose((basis * weight[:, None]).T @ basis, torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_lower_degrees_are_a_prefix():
    u, _ = quadrature()
    for degree in range(3):
        assert torch.equal(harmonic_basis(u, degree), harmonic_basis(u, 3)[:, : (degree + 1) ** 2])


def test_signs_and_order():
    """The table of 3DGS: degree 1 is (−y, z, −x); the Condon–Shortley sign (−1)^m throughout."""
    x, y, z = 0.48, 0.6, 0.64
    found = harmonic_basis(torch.tensor([x, y, z], dtype=torch.float64), 3).tolist()
    expected = [
        0.28209479177387814,
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y)),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
        *(-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z),
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        *(1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)),
    ]
    assert found == pytest.approx(expected, rel=1e-12)


def test_against_associated_legendre_functions():
    scipy_special = pytest.importorskip("scipy.special")
    if not hasattr(scipy_special, "sph_harm_y"):
        pytest.skip("needs scipy ≥ 1.15")
    u, _ = quadrature()
    polar, azimuth = np.arccos(u[:, 2].numpy()), np.arctan2(u[:, 1].numpy(), u[:, 0].numpy())
    basis = harmonic_basis(u, 3).numpy()
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = scipy_special.sph_harm_y(degree, abs(m), polar, azimuth)  # holds (−1)^m
            real = y.real if m >= 0 else y.imag
            real = real * (math.sqrt(2) if m else 1)
            assert basis[:, degree * degree + degree + m] == pytest.approx(real, abs=1e-12), (degree, m)
