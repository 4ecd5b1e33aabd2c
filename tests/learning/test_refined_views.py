"""Azimuths, axes and rates of rotation that are known roughly are refined; those known exactly change nothing."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float64

from made import FEW_POINTS, boxes, dataset_of
from made_runs import assert_same
from sarsplat import Dataset, ImageGrid, Run, SarImage, SarsplatError, Turn, View, preset, reconstruct
from sarsplat.data import load_checkpoint, save_checkpoint
from sarsplat.geometry.turn import turned
from sarsplat.learning.strategies.views import (
    AZIMUTH_OFFSETS,
    TURN_CORRECTIONS,
    AzimuthRefinement,
    TurnRefinement,
    corrected_views,
    lowest,
    uncertain_passes,
)
from sarsplat.scenes import add_speckle
from sarsplat.scenes.simulate import simulate_images
from sarsplat.settings.sections import Surroundings

pytest.importorskip("embreex")

GRID = ImageGrid(44, 44, (0.25, 0.25), (0.3, 0.3))
STD_DEG = 3.0
SHORT = {"iterations": 40, "gaussians": 500, "harmonics_every": 16, "checkpoint_every": 21}
CONFIG = replace(preset("measured"), **SHORT, points=FEW_POINTS)
AROUND = np.arange(0, 360, 20)


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """Speckled ground with two long boxes, one across the end of the other, from all around."""
    mesh = boxes(((9.0, 1.5, 1.0), (0, 0, 0.5)), ((1.5, 4.0, 1.5), (-3, 0, 0.75)))
    views = [View(azimuth, 35.0) for azimuth in AROUND]
    return add_speckle(simulate_images(mesh, views, GRID, ground_gamma0=0.1), 1, np.random.default_rng(0))


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


@pytest.mark.parametrize("what", ["azimuths", pytest.param("rotations", marks=pytest.mark.slow)])
def test_a_resumed_training_is_the_same(what: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """Stopped between two rounds."""
    whole = request.getfixturevalue("refined" if what == "azimuths" else "righted")
    stop, out = whole.config.checkpoint_every - 1, tmp_path / "run"
    reconstruct(whole.dataset, whole.config, out, on_step=lambda step: step.iteration == stop, quiet=True)
    assert what == "rotations" or Run.load(out).azimuth_offset_deg.any()
    resumed = reconstruct(whole.dataset, whole.config, out, quiet=True, resume=True)
    assert_same(resumed.snapshot, whole.snapshot)
    assert resumed.snapshot.views == whole.snapshot.views


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
    azimuths = AzimuthRefinement(CONFIG, labelled(images, AROUND, std))
    best = np.array([1.0, 2.0, -0.7, *[5.0] * 15])
    offset_deg = azimuths.most_likely(around(best, 0.5, AROUND))
    assert offset_deg == pytest.approx(best * std**2 / (std**2 + 0.5**2))
    views = azimuths.views(offset_deg)
    assert views[0] == View(0.0, 35.0)
    assert views[1].azimuth_deg == pytest.approx(20 + offset_deg[1])


def test_all_together_they_do_not_turn(images: np.ndarray) -> None:
    """What is common to all turns the target; the better each is known, the more it counts."""
    std = np.array([1.0] * 9 + [2.0] * 9)
    azimuths = AzimuthRefinement(CONFIG, labelled(images, AROUND, std))
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
def test_damaged_checkpoints(
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


# ---- axes and rates of rotation --------------------------------------------------------------------------------------
SPUN = ImageGrid(36, 36, (0.3, 0.3), (0.3, 0.3))
SIGHT = np.array([1.0, 0.4, 0.6])
TRUE_AXES = (np.array([0.0, 0.1, 1.0]), np.array([1.0, 0.2, 0.1]))
TILTS_DEG, FASTER = (3.0, -2.5), (0.03, -0.03)
FRAMES = 9
SPINNING = replace(preset("quick"), iterations=120, gaussians=600, points=FEW_POINTS, checkpoint_every=61)


@pytest.fixture(scope="module")
def frames() -> tuple[np.ndarray, list[View], list[Turn]]:
    """Images of two passes on pixels that were scaled by wrong rates and axes, true views, and what was assumed."""
    body = boxes(((5, 1.2, 0.8), (0, 0, 0)), ((0.8, 3, 0.3), (-1.6, 0.7, 0.3)), ((0.6, 0.6, 2), (1.4, 0.2, 1.2)))
    images, true, turns = [], [], []
    for number, (axis, tilt_deg, faster) in enumerate(zip(TRUE_AXES, TILTS_DEG, FASTER, strict=True)):
        assumed = turned(axis, np.cross(axis, (0.3, 1.0, -0.7)), tilt_deg)
        sines = [np.linalg.norm(np.cross(SIGHT, one)) / np.linalg.norm(one) for one in (axis, assumed)]
        stretch = (1 + faster) * float(sines[0] / sines[1])
        views = [Turn(tuple(axis), 360 * k / FRAMES).seen_from(SIGHT) for k in range(FRAMES)]
        grid = replace(SPUN, spacing_m=(0.3 / stretch, 0.3), resolution_m=(0.3 / stretch, 0.3))
        images.append(simulate_images(body, views, grid) / stretch)
        true += [replace(view, stretch=stretch) for view in views]
        angles = [360 * k / FRAMES / (1 + faster) for k in range(FRAMES)]
        turns += [Turn(tuple(assumed), angle, 3.0, 0.03, f"pass {number}") for angle in angles]
    return np.concatenate(images), true, turns


def spinning(images: np.ndarray, turns: Sequence[Turn], test: int = 0) -> Dataset:
    shots = [SarImage(power, turn.seen_from(SIGHT), SPUN) for power, turn in zip(images, turns, strict=True)]
    learned = len(shots) - test
    return Dataset.from_images(shots[:learned], test=shots[learned:], turns=turns)


@pytest.fixture(scope="module")
def righted(frames: tuple[np.ndarray, list[View], list[Turn]], tmp_path_factory: pytest.TempPathFactory) -> Run:
    images, _, turns = frames
    return reconstruct(spinning(images, turns), SPINNING, tmp_path_factory.mktemp("run") / "run", quiet=True)


def errors_deg(views: Sequence[View], true: Sequence[View]) -> np.ndarray:
    """By how much frames are turned away from the true ones, but for a rotation of all."""
    seen, right = (np.stack([axes(view) for view in some]) for some in (views, true))
    u, _, v = np.linalg.svd(np.einsum("kij,kil->jl", seen, right))
    common = v.T @ np.diag([1, 1, np.linalg.det(v.T @ u.T)]) @ u.T
    cosine = (np.einsum("kij,kij->k", seen @ common.T, right) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def axes(view: View) -> np.ndarray:
    """Of the image and across it; the radar's own frame is mirrored where its azimuth is the other way."""
    azimuth, _, away = view.look.frame
    return np.stack([azimuth, away, np.cross(azimuth, away)])


