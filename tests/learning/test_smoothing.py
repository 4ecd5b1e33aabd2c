"""Neighbours are drawn into common planes: what is rough becomes flat, what is bent or unseen stays."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat import Dataset, View, preset
from sarsplat.gaussians.gaussians import rotated
from sarsplat.gaussians.initialise import Region
from sarsplat.learning import Trainer, scene_frame
from sarsplat.learning.strategies.collective import Lattice
from sarsplat.learning.strategies.smoothing import towards_planes, turned
from sarsplat.settings.sections import Rates, Smoothing

UP = np.array([0.0, 0.0, 1.0])


def sheet(roughness_m: float) -> Float64[np.ndarray, "n 3"]:
    """A level square of 8 m at a height of 2 m, which no side of a cube has; in cells of 1 m."""
    chance = np.random.default_rng(0)
    return np.column_stack([chance.uniform(0, 8, (4000, 2)), 2.5 + chance.normal(0, roughness_m, 4000)])


def upright(means: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.tile(UP, (len(means), 1))


def planes(means, normals, lit, cell_m: float, radius_m: float, values=None):
    """`towards_planes` without light, and with values of 0 unless given."""
    values = np.zeros((len(means), 1)) if values is None else values
    return towards_planes(means, normals, lit, np.zeros((len(means), 9)), values, cell_m, radius_m)


@pytest.mark.parametrize("axes", [[0, 1, 2], [2, 1, 0]], ids=["roof", "wall"])
def test_a_fog_gets_the_normal_by_which_it_is_lit(axes: list[int]) -> None:
    """Though its own normals are across, and all light comes from 35 to 50° above the horizon."""
    means, angle = sheet(0.4)[:, axes], np.arange(4000)
    across = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])[:, axes]
    towards = np.array([View(azimuth, grazing).look.facing for azimuth in range(0, 360, 30) for grazing in (35, 50)])
    area = (towards @ UP[axes]).clip(min=0)
    products = [(towards[:, i] * towards[:, j])[area > 0].sum() for i in range(3) for j in range(i, 3)]
    for each in (light := np.tile([*(area @ towards), *products], (4000, 1)), 0 * light):
        normals = towards_planes(means, across, np.ones(4000), each, np.zeros((4000, 1)), 1.0, 3.0)[1]
        assert (np.quantile(np.abs(normals @ UP[axes]), 0.2) > 0.9) == each.any()


def test_a_bump_in_a_plane_is_drawn_back_and_its_values_are_the_neighbours() -> None:
    means = sheet(0.01)
    bump = (np.abs(means[:, :2] - 4.5) < 0.5).all(axis=1)
    means[bump, 2] += 0.3
    values = np.stack([np.where(bump, 2.0, 1.0), np.full(len(means), 3.0)], axis=1)
    moves, _, _, usual = planes(means, upright(means), np.ones(len(means)), 1.0, 3.0, values)
    assert abs((means + moves)[bump, 2].mean() - 2.5) < 0.1
    assert abs((means + moves)[~bump, 2].mean() - 2.5) < 0.02
    assert 1.0 < usual[bump, 0].max() < 1.3
    np.testing.assert_allclose(usual[:, 1], 3.0)


def test_a_dome_keeps_its_radius() -> None:
    chance = np.random.default_rng(0)
    outwards = normalize(torch.from_numpy(chance.normal(size=(60_000, 3))), dim=1).numpy()
    means = (20 + chance.normal(0, 0.1, (len(outwards), 1))) * outwards
    assert abs((planes(means, outwards, np.ones(60_000), 1.0, 3.0)[0] * outwards).sum(1).mean()) < 0.005  # planes: 0.07


def test_layers_of_a_cube_move_as_one_and_what_is_not_lit_stays() -> None:
    means = sheet(0.1)
    lit = (means[:, 2] > 2.5).astype(float)
    below = means - (0, 0, 2)  # cubes of their own, where nothing is lit
    all_of_them = np.concatenate([means, below])
    found = planes(all_of_them, upright(all_of_them), np.concatenate([lit, 0 * lit]), 1.0, 3.0)
    assert not any(each[len(means) :].any() for each in found)
    moves, normals, *_ = found
    assert np.abs(normals[: len(means), 2]).min() > 0.9
    cubes = np.floor(means).astype(int) @ (100, 10, 1)
    assert all(len(np.unique(moves[: len(means)][cubes == cube], axis=0)) == 1 for cube in np.unique(cubes))
    assert not any(each.any() for each in planes(means, upright(means), 0 * lit, 1.0, 3.0))


def test_a_wall_does_not_bend_the_roof() -> None:
    roof = sheet(0.01)
    wall = roof[:, [2, 1, 0]] * (0, 1, 0.3) + (7.99, 0, 0)
    means, normals = np.concatenate([roof, wall]), np.concatenate([upright(roof), upright(wall)[:, [2, 1, 0]]])
    assert np.abs(planes(means, normals, np.ones(len(means)), 1.0, 3.0)[0][: len(roof), 2]).max() < 0.05


def test_a_cell_without_neighbours_is_not_wide_by_what_numbers_are_rounded() -> None:
    chance = np.random.default_rng(0)
    means = np.arange(2000)[:, None] * np.array([5.0, 0, 0]) + chance.uniform(100, 100.3, (2000, 3))
    lit = chance.uniform(0.5e-3, 1.5e-3, len(means))
    assert not planes(means, upright(means), lit, 0.3, 0.9)[2].any()


def test_what_goes_on_to_all_sides_is_wide_and_a_rail_is_not() -> None:
    means = sheet(0.01)
    rail = means * (1, 0.05, 1) + (0, 20, 0)
    wide = planes(both := np.concatenate([means, rail]), upright(both), np.ones(len(both)), 1.0, 3.0)[2]
    inside = (np.abs(means[:, :2] - 4) < 1).all(axis=1)
    assert wide[: len(means)][inside].min() > 0.6
    assert wide[len(means) :].max() < 0.05


def test_axes_turn_towards_a_normal_on_either_side_and_stay_where_there_is_none() -> None:
    quaternions = normalize(torch.tensor(np.random.default_rng(0).normal(size=(50, 4))), dim=1)
    x, z = (torch.tensor(axis).double().expand(50, 3) for axis in ([1.0, 0, 0], [0.0, 0, 1]))
    axes = rotated(quaternions, x)

    def after(normals: Tensor, share: float) -> Tensor:
        shares = torch.full((50, 1), share).double()
        return (rotated(turned(quaternions, axes, normals, shares), x) * z).sum(1)

    before, halfway = (axes * z).sum(1), after(z, 0.5)
    assert torch.equal(halfway.sign(), before.sign())
    assert bool((halfway.abs() > before.abs()).all())
    torch.testing.assert_close(after(-z, 0.5), halfway)
    assert bool((after(z, 1.0).abs() >= halfway.abs()).all())
    torch.testing.assert_close(turned(quaternions, axes, 0 * z, torch.ones(50, 1).double()), quaternions)


def test_rounds_move_what_is_lit_and_make_it_thinner(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(preset("default"), iterations=40, gaussians=400, smoothing=Smoothing(rounds=0))
    smoothed = replace(config, smoothing=Smoothing(rounds=4, thinner=0.1, collective=0.0))
    small, without = Trainer(dataset, smoothed), Trainer(dataset, config)
    assert small.model.levels.coarsest == 1
    for _ in range(10):
        assert small.step() == without.step()
    assert torch.equal(small.gaussians.means, without.gaussians.means)  # a vehicle stays as it is
    monkeypatch.setattr(scene_frame, "_MIN_ACROSS", 2)
    large, without = Trainer(dataset, smoothed), Trainer(dataset, config)
    assert large.model.levels.coarsest > 1
    for _ in range(10):
        assert large.step() == without.step()  # the first round is after the tenth
    moved = (large.gaussians.means != without.gaussians.means).any(dim=1)
    thinner = (large.gaussians.scales < without.gaussians.scales).any(dim=1)
    assert 20 < int(moved.sum()) < len(moved)
    assert int((thinner & ~moved).sum()) == 0 < int(thinner.sum())
    large.step()


@pytest.mark.parametrize("count", [1, 3])
def test_batches_of_planes_change_nothing(
    count: int, threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    chance = np.random.default_rng(0)
    means = np.column_stack([chance.uniform(-6, 6, (2000, 2)), chance.normal(0, 0.15, 2000)])
    normals = normalize(torch.from_numpy(UP + chance.normal(0, 0.3, (2000, 3))), dim=1).numpy()
    given = means, normals, chance.random(2000), 0.3, 0.9
    expected = planes(*given)
    monkeypatch.setattr("sarsplat.learning.strategies.smoothing._BATCH", 37)
    threads(count)
    assert np.ptp(expected[2]) > 0  # narrow and wide ones
    for one, other in zip(expected, planes(*given), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_lattice_carries_places_linearly_and_its_sums_are_the_transpose_in_any_order() -> None:
    chance, region = np.random.default_rng(0), Region.box((-5, -4, 0), (5, 6, 3))
    places = torch.from_numpy(chance.uniform(region.low, region.high, (500, 3)))
    lattice = Lattice.around(region, 1.2, places)
    shape = [math.ceil(length / 1.2) + 2 for length in (10, 10, 3)]
    nodes = torch.cartesian_prod(*(torch.arange(n).double() for n in shape)) * 1.2 + torch.from_numpy(region.low)
    assert len(nodes) == lattice.count
    torch.testing.assert_close(lattice.interpolated(nodes), places)
    at_places, at_nodes = torch.randn(500, 2).double(), torch.randn(lattice.count, 2).double()
    torch.testing.assert_close(
        (lattice.sums(at_places) * at_nodes).sum(), (at_places * lattice.interpolated(at_nodes)).sum()
    )
    order = torch.randperm(500)
    shuffled = Lattice.around(region, 1.2, places[order])
    assert torch.equal(shuffled.sums(at_places[order]), lattice.sums(at_places))


def test_neighbours_move_alike_in_collective_moves(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_frame, "_MIN_ACROSS", 2)
    rates = Rates(scattering=0.08, directional_scattering=0.02)
    config = replace(preset("default"), iterations=40, gaussians=400, coarsest=2, law_from=0.8, rates=rates)
    alone, together = (
        Trainer(dataset, replace(config, smoothing=Smoothing(rounds=1, collective=rate))) for rate in (0.0, 0.02)
    )
    for _ in range(32):
        assert alone.step() == together.step()  # the first move, and the first change of scattering, are after these
    change = (together.gaussians.scattering.parameters - alone.gaussians.scattering.parameters)[:, :2]
    length = 4 * 0.1**0.55 * (1 - 0.9**4) / (1 - 0.99**4) ** 0.5  # Adam's first step, after 31 of 40
    torch.testing.assert_close(change.abs(), length * torch.tensor([[0.08, 0.02]]).expand_as(change), rtol=1e-3, atol=0)
    moves = together.gaussians.means - alone.gaussians.means
    nearest = torch.cdist(alone.gaussians.means, alone.gaussians.means).topk(2, largest=False).indices[:, 1]
    assert 0.0 < (moves - moves[nearest]).norm(dim=1).median() < 0.5 * moves.norm(dim=1).median()
