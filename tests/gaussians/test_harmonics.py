"""Real spherical harmonics: an orthonormal basis, with the signs of 3D Gaussian splatting's files."""

import numpy as np
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
    u, _ = quadrature()
    x, y, z = u.T
    expected = [
        torch.full_like(x, 0.28209479177387814),
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y)),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
        *(-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z),
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        *(1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)),
    ]
    torch.testing.assert_close(harmonic_basis(u, 3), torch.stack(expected, dim=1), rtol=0, atol=1e-12)
