"""Single images that are not where they belong are named; those that are, pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from datasets import dataset_of
from lorries import lorry
from sarsplat import ScatteringLaw, add_speckle, simulate_raycast
from sarsplat.data import Dataset
from sarsplat.examination.contradictions import examine
from sarsplat.examination.outcome import Examination
from sarsplat.examination.places import examine_places
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(41, 37, (0.4, 0.35), (0.5, 0.45))
"""Of odd sizes, and of uneven pixels."""


def scene(ground: float | None, views: Sequence[View]) -> Dataset:
    """A lorry beside a container."""
    mesh = lorry(((2.5, 1.2, 1.5), (-1.5, 3, 0.75)))
    images = [
        simulate_raycast(mesh, view, GRID, ScatteringLaw(), ground_gamma0=ground, ray_spacing=0.07) for view in views
    ]
    return dataset_of(GRID, [(view, "train") for view in views], np.stack(images), ground=ground is not None)


def speckled(dataset: Dataset) -> Dataset:
    return replace(dataset, power=add_speckle(dataset.power, 1, np.random.default_rng(0)), looks=1)


@pytest.fixture(scope="module")
def all_round() -> Dataset:
    return speckled(scene(0.05, [View(float(azimuth), 30.0) for azimuth in range(7, 367, 15)]))


@pytest.fixture(scope="module")
def bare() -> Dataset:
    return scene(None, [View(float(azimuth), 45.0) for azimuth in range(0, 360, 20)])


def with_views(dataset: Dataset, change: Callable[[int, View], View]) -> Dataset:
    entries = [replace(entry, view=change(k, entry.view)) for k, entry in enumerate(dataset.entries)]
    return replace(dataset, entries=tuple(entries))


def with_order(dataset: Dataset, order: Sequence[int]) -> Dataset:
    """The images in another order, under the same names and directions."""
    return replace(dataset, power=dataset.power[list(order)])


def swapped(dataset: Dataset, *pairs: tuple[int, int]) -> Dataset:
    order = list(range(len(dataset)))
    for i, j in pairs:
        order[i], order[j] = order[j], order[i]
    return with_order(dataset, order)


def flipped(dataset: Dataset, which: Sequence[int], turn: Callable[[np.ndarray], np.ndarray]) -> Dataset:
    power = dataset.power.copy()
    for k in which:
        power[k] = turn(power[k])
    return replace(dataset, power=power)


@pytest.mark.parametrize("kind", ["all_round", "bare"])
def test_images_in_their_places_pass(kind: str, request: pytest.FixtureRequest) -> None:
    dataset = request.getfixturevalue(kind)
    found = examine(dataset)
    assert found.contradictions == []
    assert f"none of {len(dataset)} images matches those of another azimuth" in found.checks["single azimuths"]


@pytest.mark.parametrize("pair", [(2, 8), (0, 13)])
@pytest.mark.parametrize("kind", ["all_round", "bare"])
def test_two_files_swapped_are_named(kind: str, pair: tuple[int, int], request: pytest.FixtureRequest) -> None:
    dataset = request.getfixturevalue(kind)
    (text,) = examine(swapped(dataset, pair)).contradictions
    for k in pair:
        assert f"{k:03d} (azimuth {dataset.views[k].azimuth_deg:g}°" in text
    assert "in each other's place" in text
    assert "exchange the files, or their angles" in text


def test_two_pairs_are_both_named(all_round: Dataset) -> None:
    (text,) = examine(swapped(all_round, (2, 8), (12, 19))).contradictions
    assert [f"{k:03d} (" in text for k in range(24)] == [k in (2, 8, 12, 19) for k in range(24)]


def test_swaps_across_grazing_angles_are_named() -> None:
    views = [View(float(azimuth), grazing) for grazing in (25.0, 45.0) for azimuth in range(0, 360, 20)]
    dataset = speckled(scene(0.05, views))
    assert examine(dataset).contradictions == []
    (text,) = examine(swapped(dataset, (3, 25))).contradictions
    assert "003 (azimuth 60°, grazing 25°) and 025 (azimuth 140°, grazing 45°)" in text


def test_a_wrong_azimuth_is_named_with_the_right_one(all_round: Dataset) -> None:
    wrong = with_views(all_round, lambda k, view: View(view.azimuth_deg + 100 * (k == 6), view.grazing_deg))
    (text,) = examine(wrong).contradictions
    assert text.startswith("006 (azimuth 197°, grazing 30°) matches images around azimuth ")
    assert float(text.split("around azimuth ")[1].split("°")[0]) == pytest.approx(97, abs=10)


@pytest.mark.parametrize(
    ("turn", "what"),
    [
        (lambda image: image[:, ::-1], "mirrored"),
        (lambda image: image[::-1], "upside down"),
        (lambda image: image[::-1, ::-1], "turned by a half"),
    ],
)
def test_a_part_that_is_the_other_way_round_is_found(
    turn: Callable[[np.ndarray], np.ndarray], what: str, all_round: Dataset
) -> None:
    (text,) = examine(flipped(all_round, range(3, 11), turn)).contradictions
    assert what in text
    assert text.endswith("give all images the same way round")


def test_one_image_that_is_upside_down_is_found(all_round: Dataset) -> None:
    (text,) = examine(flipped(all_round, [4], lambda image: image[::-1])).contradictions
    assert text.startswith("004 (azimuth 67°, grazing 30°) matches its neighbours better upside down")


def test_few_or_lonely_images_say_nothing(all_round: Dataset) -> None:
    few = examine(all_round.take(range(0, 24, 4)))
    assert few.checks["single azimuths"] == "cannot be determined: too few images"
    lonely = examine(all_round.take(range(0, 24, 3)))
    assert lonely.checks["single azimuths"] == "cannot be determined: none has two others within 31°"


@pytest.mark.parametrize("shares", [[1, 0, 0, 0, 1, 0, 1, 1], [1, 0, 0.2, 0, 0.7, 0.6, 1, 0.9]])
def test_images_of_one_direction_that_are_alike_are_not_elsewhere(shares: list[float]) -> None:
    """Of 4° of flight, as of apertures that see other glints: the first is like the last where it is, too."""
    rng = np.random.default_rng(0)
    places = [np.random.default_rng(seed).uniform(8, 32, (8, 2)) for seed in (1, 2)]
    rows, columns = np.mgrid[:40, :40]
    one, other = (sum(np.exp(-((rows - a) ** 2 + (columns - b) ** 2) / 6) for a, b in each) for each in places)
    mixed = [(share + 0.2) * one + (1.2 - share) * other + 1e-3 for share in shares]
    grid = ImageGrid(40, 40, (0.5, 0.5), (0.7, 0.7))
    power = np.stack(mixed) * rng.gamma(4, 0.25, (8, 40, 40))
    views = [(View(3.5 - 0.5 * k, 45.0), "train") for k in range(8)]
    examined = Examination()
    examine_places(dataset_of(grid, views, power.astype(np.float32), ground=False), False, examined)
    assert examined.contradictions == []
    assert "none of 8 images" in examined.checks["single azimuths"]
