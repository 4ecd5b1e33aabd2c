"""Laws of scattering: what they say, what they refuse, and that every one of them goes all the way round."""

import math
from dataclasses import replace

import pytest
import torch
from compared import check_agreement, differentiated
from named_scenes import cloud

from sarsplat import ImageGrid, Polarimetric, View, read_gaussians_ply, render, write_gaussians_ply
from sarsplat.gaussians import SCATTERINGS, Gaussians, Harmonics, NormalLobes, Scattering
from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.gaussians.law_harmonics import harmonic_basis
from sarsplat.gaussians.law_polarimetric import covariances_between


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def directions(count: int = 40) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator(1), dtype=torch.float64))


def scene(law: Scattering) -> Gaussians:
    shapes = cloud(len(law.parameters), 2, scale=0.2, kappa=(0.5, 1.5))
    return replace(shapes.to(torch.float64), scattering=law)


LAWS = {
    **{
        f"{kind}, as trainings start": replace(
            start := law.initial(6, 0.5, 0.05),
            parameters=(start.parameters + 0.1 * torch.randn(start.parameters.shape, generator=generator())).double(),
        )
        for kind, law in SCATTERINGS.items()
    },
    "harmonics": Harmonics(torch.randn(6, 16, generator=generator()).double(), 0.05),
    "a lobe each": NormalLobes(torch.randn(6, 3, generator=generator()).double(), 0.05),
}


def test_lobes_by_the_formula():
    law = LAWS["a lobe each"]
    gaussians = scene(law)
    u = directions()
    b, e = torch.log1p(law.parameters[:, :2].exp()), law.parameters[:, 2].exp()
    axes = rotation_matrix(gaussians.quaternions)
    n = torch.stack([axes[i, :, int(gaussians.scales[i].argmin())] for i in range(6)])
    expected = 0.05 + b[:, 0] + b[:, 1] * (u @ n.T).abs() ** e
    torch.testing.assert_close(gaussians.gamma0(u), expected)


@pytest.mark.parametrize("name", LAWS)
def test_never_below_the_least_and_the_same_from_both_sides_of_a_surface(name):
    gaussians, u = scene(LAWS[name]), directions()
    assert (gaussians.gamma0(u) >= LAWS[name].p_min).all()
    if isinstance(LAWS[name], NormalLobes):
        torch.testing.assert_close(gaussians.gamma0(u), gaussians.gamma0(-u))


@pytest.mark.parametrize("kind", SCATTERINGS)
def test_trainings_start_with_the_gamma0_asked_for_on_average_over_directions(kind):
    law = SCATTERINGS[kind].initial(5, 0.5, 0.03)
    gaussians = scene(replace(law, parameters=law.parameters.double()))
    assert gaussians.gamma0(directions()).mean() == pytest.approx(0.5, rel=0.05)
    assert law.detailed(0).parameters.shape[1] <= 16  # what the engine's Adam takes
    assert SCATTERINGS[kind](law.parameters, **law.settings()).settings() == law.settings()


def test_trainings_start_with_a_little_above_the_least():
    for law, excess in ((Harmonics, 1e-3), (NormalLobes, 1e-3 * (1 + 1 / 3))):  # of either number of a lobe
        start = law.initial(2, 0.02, 0.05)
        gamma0 = scene(replace(start, parameters=start.parameters.double())).gamma0(directions(4000))
        assert float(gamma0.mean()) == pytest.approx(0.05 + excess, rel=1e-3)


def test_less_detail_is_fewer_harmonics():
    law = LAWS["harmonics"]
    for degree in range(4):
        assert torch.equal(law.detailed(degree).parameters, law.parameters[:, : (degree + 1) ** 2])
    assert law.detailed(1).degree == 1
    assert LAWS["a lobe each"].detailed(0) is LAWS["a lobe each"]


@pytest.mark.parametrize("name", LAWS)
def test_gradients_reach_parameters_and_orientation(name):
    law = LAWS[name]
    gaussians, u = scene(law), directions(3)

    def amplitudes(parameters: torch.Tensor, quaternions: torch.Tensor) -> torch.Tensor:
        return replace(law, parameters=parameters).amplitudes(u, quaternions, gaussians.scales)

    leaves = law.parameters.clone().requires_grad_(), gaussians.quaternions.clone().requires_grad_()
    assert torch.autograd.gradcheck(amplitudes, leaves)


