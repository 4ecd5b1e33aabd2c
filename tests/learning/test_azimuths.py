"""Azimuths known to within some degrees are refined; those known exactly change nothing."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float64

from made import FEW_POINTS, dataset_of
from made_runs import assert_same
from sarsplat import Dataset, ImageGrid, Run, View, preset, reconstruct, simulate_images
from sarsplat.data import load_checkpoint, save_checkpoint
from sarsplat.errors import SarsplatError
from sarsplat.learning.strategies.azimuths import AZIMUTH_OFFSETS, AzimuthRefinement, lowest
from sarsplat.settings.sections import Surroundings

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

GRID = ImageGrid(44, 44, (0.25, 0.25), (0.3, 0.3))
STD_DEG = 3.0
SHORT = {"iterations": 50, "gaussians": 500, "harmonics_every": 20, "checkpoint_every": 26}
CONFIG = replace(preset("measured"), **SHORT, points=FEW_POINTS)
AROUND = np.arange(0, 360, 20)


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """Speckled ground with two long boxes, one across the end of the other, from all around."""
    hull, tower = trimesh.creation.box((9.0, 1.5, 1.0)), trimesh.creation.box((1.5, 4.0, 1.5))
    hull.apply_translation([0, 0, 0.5])
    tower.apply_translation([-3, 0, 0.75])
    mesh = trimesh.util.concatenate([hull, tower])
    views = [View(azimuth, 35.0) for azimuth in AROUND]
    return simulate_images(mesh, views, GRID, ground_gamma0=0.1, looks=1.0, seed=0)


def labelled(images: np.ndarray, azimuths: Sequence[float], std_deg: Sequence[float]) -> Dataset:
    dataset = dataset_of(GRID, [(View(azimuth, 35.0), "train") for azimuth in azimuths], images, looks=1.0, ground=True)
    entries = [replace(entry, azimuth_std_deg=std) for entry, std in zip(dataset.entries, std_deg, strict=True)]
    return replace(dataset, entries=tuple(entries))


@pytest.fixture(scope="module")
def wrong(images: np.ndarray) -> tuple[Dataset, np.ndarray]:
    """Two chips of three are labelled wrongly; by how much."""
    uncertain = np.arange(len(images)) % 3 != 0
    error = np.where(uncertain, np.random.default_rng(1).normal(size=len(images)), 0.0)
    error *= STD_DEG / rms(error[uncertain])
    return labelled(images, AROUND + error, STD_DEG * uncertain), error


@pytest.fixture(scope="module")
def refined(wrong: tuple[Dataset, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Run:
    return reconstruct(wrong[0], CONFIG, tmp_path_factory.mktemp("run") / "run", quiet=True)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def test_wrong_azimuths_are_put_right(wrong: tuple[Dataset, np.ndarray], refined: Run) -> None:
    error = wrong[1]
    uncertain = error != 0
    offset = refined.azimuth_offset_deg
    assert not offset[~uncertain].any()
    assert rms((error + offset)[uncertain]) < 0.5 * STD_DEG
    seen = [view.azimuth_deg for view in refined.snapshot.views]
    assert np.allclose((seen - AROUND + 180) % 360 - 180, error + offset)
    assert refined.about["azimuth corrections"] == f"rms {rms(offset):.2f}°, largest {abs(offset).max():.2f}°"


def test_a_resumed_training_is_the_same(wrong: tuple[Dataset, np.ndarray], refined: Run, tmp_path: Path) -> None:
    """Stopped between two rounds."""
    reconstruct(wrong[0], CONFIG, tmp_path / "run", on_step=lambda step: step.iteration == 25, quiet=True)
    assert Run.load(tmp_path / "run").azimuth_offset_deg.any()
    resumed = reconstruct(wrong[0], CONFIG, tmp_path / "run", quiet=True, resume=True)
    assert_same(resumed.snapshot, refined.snapshot)
    assert resumed.snapshot.views == refined.snapshot.views


def test_azimuths_known_exactly_are_left_alone(images: np.ndarray) -> None:
    """Nor does it matter whether they might have been refined."""
    known = labelled(images, AROUND, np.zeros(len(images)))
    short = replace(CONFIG, iterations=10)
    never = replace(short, surroundings=Surroundings(azimuth_rounds=0))
    run, other = (reconstruct(known, config, quiet=True) for config in (short, never))
    assert not run.azimuth_offset_deg.any()
    assert "azimuth corrections" not in run.about
    assert run.snapshot.views == known.views
    assert_same(run.snapshot, other.snapshot)


def around(best: Float64[np.ndarray, " k"], std: float, labels: Sequence[float]):
    """A likelihood with its maximum at the labels and these offsets, of this standard deviation, degrees."""

    def nats(views: Sequence[View], chips: np.ndarray) -> np.ndarray:
        offset = np.array([view.azimuth_deg for view in views]) - np.array(labels)[chips]
        offset = (offset + 180) % 360 - 180
        return ((offset - best[chips]) / std) ** 2 / 2

    return nats


def test_label_and_image_count_by_their_variance(images: np.ndarray) -> None:
    std = np.array([0.0, 2.0, 1.0, *[0.0] * 15])
    azimuths = AzimuthRefinement(labelled(images, AROUND, std), Surroundings(), 100)
    best = np.array([1.0, 2.0, -0.7, *[5.0] * 15])
    offset_deg = azimuths.most_likely(around(best, 0.5, AROUND))
    assert offset_deg == pytest.approx(best * std**2 / (std**2 + 0.5**2))
    views = azimuths.views(offset_deg)
    assert views[0] == View(0.0, 35.0)
    assert views[1].azimuth_deg == pytest.approx(20 + offset_deg[1])


def test_all_together_they_do_not_turn(images: np.ndarray) -> None:
    """What is common to all turns the target; the better each is known, the more it counts."""
    std = np.array([1.0] * 9 + [2.0] * 9)
    azimuths = AzimuthRefinement(labelled(images, AROUND, std), Surroundings(), 100)
    best = np.random.default_rng(0).normal(0.8, 0.7, 18)
    offset_deg = azimuths.most_likely(around(best, 1e-3, AROUND))
    assert offset_deg == pytest.approx(best - np.average(best, weights=std**-2), abs=1e-5)


@pytest.mark.parametrize(("best", "actual"), [(0.3, 0.3), (-1.9, -1.9), (2.0, 2.0), (7.0, 2.0), (-7.0, -2.0)])
def test_the_lowest_place_of_a_parabola(best: float, actual: float) -> None:
    places = np.linspace(-2, 2, 9)[None].repeat(2, 0)
    assert lowest(places, (places - best) ** 2) == pytest.approx([actual, actual])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("part/texture/ratio", None),
        ("part/texture/ratio", torch.ones(3, 44, 44)),
        ("part/texture/ratio", torch.full((18, 44, 44), torch.nan)),
        ("model/noise", None),
        ("model/shift", torch.zeros(3, 2)),
        ("model/log_gain", torch.full((18,), torch.inf)),
    ],
)
def test_checkpoints_that_would_render_nonsense_are_refused(
    refined: Run, wrong: tuple[Dataset, np.ndarray], tmp_path: Path, name: str, value: torch.Tensor | None
) -> None:
    run = replace(refined, path=shutil.copytree(refined.folder, tmp_path / "run"))
    assert run.store.checkpoint_path is not None
    tensors, state = load_checkpoint(run.store.checkpoint_path)
    if value is None:
        del tensors[name]
    save_checkpoint(run.store.checkpoint_path, tensors if value is None else {**tensors, name: value}, state)
    with pytest.raises(SarsplatError, match="does not hold a whole model"):
        run.render([View(10.0, 35.0)])
    with pytest.raises(SarsplatError, match="does not match this version"):
        reconstruct(wrong[0], replace(CONFIG, iterations=100), run.path, resume=True, quiet=True)


def test_offsets_of_another_training_are_refused(refined: Run) -> None:
    snapshot = refined.snapshot
    for bad in (torch.zeros(3), torch.full((len(AROUND),), torch.nan)):
        damaged = replace(snapshot, tensors=snapshot.tensors | {AZIMUTH_OFFSETS: bad.double()})
        run = replace(refined)
        run.__dict__["snapshot"] = damaged
        with pytest.raises(SarsplatError, match="does not hold one azimuth offset for each training view"):
            _ = run.azimuth_offset_deg
