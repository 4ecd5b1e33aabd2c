"""The benchmark of chips: what it draws, makes and writes; and statistics of generated chips."""

import csv
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from chip_files import COLUMNS
from made import FEW_POINTS
from sarsplat import mstar_grid, preset, reconstruct
from sarsplat.geometry.responses import TAYLOR
from sarsplat.scenes.scattering import ResponseSpeckle

SIZE, AROUND = 100, range(0, 360, 40)
CLASSES = {"bar": (slice(44, 56), slice(30, 70)), "block": (slice(38, 62), slice(40, 60))}


@pytest.fixture(scope="module")
def chips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder and its labels.csv; of one chip the azimuth is unknown."""
    folder, chance = tmp_path_factory.mktemp("chips"), np.random.default_rng(0)
    with (folder / "labels.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for name, where in CLASSES.items():
            for depression in (17, 15):
                for number, azimuth in enumerate([*AROUND, ""]):
                    power = chance.exponential(size=(SIZE, SIZE))
                    power[where] *= 40
                    path = folder / name / f"{depression}-{number}.jpeg"
                    path.parent.mkdir(exist_ok=True)
                    pixels = np.sqrt(power) / np.sqrt(power).max() * 255
                    Image.fromarray(pixels.astype(np.uint8)).save(path, quality=75)
                    table.writerow([f"{name}/{path.name}", name, "1", depression, depression, azimuth])
    return folder


class Here:
    """Does at once and here what is submitted."""

    map = staticmethod(map)

    def submit(self, work: Any, *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done


@pytest.fixture
def program(module, monkeypatch: pytest.MonkeyPatch) -> Any:
    """With trainings of three steps, and networks of two."""
    draws, arms, classifier = (module(f"experiments/{name}") for name in ("chip_draws", "chip_arms", "classifier"))
    few = {"iterations": 3, "gaussians": 60, "fewest_gaussians": 60, "checkpoint_every": 3}
    config = replace(preset("measured"), **few, points=FEW_POINTS)

    def quick(dataset: Path, _: str, out: Path, **how: Any) -> None:
        reconstruct(dataset, config, out, quiet=True, resume=how["resume"])

    monkeypatch.setattr(draws, "reconstruct", quick)
    monkeypatch.setattr(arms, "EACH", 6)
    for name, value in (("_BATCH", 4), ("_RECKONED", 1), ("_RECKONED_AT_A_TIME", 4)):
        monkeypatch.setattr(classifier, name, value)
    benchmark = module("experiments/chips")
    monkeypatch.setattr(benchmark, "EVENLY", draws.Draw(4))
    monkeypatch.setattr(benchmark, "STEPS", 2)
    return benchmark


@pytest.mark.filterwarnings("ignore::sarsplat.SarsplatWarning")
@pytest.mark.slow
def test_networks_are_trained_once_and_written_as_they_finish(program, chips, tmp_path, monkeypatch) -> None:
    where = (chips, chips / "labels.csv", tmp_path / "work")
    arms = [name for name in program.ARMS if not name.startswith("sar-nerf")]
    wanted = [(program.EVENLY, arm, 0, 2) for arm in arms] + [(program.EVENLY, "ours-turned", 0, 1)]
    write_page, asked = program.write_page, []

    def whole(out: Path, titles: dict[str, str]) -> None:
        asked.append(len(program.read_lines(out)))
        if asked[-1] == len(wanted):  # a page takes a tenth of a second
            write_page(out, titles)

    monkeypatch.setattr(program, "write_page", whole)
    program.train(wanted, where, tmp_path, Here())
    assert asked == [*range(1, 1 + len(wanted))]
    lines = program.read_lines(tmp_path)
    assert [(line.arm, line.steps) for line in lines] == [(arm, steps) for _, arm, _, steps in wanted]
    for line in lines:
        assert 0 <= line.left_out <= 1
        assert np.isnan(line.test) == np.isnan(line.new_clutter) == (line.steps == 1)  # chosen without test chips
    page = (tmp_path / "chips.md").read_text()
    assert "| + sarsplat, turned |" in page
    assert "… above “+ rotated average, turned”" in page
    before = (tmp_path / "chips-runs.csv").read_bytes()
    program.train(wanted, where, tmp_path, Here())
    assert (tmp_path / "chips-runs.csv").read_bytes() == before


@pytest.mark.filterwarnings("ignore::sarsplat.SarsplatWarning")
def test_draws_are_of_training_chips_alone(program, module, chips: Path, tmp_path: Path) -> None:
    draws = module("experiments/chip_draws")
    measured = draws.Measured.read(chips, chips / "labels.csv")
    chosen = {
        draw.name: measured.chosen(draw, tmp_path) for draw in map(draws.Draw, (3, 3, 3, None), (None, 1, 2, None))
    }
    assert list(chosen) == ["3 evenly", "3 at random 1", "3 at random 2", "all"]
    for which in chosen.values():
        assert set(measured.depression[which]) == {17}
    assert [len(which) for which in chosen.values()] == [6, 6, 6, 20]  # all: that of unknown azimuth as well
    assert set(chosen["3 at random 1"]) != set(chosen["3 at random 2"])
    assert measured.azimuth_deg[chosen["3 evenly"]].tolist() == [0, 120, 240] * 2
    with pytest.raises(program.SarsplatError, match="10 chips of bar are asked for, but there are 9; ask for fewer"):
        draws.datasets(measured, draws.Draw(10, 1), tmp_path)


@pytest.mark.filterwarnings("ignore::sarsplat.SarsplatWarning")
def test_turned_chips_are_turned_in_the_ground_plane(program, module, chips: Path, tmp_path: Path) -> None:
    """By nothing, they are as they were; by a right angle on the ground, what was far lies across."""
    draws, arms = module("experiments/chip_draws"), module("experiments/chip_arms")
    measured = draws.Measured.read(chips, chips / "labels.csv")
    train = draws.datasets(measured, draws.Draw(1), tmp_path)[0].select("train")

    class Chance:
        integers = staticmethod(lambda count: 0)

        def __init__(self, turn: float) -> None:
            self.uniform = lambda low, high: turn

    power = np.zeros((1, SIZE, SIZE), np.float32)
    power[0, 80, 50] = 1.0  # 30 pixels beyond the middle, in slant range
    train = replace(train, power=power)
    assert np.allclose(arms.turned(train, Chance(0.0)), power[0], atol=1e-6)
    quarter = arms.turned(train, Chance(0.5))
    row, column = np.unravel_index(quarter.argmax(), quarter.shape)
    assert abs(row - 50) <= 1
    assert abs(abs(column - 49.5) - 30.5 / np.cos(np.radians(17)) * 0.2021 / 0.2031) <= 1.5


def test_new_clutter_leaves_target_and_shadow(module, chips: Path, tmp_path: Path, monkeypatch) -> None:
    draws, controls = module("experiments/chip_draws"), module("experiments/chip_controls")
    measured = draws.Measured.read(chips, chips / "labels.csv")
    masks = np.zeros((SIZE, SIZE), np.uint8)
    masks[38:62, 30:70] = 1

    class Known:
        grid = replace(mstar_grid(), rows=SIZE, columns=SIZE)
        masks = staticmethod(lambda views: np.stack([masks] * len(views)))

    monkeypatch.setattr(controls, "runs", lambda *_: [Known] * 2)
    (tmp_path / "4-evenly").mkdir()
    test = np.flatnonzero(measured.depression == 15)
    replaced = controls.new_clutter(measured, test, draws.Draw(4), tmp_path)
    known = np.isfinite(measured.azimuth_deg[test])
    before, after = (each[known].astype(int) for each in (measured.pixels[test], replaced))
    assert np.array_equal(replaced[~known], measured.pixels[test][~known])
    assert (after != before)[:, :20].mean() > 0.7  # clutter is anew …
    assert np.median(after[:, :20]) == pytest.approx(np.median(before[:, :20]), rel=0.1)  # … and as bright
    assert np.abs(after - before)[:, 37:59, 29:67].mean() < 10  # what is left was compressed again


@pytest.mark.slow
def test_steps_are_what_was_trained(module, monkeypatch) -> None:
    """A network learns to tell two classes apart that differ."""
    classifier = module("experiments/classifier")
    for name, value in (("_BATCH", 16), ("_RECKONED", 2), ("_RECKONED_AT_A_TIME", 16)):
        monkeypatch.setattr(classifier, name, value)
    chance = np.random.default_rng(0)
    chips = chance.integers(0, 60, (24, 96, 96)).astype(np.uint8)
    chips[::2, 40:56, 30:66] += 150
    chips[1::2, 30:66, 40:56] += 150
    classes = np.tile([0, 1], 12)
    own = classifier.Source(chips, classes, 1.0)
    network, loss = classifier.trained(own, [], 2, 0, 15)
    assert loss < 0.4
    assert (classifier.predicted(network, chips) == classes).all()
    again, same = classifier.trained(own, [], 2, 0, 15)
    assert same == loss
    assert classifier.predicted(again, chips[:3]).tolist() == [0, 1, 0]


# ---- statistics of generated chips -----------------------------------------------------------------------------------
CLUTTER = np.zeros((40, 128, 128), np.uint8)


def clutter(seed: int) -> np.ndarray:
    speckle, rng = ResponseSpeckle(replace(mstar_grid(), response=TAYLOR)), np.random.default_rng(seed)
    return np.stack([np.rint(40 * np.abs(speckle.draw(rng))) for _ in CLUTTER]).astype(np.uint8)


def test_neighbours_are_alike_in_speckle_and_not_in_noise(module) -> None:
    alike = module("experiments/chip_statistics").alike
    assert alike(clutter(0), CLUTTER, 1) == pytest.approx(0.48, abs=0.03)
    assert alike(clutter(0), CLUTTER, 2) == pytest.approx(0.52, abs=0.03)
    white = np.random.default_rng(0).integers(0, 255, CLUTTER.shape).astype(np.uint8)
    assert abs(alike(white, CLUTTER, 1)) < 0.02


def test_clutter_is_apart_from_targets(module) -> None:
    statistics = module("experiments/chip_statistics")
    masks = CLUTTER[:1].copy()
    masks[0, 60, 60] = statistics.TARGET
    found = statistics.apart(masks)[0]
    assert (found[60, 60], found[60, 68], found[60, 69]) == (1, 3, 0)


def test_histograms_are_as_far_apart_as_their_levels(module) -> None:
    statistics = module("experiments/chip_statistics")
    levels = [np.full_like(CLUTTER[:2], level) for level in (20, 40)]
    distance = statistics.histogram_distance_db(levels[0], CLUTTER[:2], levels[1], CLUTTER[:2], 0)
    assert distance == pytest.approx(6.02, abs=0.01)
    assert statistics.darkness(levels[0] // 10) == 1
    assert statistics.bright_pixels(np.where(CLUTTER[:2] == 0, 128, 0)) == 128 * 128


def test_alike_sets_are_not_told_apart_and_others_are(module, monkeypatch) -> None:
    program = module("experiments/tell_apart")
    for name, value in (("_STEPS", 12), ("_BATCH", 8)):
        monkeypatch.setattr(program, name, value)
    one = clutter(1)[:16]
    assert program.area_under_curve(one, one) == 0.5
    assert program.area_under_curve(one, one // 3) > 0.95
