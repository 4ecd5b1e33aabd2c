"""Gaussians and points as PLY: lossless for us, the 3DGS convention for others."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sarsplat.data import read_gaussians_ply, read_points_ply, write_gaussians_ply, write_points_ply
from sarsplat.data.ply import read_centred_gaussians
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians, Harmonics, NormalLobes
from sarsplat.gaussians.law_harmonics import harmonic_basis


def some(count: int = 7, degree: int = 3, seed: int = 0, p_min: float = 0.05) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    depth = 5 * torch.rand(count, generator=g)
    scales = torch.exp(torch.randn(count, 3, generator=g) - 3).clamp_min(MIN_SCALE)
    if count > 2:
        depth[0], depth[1], scales[1, 2] = 0.0, MAX_OPTICAL_DEPTH, MIN_SCALE
    return Gaussians(
        torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g),
        scales,
        depth,
        Harmonics(torch.randn(count, (degree + 1) ** 2, generator=g), p_min),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_our_own_files_are_lossless(tmp_path, count, degree):
    written = some(count, degree, p_min=0.1 + 0.2)
    write_gaussians_ply(tmp_path / "a.ply", written, ["target T72", "two\nlines, ünicode"])
    read = read_gaussians_ply(tmp_path / "a.ply")
    assert read.scattering.p_min == written.scattering.p_min
    for name, tensor in written.tensors().items():
        assert read.tensors()[name].dtype == torch.float32
        assert torch.equal(read.tensors()[name], tensor), name


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file that holds nothing but floats, read in the plainest way."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    names = re.findall(r"property float (\w+)\n", header.decode())
    return dict(zip(names, np.frombuffer(data, "<f4").reshape(-1, len(names)).T, strict=True))


def test_layout_is_that_of_3dgs(tmp_path):
    gaussians = some()
    write_gaussians_ply(tmp_path / "a.ply", gaussians)
    vertex = columns_of(tmp_path / "a.ply")
    expected = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(45))]
    expected += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    assert list(vertex)[: len(expected)] == expected
    alpha = 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    np.testing.assert_allclose(alpha, 1 - np.exp(-gaussians.optical_depth.double().numpy()), atol=1e-7)
    np.testing.assert_allclose(np.exp(vertex["scale_1"]), gaussians.scales[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quaternions[:, 0])


def in_a_viewer(path: Path, towards: torch.Tensor) -> np.ndarray:
    """What a 3DGS program shows of each Gaussian, [N, 3], looking at it from unit vectors u: max(0, ½ + Σ h Y(−u))."""
    vertex = columns_of(path)
    shown = []
    for channel in range(3):
        names = [f"f_dc_{channel}", *(f"f_rest_{15 * channel + k}" for k in range(15))]
        in_file = torch.from_numpy(np.stack([vertex[name] for name in names], axis=1))
        shown.append((in_file @ harmonic_basis(-towards, 3)).clamp(min=-0.5) + 0.5)
    return torch.stack(shown, dim=1).numpy()


@pytest.mark.parametrize("strength", [1e-3, 1e3])
@pytest.mark.parametrize("u", [(0.3, -0.8, 0.4), (0.1, 0.2, 0.9)])
def test_viewers_show_decibels_whatever_the_calibration(tmp_path, u, strength):
    """Lobes to all sides, over 20 dB: greys in their order, none of them black, and hardly one that is blown out."""
    some_of_them = some(400)
    generator = torch.Generator().manual_seed(1)
    b = strength * 10 ** (2 * torch.rand(400, 2, generator=generator) - 2)
    raw = b + torch.log(-torch.expm1(-b))  # softplus undone
    flat = torch.tensor([0.3, 0.3, 0.02]).expand(400, 3)
    gaussians = replace(
        some_of_them,
        scales=flat,
        scattering=NormalLobes(torch.cat([raw, torch.zeros(400, 1)], 1)),
        optical_depth=torch.full((400,), 2.0),
    )
    write_gaussians_ply(tmp_path / "a.ply", gaussians)
    towards = torch.nn.functional.normalize(torch.tensor(u), dim=0)
    shown = in_a_viewer(tmp_path / "a.ply", towards)
    np.testing.assert_array_equal(shown[:, 0], shown[:, 2])
    level_db = 10 * torch.log10(gaussians.gamma0(towards[None])[0]).numpy()
    assert np.corrcoef(shown[:, 0], level_db)[0, 1] > 0.95
    assert shown.min() > 0.02
    assert (shown > 1.02).mean() < 0.02
    assert (shown[:, 0].max() - shown[:, 0].min()) > 0.6


def test_viewers_may_show_the_height_instead(tmp_path):
    gaussians = some(200)
    write_gaussians_ply(tmp_path / "a.ply", gaussians, colour="height")
    shown = in_a_viewer(tmp_path / "a.ply", torch.tensor([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(shown, in_a_viewer(tmp_path / "a.ply", torch.tensor([0.0, -0.6, 0.8])), atol=1e-5)
    height = gaussians.means[:, 2].numpy()
    assert np.corrcoef(shown[:, 0] - shown[:, 2], height)[0, 1] > 0.75  # from blue to yellow
    assert b"comment colours: height, blue = " in (tmp_path / "a.ply").read_bytes()


def test_points_round_trip(tmp_path):
    positions = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    write_points_ply(tmp_path / "p.ply", positions, power=np.arange(9), support=np.linspace(0, 1, 9))
    read, columns = read_points_ply(tmp_path / "p.ply")
    np.testing.assert_array_equal(read, positions)
    assert list(columns) == ["power", "support"]
    np.testing.assert_array_equal(columns["power"], np.arange(9, dtype=np.float32))
    write_points_ply(tmp_path / "none.ply", np.empty((0, 3)))
    assert read_points_ply(tmp_path / "none.ply")[0].shape == (0, 3)


@pytest.mark.parametrize(("kind", "exact"), [("double", True), ("float", False)])
def test_coordinates_of_maps_keep_their_millimetres(tmp_path, kind, exact):
    places = np.array([[462200.545, 5238624.111, 420.0], [462200.546, 5238624.999, 421.5]])
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    head += "".join(f"property {kind} {axis}\n" for axis in "xyz") + "property float gamma0\nend_header\n"
    number = np.dtype("<f8" if exact else "<f4")
    table = np.zeros(2, [("x", number), ("y", number), ("z", number), ("gamma0", "<f4")])
    for axis, column in zip("xyz", places.T, strict=True):
        table[axis] = column
    (tmp_path / "p.ply").write_bytes(head.encode() + table.tobytes())
    read, columns = read_points_ply(tmp_path / "p.ply")
    assert read.dtype == number
    np.testing.assert_array_equal(read, places.astype(number))
    assert list(columns) == ["gamma0"]


def far_file(path: Path, place: list[float]) -> Gaussians:
    """A file whose coordinates are float64 around a place; returns the Gaussians as they are around the origin."""
    near = some(40)
    near = replace(near, means=near.means * torch.tensor([4.0, 2.0, 0.0]) + torch.tensor([0.0, 0.0, 1.0]))
    write_gaussians_ply(path, near)
    header, end, _ = path.read_bytes().partition(b"end_header\n")
    columns = columns_of(path)
    columns |= {name: columns[name].astype("<f8") + offset for name, offset in zip("xyz", place, strict=True)}
    table = np.rec.fromarrays([*columns.values()])
    path.write_bytes(re.sub(rb"property float ([xyz])\n", rb"property double \1\n", header) + end + table.tobytes())
    return near


@pytest.mark.parametrize("place", [[4.1e6, 0.9e6, 4.8e6], [512345.25, 5.4e6, 350.0]])
def test_gaussians_in_map_coordinates_are_moved_to_the_origin_before_they_lose_digits(tmp_path, place):
    near = far_file(tmp_path / "far.ply", place)
    read, moved = read_centred_gaussians(tmp_path / "far.ply")
    back = read.means.double() + torch.from_numpy(moved - place)
    assert (back - near.means).abs().max() < 1e-5  # of float32 there are steps of 0.06 m and more
    assert read.means[:, :2].abs().max() < near.means.abs().max() + 3
    assert read.means[:, 2].abs().max() < 0.5
    far_file(tmp_path / "near.ply", [0.0] * 3)
    same, moved = read_centred_gaussians(tmp_path / "near.ply")
    assert not moved.any()
    assert torch.equal(same.means, near.means)