def test_wrong_axes_and_rates_are_put_right(frames: tuple[np.ndarray, list[View], list[Turn]], righted: Run) -> None:
    _, true, turns = frames
    assumed = [turn.seen_from(SIGHT) for turn in turns]
    found = righted.snapshot.views
    assert rms(errors_deg(found, true)) < 0.4 * rms(errors_deg(assumed, true))
    corrections = righted.snapshot.tensors[TURN_CORRECTIONS].numpy()
    assert corrections.shape == (2, 3)
    assert corrections[:, 2] == pytest.approx(FASTER, abs=0.01)
    assert "rate by +" in righted.about["corrected rotations"]
    assert found == corrected_views(righted.dataset.entries, uncertain_passes(righted.dataset), corrections)


def test_rotations_known_exactly_change_nothing(frames: tuple[np.ndarray, list[View], list[Turn]]) -> None:
    images, _, turns = frames
    known = spinning(images, [replace(turn, axis_std_deg=0.0, rate_std=0.0) for turn in turns])
    without = replace(known, entries=tuple(replace(entry, turn=None) for entry in known.entries))
    short = replace(SPINNING, iterations=12)
    run, other = (reconstruct(dataset, short, quiet=True).snapshot for dataset in (known, without))
    assert run.views == other.views == known.views
    assert_same(run, other)