@pytest.mark.parametrize("name", LAWS)
def test_engine_and_reference_agree_on_every_law(name):
    views, grid = [View(20.0, 40.0), View(200.0, 15.0)], ImageGrid(20, 24, (0.2, 0.2), (0.3, 0.3))
    expected, found = (
        differentiated(scene(LAWS[name]), dtype, lambda scene: render(scene, views, grid).images)
        for dtype in (torch.float64, torch.float32)
    )
    check_agreement(found, expected)


@pytest.mark.parametrize("name", LAWS)
def test_files_keep_the_law(name, tmp_path):
    written = scene(LAWS[name]).to(torch.float32)
    write_gaussians_ply(tmp_path / "a.ply", written)
    read = read_gaussians_ply(tmp_path / "a.ply")
    assert type(read.scattering) is type(written.scattering)
    assert read.scattering.settings() == written.scattering.settings()
    assert torch.equal(read.scattering.parameters, written.scattering.parameters)


def test_other_programs_see_decibels(tmp_path):
    """Of lobes, which they do not know, harmonics whose grey follows them."""
    wide = NormalLobes(torch.randn(6, 3, generator=generator()), 0.0)
    written = scene(replace(wide, parameters=wide.parameters.double())).to(torch.float32)
    write_gaussians_ply(tmp_path / "a.ply", written)
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"comment sarsplat gaussians", b"comment somebody gaussians"))
    foreign = read_gaussians_ply(tmp_path / "b.ply")
    assert isinstance(foreign.scattering, Harmonics)
    u = directions().float()
    seen = torch.stack([foreign.gamma0(u).ravel(), written.gamma0(u).log10().ravel()])
    assert torch.corrcoef(seen)[0, 1] > 0.85  # the brightest and the darkest are clipped


@pytest.mark.parametrize("kind", SCATTERINGS)
def test_threads_change_nothing(kind, threads):
    g = generator()
    count = 17_001  # more than torch computes on one thread, and not a multiple of what a processor takes at once
    law = SCATTERINGS[kind].initial(count, 0.5, 0.03)
    start = law.parameters + torch.randn(law.parameters.shape, generator=g)
    u, quaternions = directions(8).float(), torch.randn(count, 4, generator=g)
    scales = torch.rand(count, 3, generator=g) + 0.1
    cotangent = torch.randn(8, count, len(law.channels), generator=g)
    found = []
    for threads_now in (1, 2, 3):
        threads(threads_now)
        leaves = start.clone().requires_grad_(), quaternions.clone().requires_grad_()
        amplitudes = replace(law, parameters=leaves[0]).amplitudes(u, leaves[1], scales)
        amplitudes.backward(cotangent)
        found.append([amplitudes.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)])
    for others in found[1:]:
        assert all(torch.equal(one, other) for one, other in zip(found[0], others, strict=True))


def test_laws_are_said_in_words() -> None:
    lobes = NormalLobes(torch.tensor([[0, 0, math.log(2)], [0, 0, math.log(2.5)]]), 0.03)
    said = "normal-lobes, γ⁰ = 0.03 + b₀ + b₁·|n·u|ᵉ"
    assert lobes.in_words == f"{said}, e = 2.00 … 2.50"
    assert replace(lobes, parameters=lobes.parameters[:1]).in_words == f"{said}, e = 2.00"
    assert replace(lobes, parameters=lobes.parameters[:0]).in_words == said
    assert replace(lobes, parameters=torch.full((1, 3), 1e6)).in_words == f"{said}, e = {math.exp(5):.2f}"  # no more
    assert Harmonics(torch.zeros(3, 9)).in_words == "harmonics of degree 2"


# ---- the basis of harmonics -----------------------------------------------------------------------------------------
def test_signs_and_order():
    """The table of 3DGS: degree 1 is (−y, z, −x); the Condon–Shortley sign (−1)^m throughout. Degrees are prefixes."""
    u = directions()
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
    for degree in range(3):
        assert torch.equal(harmonic_basis(u, degree), harmonic_basis(u, 3)[:, : (degree + 1) ** 2])


# ---- covariances between polarisations -------------------------------------------------------------------------------
NAMES = {2: ("HH", "VV"), 3: ("HH", "HV", "VV"), 4: ("HH", "HV", "VH", "VV")}


def law(count: int, gaussians: int = 5, harmonics: int = 4) -> Polarimetric:
    parameters = torch.randn(gaussians, count**2 + harmonics, generator=generator(count), dtype=torch.float64)
    return Polarimetric(parameters, 0.05, NAMES[count])


def amplitudes(of: Polarimetric) -> torch.Tensor:
    n = len(of.parameters)
    return of.amplitudes(directions(3), torch.zeros(n, 4).double(), torch.ones(n, 3).double())


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
