"""Axes and rates of rotation that are known to within degrees and per cent are refined; those known exactly stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from made import FEW_POINTS
from made_runs import assert_same
from sarsplat import Dataset, ImageGrid, Run, SarImage, Turn, View, preset, reconstruct, simulate_images
from sarsplat.errors import SarsplatError
from sarsplat.geometry.turn import turned
from sarsplat.learning.strategies.turns import TURN_CORRECTIONS, TurnRefinement, corrected_views, uncertain_passes
from sarsplat.settings.sections import Turns

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

GRID = ImageGrid(36, 36, (0.3, 0.3), (0.3, 0.3))
SIGHT = np.array([1.0, 0.4, 0.6])
TRUE_AXES = (np.array([0.0, 0.1, 1.0]), np.array([1.0, 0.2, 0.1]))
TILTS_DEG, FASTER = (3.0, -2.5), (0.03, -0.03)
FRAMES = 12
SHORT = replace(preset("quick"), iterations=120, gaussians=900, points=FEW_POINTS, checkpoint_every=61)


def body() -> trimesh.Trimesh:
    """Boxes without any symmetry."""
    boxes = (((5.0, 1.2, 0.8), (0, 0, 0)), ((0.8, 3.0, 0.3), (-1.6, 0.7, 0.3)), ((0.6, 0.6, 2.0), (1.4, 0.2, 1.2)))
    parts = [trimesh.creation.box(sides) for sides, _ in boxes]
    for part, (_, middle) in zip(parts, boxes, strict=True):
        part.apply_translation(middle)
    return trimesh.util.concatenate(parts)


@pytest.fixture(scope="module")
def frames() -> tuple[np.ndarray, list[View], list[Turn]]:
    """Images of two passes on pixels that were scaled by wrong rates and axes, true views, and what was assumed."""
    images, true, turns = [], [], []
    for number, (axis, tilt_deg, faster) in enumerate(zip(TRUE_AXES, TILTS_DEG, FASTER, strict=True)):
        assumed = turned(axis, np.cross(axis, (0.3, 1.0, -0.7)), tilt_deg)
        sines = [np.linalg.norm(np.cross(SIGHT, one)) / np.linalg.norm(one) for one in (axis, assumed)]
        stretch = (1 + faster) * float(sines[0] / sines[1])
        views = [Turn(tuple(axis), 360 * k / FRAMES).seen_from(SIGHT) for k in range(FRAMES)]
        grid = replace(GRID, spacing_m=(0.3 / stretch, 0.3), resolution_m=(0.3 / stretch, 0.3))
        images.append(simulate_images(body(), views, grid) / stretch)
        true += [replace(view, stretch=stretch) for view in views]
        angles = [360 * k / FRAMES / (1 + faster) for k in range(FRAMES)]
        turns += [Turn(tuple(assumed), angle, 3.0, 0.03, f"pass {number}") for angle in angles]
    return np.concatenate(images), true, turns


def dataset_of(images: np.ndarray, turns: Sequence[Turn], test: int = 0) -> Dataset:
    shots = [SarImage(power, turn.seen_from(SIGHT), GRID) for power, turn in zip(images, turns, strict=True)]
    learned = len(shots) - test
    return Dataset.from_images(shots[:learned], test=shots[learned:], turns=turns)


@pytest.fixture(scope="module")
def refined(frames: tuple[np.ndarray, list[View], list[Turn]], tmp_path_factory: pytest.TempPathFactory) -> Run:
    images, _, turns = frames
    return reconstruct(dataset_of(images, turns), SHORT, tmp_path_factory.mktemp("run") / "run", quiet=True)


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


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def test_wrong_axes_and_rates_are_put_right(frames: tuple[np.ndarray, list[View], list[Turn]], refined: Run) -> None:
    _, true, turns = frames
    assumed = [turn.seen_from(SIGHT) for turn in turns]
    found = refined.snapshot.views
    assert rms(errors_deg(found, true)) < 0.4 * rms(errors_deg(assumed, true))
    corrections = refined.snapshot.tensors[TURN_CORRECTIONS].numpy()
    assert corrections.shape == (2, 3)
    assert corrections[:, 2] == pytest.approx(FASTER, abs=0.01)
    assert "rate by +" in refined.about["corrected rotations"]
    assert found == corrected_views(refined.dataset.entries, uncertain_passes(refined.dataset), corrections)


def test_a_resumed_training_is_the_same(
    frames: tuple[np.ndarray, list[View], list[Turn]], refined: Run, tmp_path: Path
) -> None:
    """Stopped between two rounds."""
    dataset = dataset_of(frames[0], frames[2])
    reconstruct(dataset, SHORT, tmp_path / "run", on_step=lambda step: step.iteration == 60, quiet=True)
    resumed = reconstruct(dataset, SHORT, tmp_path / "run", quiet=True, resume=True)
    assert_same(resumed.snapshot, refined.snapshot)
    assert resumed.snapshot.views == refined.snapshot.views


def test_rotations_known_exactly_change_nothing(frames: tuple[np.ndarray, list[View], list[Turn]]) -> None:
    images, _, turns = frames
    known = dataset_of(images, [replace(turn, axis_std_deg=0.0, rate_std=0.0) for turn in turns])
    without = replace(known, entries=tuple(replace(entry, turn=None) for entry in known.entries))
    short = replace(SHORT, iterations=12)
    run, other = (reconstruct(dataset, short, quiet=True).snapshot for dataset in (known, without))
    assert run.views == other.views == known.views
    assert_same(run, other)


def test_test_frames_follow_their_pass(frames: tuple[np.ndarray, list[View], list[Turn]], refined: Run) -> None:
    turns = frames[2]
    between = replace(turns[3], angle_deg=turns[3].angle_deg + 10)
    other = replace(between, name="a third pass")
    shots = [SarImage(frames[0][0], turn.seen_from(SIGHT), GRID) for turn in (turns[0], between, other)]
    found = refined.views_of(Dataset.from_images(shots, turns=[turns[0], between, other]))
    assert found[0] == refined.snapshot.views[0]
    assert found[1].stretch == pytest.approx(refined.snapshot.views[3].stretch)
    assert found[1] != shots[1].view and found[2] == shots[2].view


def linear(slopes: np.ndarray, best: np.ndarray, noise: np.ndarray, turn: Turn, view: View):
    """Images that change in proportion to corrections, which are read from how the view of one frame has changed."""
    steps = 1e-3 * np.eye(3)
    base = signature(view)
    jacobian = np.stack([(signature(turn.corrected(view, tuple(s[:2]), s[2])) - base) / 1e-3 for s in steps], axis=1)

    def differences(views: Sequence[View], numbers: np.ndarray) -> np.ndarray:
        found = [np.linalg.lstsq(jacobian, signature(one) - base, rcond=None)[0] for one in views]
        return np.stack([noise + slopes @ (correction - best) for correction in found])

    return differences


def refinement_of(turn: Turn) -> tuple[View, TurnRefinement]:
    """Of one frame."""
    view = turn.seen_from(SIGHT)
    dataset = Dataset.from_images([SarImage(np.ones((36, 36), np.float32), view, GRID)], turns=[turn])
    return view, TurnRefinement(dataset, Turns(), 100)


def signature(view: View) -> np.ndarray:
    return view.look.gradients.ravel()


def test_frames_and_what_was_assumed_count_by_their_variance() -> None:
    """One pixel for each correction: the answer is the mean, weighted by the reciprocals of the variances."""
    turn = Turn((0, 0, 1), 70.0, 1.0, 0.02)
    view, refinement = refinement_of(turn)
    best, noise, samples = np.array([0.2, -0.1, 0.004]), np.full(4, 0.5), np.array([40.0])
    std = np.array([1.0, 1.0, 0.02])
    slopes = np.concatenate([np.diag(0.1 / std), np.zeros((1, 3))])
    noise[:3] = 0
    found = np.zeros((1, 3))
    for _ in range(40):
        found = refinement.stepped(found, linear(slopes, best, noise, turn, view), samples, 0.05)
    information = samples[0] * 0.1**2 / 0.5**2
    assert found[0] / best == pytest.approx(information / (1 + information), rel=0.02)


def test_what_is_known_exactly_of_an_uncertain_pass_stays() -> None:
    for std, free in (((2.0, 0.0), [True, True, False]), ((0.0, 0.02), [False, False, True])):
        turn = Turn((0, 0, 1), 70.0, *std)
        view, refinement = refinement_of(turn)
        differences = linear(np.eye(3), np.array([0.2, 0.1, 0.01]), np.ones(3), turn, view)
        found = refinement.stepped(np.zeros((1, 3)), differences, np.array([50.0]), 0.05)
        assert (found[0] != 0).tolist() == free


def test_what_would_be_most_unlikely_is_not_believed() -> None:
    turn = Turn((0, 0, 1), 70.0, 0.5, 0.01)
    view, refinement = refinement_of(turn)
    differences = linear(np.eye(3), np.array([40.0, 0.1, 0.3]), np.ones(3), turn, view)
    found = np.zeros((1, 3))
    for _ in range(30):
        found = refinement.stepped(found, differences, np.array([1e6]), 0.05)
    assert found[0, 0] == 1.5 and abs(found[0, 2]) <= 0.03


@pytest.mark.parametrize("damaged", [torch.zeros(3, 3), torch.zeros(2), torch.full((2, 3), torch.nan)])
def test_corrections_of_another_training_are_refused(refined: Run, damaged: torch.Tensor) -> None:
    run = replace(refined)
    tensors = refined.snapshot.tensors | {TURN_CORRECTIONS: damaged.double()}
    run.__dict__["snapshot"] = replace(refined.snapshot, tensors=tensors)
    with pytest.raises(SarsplatError, match=r"corrections of rotations|uncertain pass"):
        run.views_of(refined.dataset)
