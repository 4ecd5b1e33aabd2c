"""Covariances between polarisations: what a Gaussian's parameters mean, and their gradients."""

from dataclasses import replace

import pytest
import torch

from sarsplat import Polarimetric
from sarsplat.gaussians.law_polarimetric import covariances_between

NAMES = {2: ("HH", "VV"), 3: ("HH", "HV", "VV"), 4: ("HH", "HV", "VH", "VV")}


def law(count: int, gaussians: int = 5, harmonics: int = 4) -> Polarimetric:
    parameters = torch.randn(
        gaussians, count**2 + harmonics, generator=torch.Generator().manual_seed(count), dtype=torch.float64
    )
    return Polarimetric(parameters, 0.05, NAMES[count])


def directions(count: int = 3) -> torch.Tensor:
    u = torch.randn(count, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    return torch.nn.functional.normalize(u, dim=1)


def amplitudes(of: Polarimetric) -> torch.Tensor:
    n = len(of.parameters)
    return of.amplitudes(directions(), torch.zeros(n, 4).double(), torch.ones(n, 3).double())


@pytest.mark.parametrize("count", NAMES)
def test_matrices_are_those_of_the_factor_and_gamma0_is_their_mean_power(count):
    of = law(count)
    found = covariances_between(amplitudes(of), count)
    gamma0 = amplitudes(of)[..., 0]
    shape = of.parameters[:, 1 : 1 + count**2]
    factor = torch.diag_embed(torch.log1p(shape[:, :count].exp())).to(torch.complex128)
    rows, columns = torch.tril_indices(count, count, -1)
    factor[:, rows, columns] = torch.complex(*shape[:, count:].contiguous().chunk(2, 1))
    product = factor @ factor.mH
    expected = product / (product.diagonal(dim1=1, dim2=2).real.sum(1) / count)[:, None, None]
    torch.testing.assert_close(found, gamma0[..., None, None] * expected)
    assert torch.linalg.eigvalsh(found).min() > 0
    torch.testing.assert_close(found.diagonal(dim1=-2, dim2=-1).real.mean(-1), gamma0)
    assert len(of.channels) == 1 + count**2 == amplitudes(of).shape[-1]


def test_a_training_starts_with_polarisations_alike_and_uncorrelated():
    start = Polarimetric.initial(4, 0.5, 0.03).for_polarisations(("VV", "HH"))
    start = replace(start, parameters=start.parameters.double())
    found = covariances_between(amplitudes(start), 2)
    torch.testing.assert_close(found, 0.5 * torch.eye(2).to(found).expand(found.shape))
    assert start.settings() == {"p_min": 0.03, "polarisations": ("VV", "HH")}
    assert start.for_polarisations(("VV", "HH")) is start


def test_less_detail_leaves_the_matrix():
    of = law(3, harmonics=16)
    less = of.detailed(0)
    torch.testing.assert_close(less.parameters, of.parameters[:, :10])
    both = [covariances_between(amplitudes(one), 3) for one in (of, less)]
    per_power = [one / one.diagonal(dim1=-2, dim2=-1).real.mean(-1)[..., None, None] for one in both]
    torch.testing.assert_close(*per_power)