def test_test_frames_follow_their_pass(frames: tuple[np.ndarray, list[View], list[Turn]], righted: Run) -> None:
    turns = frames[2]
    between = replace(turns[3], angle_deg=turns[3].angle_deg + 10)
    other = replace(between, name="a third pass")
    shots = [SarImage(frames[0][0], turn.seen_from(SIGHT), SPUN) for turn in (turns[0], between, other)]
    found = righted.views_of(Dataset.from_images(shots, turns=[turns[0], between, other]))
    assert found[0] == righted.snapshot.views[0]
    assert found[1].stretch == pytest.approx(righted.snapshot.views[3].stretch)
    assert found[1] != shots[1].view and found[2] == shots[2].view


def signature(view: View) -> np.ndarray:
    return view.look.gradients.ravel()


def found_by(turn: Turn, slopes: np.ndarray, best: np.ndarray, noise: np.ndarray, samples: float, steps: int):
    """Corrections from one frame, whose image changes in proportion to those that its view has had."""
    view, size = turn.seen_from(SIGHT), 1e-3
    dataset = Dataset.from_images([SarImage(np.ones((36, 36), np.float32), view, SPUN)], turns=[turn])
    refinement, base, found = TurnRefinement(SPINNING, dataset), signature(view), np.zeros((1, 3))
    moved = [signature(turn.corrected(view, tuple(s[:2]), s[2])) - base for s in size * np.eye(3)]
    jacobian = np.stack(moved, axis=1) / size

    def differences(views: Sequence[View], numbers: np.ndarray) -> np.ndarray:
        corrections = [np.linalg.lstsq(jacobian, signature(one) - base, rcond=None)[0] for one in views]
        return np.stack([noise + slopes @ (correction - best) for correction in corrections])

    for _ in range(steps):
        found = refinement.stepped(found, differences, np.array([samples]), 0.05)
    return found[0]


def test_frames_and_what_was_assumed_count_by_their_variance() -> None:
    """One pixel for each correction: the answer is the mean, weighted by the reciprocals of the variances."""
    best, std = np.array([0.2, -0.1, 0.004]), np.array([1.0, 1.0, 0.02])
    slopes = np.concatenate([np.diag(0.1 / std), np.zeros((1, 3))])
    found = found_by(Turn((0, 0, 1), 70.0, 1.0, 0.02), slopes, best, np.array([0, 0, 0, 0.5]), 40.0, 40)
    information = 40 * 0.1**2 / 0.5**2
    assert found / best == pytest.approx(information / (1 + information), rel=0.02)


def test_what_is_known_exactly_of_an_uncertain_pass_stays_and_the_most_unlikely_is_not_believed() -> None:
    for std, free in (((2.0, 0.0), [True, True, False]), ((0.0, 0.02), [False, False, True])):
        turn = Turn((0, 0, 1), 70.0, *std)
        found = found_by(turn, np.eye(3), np.array([0.2, 0.1, 0.01]), np.ones(3), 50.0, 1)
        assert (found != 0).tolist() == free
    turn = Turn((0, 0, 1), 70.0, 0.5, 0.01)
    found = found_by(turn, np.eye(3), np.array([40.0, 0.1, 0.3]), np.ones(3), 1e6, 30)
    assert found[0] == 1.5 and abs(found[2]) <= 0.03


def test_offsets_and_corrections_of_another_training_are_refused(refined: Run, righted: Run) -> None:
    def damaged(run: Run, name: str, value: torch.Tensor) -> Run:
        other = replace(run)
        other.__dict__["snapshot"] = replace(run.snapshot, tensors=run.snapshot.tensors | {name: value.double()})
        return other

    for bad in (torch.zeros(3), torch.full((len(AROUND),), torch.nan)):
        with pytest.raises(SarsplatError, match="does not hold one azimuth offset for each training view"):
            _ = damaged(refined, AZIMUTH_OFFSETS, bad).azimuth_offset_deg
    for bad in (torch.zeros(3, 3), torch.zeros(2), torch.full((2, 3), torch.nan)):
        with pytest.raises(SarsplatError, match=r"corrections of rotations|uncertain pass"):
            damaged(righted, TURN_CORRECTIONS, bad).views_of(righted.dataset)
