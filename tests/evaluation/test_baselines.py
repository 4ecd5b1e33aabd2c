"""Scores for comparison, and what images leave open: the inside of a uniform roof, not its edges."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from made import FEW_POINTS, dataset_of, upright
from sarsplat import Gaussians, ImageGrid, Run, Stack, View, import_mstar, radar_frame, render
from sarsplat.data import Dataset, DatasetEntry
from sarsplat.evaluation import (
    baseline_scores,
    log_correlation,
    nats_per_pixel,
    nearest_chip,
    register,
    registered_log_correlation,
    rotated_average,
)
from sarsplat.evaluation.capon import capon_points
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.evaluation.left_open import places, undetermined
from sarsplat.learning import batching
from sarsplat.learning.model import SceneModel

MSTAR = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
GRID = ImageGrid(81, 81, (0.2, 0.21), (0.3, 0.3))


def spots(view: View) -> np.ndarray:
    """Broad spots fixed to the ground, imaged from a view."""
    x, r = np.meshgrid(GRID.azimuth_m, GRID.range_m)
    image = np.full(x.shape, 0.1)
    for place, width in (((3.0, 1.0, 0.0), 1.0), ((-2.0, 2.0, 0.0), 0.8), ((0.0, -3.0, 0.0), 1.2)):
        a, _, b = radar_frame(view) @ np.array(place)
        cosine = np.cos(np.radians(view.grazing_deg))
        image += np.exp(-0.5 * ((x - a) ** 2 + ((r - b) / cosine) ** 2) / width**2)
    return image.astype(np.float32)


def test_nearest_chip_is_nearest_around_the_circle_and_smoothed():
    train = np.random.default_rng(0).exponential(size=(3, 20, 20))
    views = [View(azimuth, 17) for azimuth in (10, 120, 240)]
    predicted = nearest_chip(train, views, [View(355, 15), View(-130, 15)])
    assert np.allclose(predicted, uniform_filter(train, size=(0, 5, 5))[[0, 2]])


@pytest.mark.parametrize(("turn", "grazing"), [(20, 17), (-35, 17), (20, 40)])
def test_turned_chips_match_the_ground_seen_from_the_other_azimuth(turn, grazing):
    source, wanted = View(40, 17), View(40 + turn, grazing)
    (predicted,) = rotated_average(spots(source)[None], [source], [wanted], GRID)
    inside = np.s_[20:61, 20:61]
    assert np.corrcoef(predicted[inside].ravel(), spots(wanted)[inside].ravel())[0, 1] > 0.995
    unturned = uniform_filter(spots(source), 5)
    assert np.corrcoef(unturned[inside].ravel(), spots(wanted)[inside].ravel())[0, 1] < 0.9


@pytest.mark.parametrize("wanted", [1.0, 353.0, -4.5])
def test_chips_count_by_their_azimuth(wanted):
    """Of even chips nothing but the weights is left: a Gaussian of 0.4 spacings, down to a thousandth."""
    azimuths, levels = np.arange(0, 360, 20), np.arange(18) % 5 + 1.0
    train, grid = np.ones((18, 20, 20)) * levels[:, None, None], ImageGrid(20, 20, (0.2, 0.2), (0.3, 0.3))
    (predicted,) = rotated_average(train, [View(a, 17) for a in azimuths], [View(wanted, 17)], grid)
    weights = np.exp(-0.5 * (((azimuths - wanted + 180) % 360 - 180) / 8) ** 2)
    weights[weights < 1e-3 * weights.max()] = 0
    np.testing.assert_allclose(predicted, np.average(levels, weights=weights), rtol=1e-6)
    (far,) = rotated_average(train, [View(k, 17) for k in range(18)], [View(150 + wanted, 17)], grid)
    np.testing.assert_allclose(far, levels[-1])  # far from every chip, the nearest


def test_scores_of_a_dataset_do_not_depend_on_its_calibration():
    generator = np.random.default_rng(1)
    views = [(View(azimuth, 17), split) for azimuth in range(0, 360, 60) for split in ("train", "test-17")]
    images = np.stack([spots(view) * generator.exponential(size=(81, 81)) for view, _ in views]).astype(np.float32)
    scores = []
    for scale in (1, 50):
        dataset = dataset_of(GRID, views, images * np.float32(scale), looks=1.0, ground=True, score_margin=24)
        scores.append(baseline_scores(dataset, {}))
    assert list(scores[0]) == ["test-17"]
    for name in ("nearest_chip", "rotated_average"):
        first, second = (score["test-17"][name] for score in scores)
        assert first == pytest.approx(second, rel=1e-4)
        assert first["log_correlation"] > 0.5


@pytest.mark.skipif(not MSTAR.is_dir(), reason=f"the measured chips are not in {MSTAR}")
@pytest.mark.filterwarnings("ignore:.*has no label for")
@pytest.mark.filterwarnings("ignore:.*was cut off")
@pytest.mark.slow
def test_known_baselines_of_the_measured_t72(tmp_path):
    """Protocol M, K = 36, 17°: nats and correlation, then both registered."""
    lines = (MSTAR / "labels.csv").read_text().splitlines()
    (tmp_path / "labels.csv").write_text("\n".join(line for line in lines if line == lines[0] or ",17," in line))
    dataset = import_mstar(MSTAR, tmp_path / "t72", labels=tmp_path / "labels.csv", target_class="T72", train_views=36)
    train, truth = dataset.images("train"), dataset.images("test-17")
    train_views, views = (dataset.select(name).views for name in ("train", "test-17"))
    for predicted, known in (
        (nearest_chip(train, train_views, views), [0.573, 0.841, 0.533, 0.852]),
        (rotated_average(train, train_views, views, dataset.grid), [0.527, 0.854, 0.505, 0.862]),
    ):
        plain = [score(truth, predicted, 24) for score in (nats_per_pixel, log_correlation)]
        registered = register(truth, predicted, 24).nats.mean(), registered_log_correlation(truth, predicted, 24)
        assert [*plain, *registered] == pytest.approx(known, abs=0.002)


def test_zeros_of_measured_power_leave_a_score_null_with_its_reason():
    views = [(View(azimuth, 17), split) for azimuth, split in ((0, "train"), (120, "train"), (5, "test-17"))]
    images = np.stack([spots(view) for view, _ in views])
    images[0, 30:40, 30:40] = 0  # training chips with nothing there predict that nothing can ever come back
    images[2, 50, 50] = 0  # a zero of the truth alone does no harm
    dataset = dataset_of(GRID, views, images, looks=1.0, ground=True, score_margin=24)
    reasons: dict[str, str] = {}
    scores = baseline_scores(dataset, reasons)["test-17"]
    assert scores["nearest_chip"]["nats_per_pixel"] is None
    assert "the predicted power is zero at 36 of" in reasons["baselines.test-17.nearest_chip.nats_per_pixel"]
    images[0, 30:40, 30:40] = 0.1
    reasons.clear()
    assert baseline_scores(dataset, reasons)["test-17"]["nearest_chip"]["nats_per_pixel"] is not None
    assert not reasons


# ---- Capon's method --------------------------------------------------------------------------------------------------
STACKED = ImageGrid(9, 9, (0.3, 0.3), (0.3, 0.3))
VIEW = View(0.0, 45.0)
STACK = Stack(0.031, tuple(np.linspace(0, 0.008, 5)))


@pytest.mark.parametrize("background", [0.0, 1e-5])
def test_a_scatterer_is_found_and_dark_pixels_have_no_points(background: float) -> None:
    """Without noise, pixels beside the scatterer hold nothing, or rounding."""
    height_m = 1.5
    phases = STACK.elevation_numbers(VIEW) * (height_m / VIEW.look.height_per_elevation)
    signal = np.full((1, 5, 9, 9), background, np.complex64) * np.exp(1j * STACK.plane_phases(VIEW, STACKED))[None]
    signal[0, :, 4, 4] = 3 * np.exp(1j * (STACK.plane_phases(VIEW, STACKED)[:, 4, 4] + phases))
    entry = DatasetEntry(VIEW, "train", "v0", stack=STACK)
    points = capon_points(Dataset.of_complex(STACKED, (entry,), signal.astype(np.complex64)), -1.0, 4.0)
    assert np.isfinite(points).all()
    assert 1 <= len(points) <= 9  # what 3 × 3 pixels average
    np.testing.assert_allclose(points[:, 2], height_m, atol=0.1)


# ---- what images leave open ------------------------------------------------------------------------------------------
ROOF = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(azimuth, grazing) for grazing in (35.0, 50.0) for azimuth in range(0, 360, 60)]
WIDE_M, HEIGHT_M = 10.0, 2.0


def plate(texture: float) -> Gaussians:
    """A level square of thin Gaussians, whose γ⁰ changes by a factor from cell to cell."""
    places = np.stack(np.meshgrid(*[np.arange(-WIDE_M / 2, WIDE_M / 2, 0.15)] * 2), axis=-1).reshape(-1, 2)
    chance = np.random.default_rng(0).choice([1.0, texture], (70, 70))
    gamma0 = chance[tuple(((places + WIDE_M / 2) / 0.9).astype(int).T)]
    means = np.column_stack([places, np.full(len(places), HEIGHT_M)])
    return upright(means, [0.15, 0.15, 0.02], 2.0, gamma0[:, None])


def run_of(gaussians: Gaussians, noise: float) -> Run:
    images = render(gaussians, VIEWS, ROOF).channel(0).numpy() ** 0.5
    images = (images + noise * images.max() * np.random.default_rng(1).normal(size=images.shape)) ** 2
    dataset = dataset_of(ROOF, [(view, "train") for view in VIEWS], images.astype(np.float32))
    run = Run.from_gaussians(gaussians, dataset=dataset)
    return replace(run, config=replace(run.config, points=FEW_POINTS))


@pytest.mark.parametrize(("texture", "noise"), [(1.0, 0.02), (100.0, 0.02), (100.0, 2.0)])
def test_the_inside_of_a_roof_is_open_where_it_is_uniform_or_noise_hides_its_texture(texture, noise) -> None:
    where, left_open = places(run_of(plate(texture), noise))
    to_edge, above = WIDE_M / 2 - np.abs(where[:, :2]).max(axis=1), where[:, 2] > HEIGHT_M - 0.1
    inside, edges = left_open[above & (to_edge > 2)].mean(), left_open[above & (to_edge < 0.5)].mean()
    assert inside < 0.2 if noise < 1 < texture else inside > 0.8
    assert edges < 0.1 or texture > 1


def test_large_views_are_looked_at_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    run, render, views = run_of(plate(1.0), 0.02), SceneModel.render, list[int]()
    usual = places(run)[1]

    def counted(model: SceneModel, some: Sequence[View], *given: Any, **named: Any) -> Any:
        views.append(len(some))
        return render(model, some, *given, **named)

    monkeypatch.setattr(SceneModel, "render", counted)
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)
    assert np.mean(places(run)[1] == usual) > 0.99
    assert {*views} == {1}


def test_without_images_it_is_not_known() -> None:
    dataset = dataset_of(ROOF, [(VIEWS[0], "test")], np.ones((1, 64, 64), np.float32))
    run = run_of(plate(1.0), 0.02)
    with pytest.raises(UndefinedScore, match="no training images"):
        undetermined(replace(run, images=dataset))
