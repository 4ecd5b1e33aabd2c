"""Gaussians as one would handle a tensor: indexed, joined and moved, with gradients; and where they start."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from refusals import Do, Refusals, check_refused
from sarsplat import Gaussians, Harmonics, ImageGrid, NormalLobes, Polarimetric, SarsplatError, View, radar_frame
from sarsplat.gaussians.gaussians import covariance, rotation_matrix
from sarsplat.gaussians.initialise import Region, bounded_region, hemisphere_shell, random_quaternions


def scene(count: int = 6, columns: int = 4) -> Gaussians:
    draw = torch.Generator().manual_seed(count)
    shapes = (count, 3), (count, 4), (count, 3), (count,), (count, columns)
    means, quaternions, scales, depth, law = (torch.rand(shape, generator=draw).requires_grad_() for shape in shapes)
    return Gaussians(means, quaternions, scales, depth, Harmonics(law, p_min=0.1))


@pytest.mark.parametrize(
    ("index", "rows"),
    [
        (0, [0]),
        (-1, [5]),
        (np.int64(2), [2]),
        (torch.tensor(3), [3]),
        (slice(1, 3), [1, 2]),
        (slice(None, None, 2), [0, 2, 4]),
        (torch.tensor([4, 4]), [4, 4]),
        ([5, 0], [5, 0]),
        (np.array([1, 2]), [1, 2]),
        (torch.arange(6) > 3, [4, 5]),
        (slice(6, None), []),
    ],
)
def test_rows_are_chosen_like_a_tensors(index: object, rows: list[int]) -> None:
    whole = scene()
    part = whole[index]
    assert len(part) == len(rows)
    assert part.scattering.p_min == 0.1
    for name, tensor in part.tensors().items():
        assert torch.equal(tensor, whole.tensors()[name][rows]), name
    gradient = torch.autograd.grad(part.means.sum() + part.scattering.parameters.sum(), whole.means)[0]
    assert gradient[:, 0].tolist() == [float(rows.count(row)) for row in range(6)]


@pytest.mark.parametrize(
    "index", [6, -7, np.int64(6), None, (0, 1), torch.zeros(2, 2, dtype=torch.long), torch.ones(5) > 0]
)
def test_what_is_no_index_of_rows(index: object) -> None:
    with pytest.raises(IndexError):
        scene()[index]


def test_scenes_are_joined_in_order_with_gradients() -> None:
    parts = [scene(2, 4), scene(3, 9), scene(4, 1)]
    whole = Gaussians.cat(parts)
    assert len(whole) == 9
    assert torch.equal(whole.means, torch.cat([part.means for part in parts]))
    assert whole.scattering.parameters.shape == (9, 9)
    assert whole.scattering.parameters[0, 4:].tolist() == [0.0] * 5
    assert Gaussians.cat([replace(parts[0], scattering=Harmonics(torch.ones(2, 4))), whole]).scattering.p_min == 0
    weights = torch.arange(9.0)
    gradients = torch.autograd.grad((weights @ whole.optical_depth), [part.optical_depth for part in parts])
    assert torch.equal(torch.cat(gradients), weights)
    assert torch.equal(Gaussians.cat([whole[:5], whole[5:]]).quaternions, whole.quaternions)


@pytest.mark.parametrize(
    "arguments", [(torch.float64,), ("cpu", torch.float64), (torch.zeros(1, dtype=torch.float64),)]
)
def test_moved_with_gradients(arguments: tuple[object, ...]) -> None:
    whole = scene()
    moved = whole.to(*arguments)
    assert {tensor.dtype for tensor in moved.tensors().values()} == {torch.float64}
    gradient = torch.autograd.grad(moved.scales.sum(), whole.scales)[0]
    assert gradient.dtype == torch.float32
    assert gradient.sum() == 18
    assert not whole.detach().means.requires_grad
    assert {tensor.device.type for tensor in whole.to(device="meta").tensors().values()} == {"meta"}


# ---- their shapes ----------------------------------------------------------------------------------------------------
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


# ---- what is refused -------------------------------------------------------------------------------------------------
def changed(**tensors: torch.Tensor) -> Do:
    return lambda _: scene().with_tensors(**tensors)


WHOLE = {name: tensor.detach().long() for name, tensor in scene().tensors().items()}
LOBES = NormalLobes(torch.zeros(6, 3))
REFUSED: Refusals = [
    (lambda _: Gaussians.cat([]), "there are no Gaussians to join; give at least one scene"),
    (lambda _: Gaussians.cat([scene(), scene().to(torch.float64)]), "scene 1 is torch.float64 on cpu but scene 0"),
    (lambda _: Gaussians.cat([replace(scene(), scattering=LOBES), scene()]), "normal-lobes and harmonics cannot be"),
    (
        lambda _: Gaussians(*list(WHOLE.values())[:4], scattering=Harmonics(WHOLE["scattering"])),
        "^means is torch.int64; give floating-point numbers, such as torch.float32$",
    ),
    (changed(means=torch.zeros(6, 2)), r"means has shape \(6, 2\); for 6 Gaussians it must be \(6, 3\)"),
    (changed(scales=torch.zeros(5, 3)), r"scales has shape \(5, 3\); for 6 Gaussians it must be \(6, 3\)"),
    (changed(optical_depth=torch.zeros(6, 1)), r"optical_depth has shape \(6, 1\); .* it must be \(6,\)"),
    (changed(scattering=torch.zeros(6, 5)), r"scattering has shape \(6, 5\); .* K = 1, 4, 9 or 16"),
    (changed(scattering=torch.zeros(3, 4)), r"6 Gaussians it must be \(6, 4"),
    (changed(scales=torch.zeros(6, 3).double()), "scales is torch.float64 on cpu but means is torch.float32"),
    (lambda _: replace(scene(), scattering=torch.zeros(6, 4)), "scattering is an object of type Tensor"),
    (lambda _: Harmonics(torch.zeros(3, 4), math.inf), "p_min inf must be finite"),
    (lambda _: Harmonics(torch.zeros(3, 4), -0.1), "p_min -0.1 must be finite and at least 0"),
    (lambda _: NormalLobes(torch.zeros(3, 2)), r"shape \(3, 2\); for N Gaussians it must be \(N, K\) with K = 3"),
    (lambda _: NormalLobes([[0.0, 0.0]]), "parameters is ..0.0, 0.0..; give a torch.Tensor"),
    *(
        (lambda _, n=names: Polarimetric(torch.zeros(2, len(n) ** 2 + 1), 0.0, n), "give 2 to 4 different ones of HH")
        for names in (("HH",), ("HH", "HH"), ("HH", "XX"), ("HH", "HV", "VH", "VV", "RR"))
    ),
]


@pytest.mark.parametrize(("do", "words"), REFUSED)
def test_what_is_refused_in_a_sentence(tmp_path: Path, do: Do, words: str) -> None:
    check_refused(tmp_path, do, words)


@pytest.mark.parametrize("law", [Harmonics(torch.zeros(3, 4), 0.1), NormalLobes(torch.zeros(3, 3))])
def test_torch_saves_and_loads_them_and_refuses_what_is_none(law, tmp_path: Path) -> None:
    whole = replace(scene(3), scattering=law).detach()
    torch.save({"scene": whole}, tmp_path / "scene.pt")
    again = torch.load(tmp_path / "scene.pt")["scene"]
    assert again.scattering.settings() == law.settings()
    for name, tensor in again.tensors().items():
        assert torch.equal(tensor, whole.tensors()[name])
    vars(whole)["scales"] = torch.zeros(2, 3)
    torch.save(whole, tmp_path / "scene.pt")
    with pytest.raises(SarsplatError, match="scales has shape"):
        torch.load(tmp_path / "scene.pt")


def test_a_line_says_what_they_are() -> None:
    assert repr(scene()) == "Gaussians(6, harmonics with 4 numbers, torch.float32, cpu)"


# ---- where they start: the space that images bound, and the paper's hemisphere ---------------------------------------
GRID = ImageGrid(64, 64, spacing_m=(0.2, 0.2), resolution_m=(0.2, 0.2))
VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (15.0, 45.0, 75.0)]
LOW, HIGH = np.array([-2.0, -1.0, 0.0]), np.array([3.0, 1.2, 1.5])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def box_points(count: int = 4000) -> np.ndarray:
    return LOW + (HIGH - LOW) * torch.rand(count, 3, generator=seeded(5), dtype=torch.float64).numpy()


def masks(points: np.ndarray, views: Sequence[View] = VIEWS) -> np.ndarray:
    """One bright pixel for every point, as if nothing were in shadow."""
    images = np.zeros((len(views), GRID.rows, GRID.columns), np.float32)
    for image, view in zip(images, views):
        x, _, r = radar_frame(view) @ points.T
        rows = np.rint((r - GRID.range_m[0]) / GRID.spacing_m[1]).astype(int)
        image[rows, np.rint((x - GRID.azimuth_m[0]) / GRID.spacing_m[0]).astype(int)] = 1.0
    return images


def inside(region: Region, points: np.ndarray) -> np.ndarray:
    return (points @ region.normals.T <= region.offsets).all(axis=1)


def test_region_holds_the_target_and_little_more():
    region = bounded_region(masks(box_points()), VIEWS, GRID)
    assert inside(region, box_points()).all()
    assert (region.low <= LOW + 0.05).all()
    assert (region.high >= HIGH - 0.05).all()
    assert region.low[2] == pytest.approx(0.0, abs=1e-9)  # the ground
    # azimuths bound the plan to a pixel on every side; ranges bound the height less closely
    assert (region.low[:2] >= LOW[:2] - 0.5).all()
    assert (region.high[:2] <= HIGH[:2] + 0.5).all()
    assert region.high[2] < 3.0
    bright = box_points()
    bright[:, 0] += 1.0  # another target, another place
    assert bounded_region(masks(bright), VIEWS, GRID).high[0] == pytest.approx(region.high[0] + 1.0, abs=0.3)


@pytest.mark.parametrize("grazing", [45.0, -20.0])
def test_aloft_the_region_ends_behind_what_frames_show(grazing: float) -> None:
    """All radars are on one side, and nothing else says how far away from them the target reaches."""
    points = box_points() - np.array([0.5, 0.1, 0.75])
    views = [View.isar(View(azimuth, grazing, aloft=True).direction, (0, 0, 1)) for azimuth in range(0, 360, 30)]
    region = bounded_region(masks(points, views), views, GRID)
    assert inside(region, points).all()
    behind, slope = (region.low[2] if grazing > 0 else region.high[2]), math.radians(abs(grazing))
    # as far as a place at the edge of the plan may lie that one view shows as its farthest
    farthest = (2 * np.hypot(2.5 + 0.3, 1.1 + 0.3) * math.cos(slope) + 0.75 * math.sin(slope) + 0.3) / math.sin(slope)
    assert points[:, 2].max() <= abs(behind) <= farthest


def test_aloft_views_from_all_sides_bound_the_region_by_themselves() -> None:
    points = box_points() - np.array([0.5, 0.1, 0.75])
    sights = [sign * axis for axis in np.eye(3) + 0.01 for sign in (1, -1)]
    views = [View.isar(sight, np.roll(sight, 1) + 0.1) for sight in sights]
    region = bounded_region(masks(points, views), views, GRID)
    assert len(region.normals) == 3 * len(views)
    assert inside(region, points).all()


def test_dim_pixels_do_not_count(monkeypatch):
    plain = masks(box_points())
    images = plain.copy()
    images[:, 0, 0] = np.maximum(images[:, 0, 0], 5e-4)  # −33 dB
    region, expected = bounded_region(images, VIEWS, GRID), bounded_region(plain, VIEWS, GRID)
    assert np.array_equal([*region.low, *region.high], [*expected.low, *expected.high])
    monkeypatch.setattr("sarsplat.gaussians.initialise.BRIGHT_DB", -40.0)
    loose = bounded_region(images, VIEWS, GRID)
    assert loose.high[2] > expected.high[2] + 0.5  # now the corner counts, which is near: what is high comes early


@pytest.mark.parametrize("db", [30, 40])
def test_a_corner_reflector_does_not_cut_the_target_off(db):
    images = masks(box_points())
    dim = np.float32(0.15) * images  # 8 dB below what is bright of it
    images = np.where(np.arange(GRID.columns) % 3 == 0, images, dim)
    expected = bounded_region(images, VIEWS, GRID)
    for image, target in zip(images, images.copy(), strict=True):
        rows, columns = np.nonzero(target)
        image[rows[len(rows) // 2], columns[len(rows) // 2]] = 10 ** (db / 10)
    region = bounded_region(images, VIEWS, GRID)
    np.testing.assert_allclose([*region.low, *region.high], [*expected.low, *expected.high])


def test_dark_image_and_contradictory_images():
    images = masks(box_points())
    images[4] = 0.0
    with pytest.raises(SarsplatError, match=r"the image at azimuth 45°, grazing 45° is dark everywhere"):
        bounded_region(images, VIEWS, GRID)
    images = np.zeros((len(VIEWS), GRID.rows, GRID.columns), np.float32)
    images[:, 60, 2] = 1.0  # at the left edge from every side
    with pytest.raises(SarsplatError, match="no region of space could explain the bright pixels"):
        bounded_region(images, VIEWS, GRID)


def test_samples_fill_the_region_and_follow_the_seed():
    region = bounded_region(masks(box_points()), VIEWS, GRID)
    points = region.sample(2000, seeded(3))
    assert points.shape == (2000, 3)
    assert inside(region, points).all()
    assert np.array_equal(points, region.sample(2000, seeded(3)))
    assert not np.array_equal(points, region.sample(2000, seeded(4)))
    box = Region.box(LOW, HIGH).sample(4000, seeded(1))
    assert box.min(axis=0) == pytest.approx(LOW, abs=0.02)
    assert box.max(axis=0) == pytest.approx(HIGH, abs=0.02)
    assert box.mean(axis=0) == pytest.approx((LOW + HIGH) / 2, abs=0.06)


def test_hemisphere_is_a_shell_above_the_ground():
    region = Region.box(LOW, HIGH)
    points = hemisphere_shell(region, 5000, seeded(0))
    centre = np.array([0.5, 0.1, 0.0])
    offset = points - centre
    radius = np.linalg.norm(HIGH[:2] - LOW[:2]) / 2  # around the region's plan
    assert np.linalg.norm(offset, axis=1) == pytest.approx(radius)
    assert (offset[:, 2] >= 0).all()
    assert offset[:, 2].mean() == pytest.approx(radius / 2, rel=0.03)  # even on the sphere: heights are uniform
    assert offset[:, :2].mean(axis=0) == pytest.approx([0, 0], abs=0.05 * radius)
    assert np.array_equal(points, hemisphere_shell(region, 5000, seeded(0)))


def test_random_orientations_are_uniform():
    q = random_quaternions(20_000, seeded(2))
    assert q.norm(dim=1) == pytest.approx(torch.ones(20_000), abs=1e-6)
    assert (q.T @ q / 20_000).numpy() == pytest.approx(np.eye(4) / 4, abs=0.01)
