"""Class, azimuth and odds of made-up chips by runs of known Gaussians."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from made import FEW_POINTS, dataset_of, upright
from made_runs import made_up
from sarsplat import (
    Dataset,
    ImageGrid,
    Run,
    SarsplatError,
    SarsplatWarning,
    View,
    import_mstar,
    locate,
    preset,
    read_dataset,
    reconstruct,
    write_dataset,
)
from sarsplat.recognition import Calibration, Located, write_back

MSTAR = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"

GRID = ImageGrid(44, 40, (0.3, 0.3), (0.4, 0.4))
ROW = np.arange(-2.25, 2.3, 0.75)
PARTS = {
    "long": [*((x, 0.0, 0.4) for x in ROW), *((2.25, y, 0.9) for y in (-1.5, -0.75, 0.75, 1.5))],
    "angle": [*((x, -1.5, 0.4) for x in ROW), *((2.25, y, 0.4) for y in ROW[2:])],
    "pair": [(x, y, 0.4) for x in (-2.25, -1.5, 1.5, 2.25) for y in (-0.75, 0.0, 0.75)],
}
"""Positions of the Gaussians of each target, m; the pair looks the same from the opposite side."""

QUICK = {"step_deg": 6.0, "window_m": 8.4}


def run_of(name: str) -> Run:
    """A target of bright Gaussians on a carpet of faint ones."""
    axis = np.arange(-10.0, 10.1, 1.25)
    ground = np.stack(np.meshgrid(axis, axis, [0.0]), axis=-1).reshape(-1, 3)
    means, count = np.concatenate([PARTS[name], ground]), len(PARTS[name])
    law = torch.tensor([[10.0]] * count + [[-8.0]] * len(ground))
    gaussians = upright(means, torch.tensor([[0.3]] * count + [[0.8]] * len(ground)), 4.0, law)
    views = [View(azimuth, 20.0) for azimuth in range(0, 360, 60)]
    images = Run.from_gaussians(gaussians, GRID, views).render(views)
    dataset = dataset_of(GRID, [(view, "train") for view in views], images, target=name)
    return Run.from_gaussians(gaussians, dataset=dataset)


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    return {name: run_of(name) for name in PARTS}


def speckled(
    run: Run, azimuths: Sequence[float], seed: int, gain: float = 1.0, rolled: tuple[int, int] = (0, 0)
) -> Dataset:
    """Test images of a run with speckle, displaced by whole pixels."""
    views = [View(azimuth, 20.0) for azimuth in azimuths]
    power = gain * np.roll(run.render(views), rolled, (1, 2))
    power = (power * np.random.default_rng(seed).exponential(size=power.shape)).astype(np.float32)
    return dataset_of(GRID, [(view, "test") for view in views], power, target=run.target)


@pytest.fixture(scope="module")
def images(runs: dict[str, Run]) -> list[Dataset]:
    azimuths = np.random.default_rng(1).uniform(0, 360, (3, 8)).tolist()
    return [
        speckled(run, own, k, 100.0, (3, -2)) for k, (run, own) in enumerate(zip(runs.values(), azimuths, strict=True))
    ]


@pytest.fixture(scope="module")
def located(runs: dict[str, Run], images: list[Dataset]) -> Located:
    return locate([*runs.values()], images, **QUICK)


def test_class_azimuth_displacement_and_gain(located: Located) -> None:
    assert located.classes == ("angle", "long", "pair")
    assert located.scores()["accuracy"] >= 0.95
    unique = np.array([chip.target != "pair" for chip in located.chips])
    errors = np.abs(located.azimuth_errors_deg[unique])
    assert np.median(errors) < 3
    assert errors.max() < 20
    own = located.labels[:, None]
    assert np.abs(np.take_along_axis(located.gain_db, own, 1) - 20).max() < 3
    shifts = np.take_along_axis(located.shift_m, own[..., None], 1)[:, 0]
    np.testing.assert_allclose(np.median(shifts, axis=0), (-0.6, 0.9))


def test_a_target_that_looks_the_same_from_behind_may_be_reversed(located: Located) -> None:
    reversed_odds = np.take_along_axis(located.reversed_odds, located.labels[:, None], 1)[:, 0]
    pair = np.array([chip.target == "pair" for chip in located.chips])
    assert reversed_odds[pair].min() > 0.4
    assert np.median(reversed_odds[~pair]) < 0.25
    assert located.scores()["azimuth within one standard deviation"] > 0.4


def test_sizes_of_images_change_neither_shift_nor_window_of_others(runs, images, located: Located) -> None:
    """Also where the origin is in a pixel's centre instead of between pixels, and where less is shown."""
    entries = speckled(runs["long"], [40.0, 160.0], 0).entries
    for rows, columns in ((45, 40), (38, 35)):
        grid = replace(GRID, rows=rows, columns=columns)
        power = np.roll(runs["long"].render([entry.view for entry in entries], grid), (1, 2), (1, 2))
        sized = Dataset(grid, entries, power, target="long")
        found = locate([*runs.values()], [images[0], sized], **QUICK)
        np.testing.assert_allclose(found.shift_m[8:, 1], [(0.6, 0.3)] * 2)
        assert np.abs(found.azimuth_errors_deg[8:]).max() < 1
        np.testing.assert_array_equal(found.nats[:8], located.nats[:8])
    views, finer = [entry.view for entry in entries], replace(GRID, spacing_m=(0.25, 0.25))
    grids = [replace(finer, rows=rows, columns=columns) for rows, columns in ((40, 38), (60, 58))]
    small, large = (Dataset(grid, entries, runs["long"].render(views, grid), target="long") for grid in grids)
    found, other = (locate([runs["long"]], each, **QUICK) for each in ([small, large], [large, small]))
    np.testing.assert_array_equal(found.nats, other.nats[[2, 3, 0, 1]])


def test_labelled_azimuths_that_images_contradict_are_named(runs: dict[str, Run], images: list[Dataset]) -> None:
    entries, found = images[0].entries, locate([runs["long"]], images[0], **QUICK)
    assert len(found.contradicted) == 0
    wrong = replace(entries[2], view=replace(entries[2].view, azimuth_deg=(entries[2].view.azimuth_deg + 60) % 360))
    found = locate([runs["long"]], replace(images[0], entries=(*entries[:2], wrong, *entries[3:])), **QUICK)
    named = found.scores_in_words()["labelled azimuths contradicted"]
    assert re.fullmatch(r"1 of 8, by -\d\d° in the median: 002", named)


def numbers(located: Located) -> list[dict[str, str]]:
    return sorted(located.rows(), key=lambda row: (row["labelled_class"], row["image"]))


def test_neither_order_nor_threads_change_a_bit(runs, images, located: Located, threads) -> None:
    threads(2)
    other = locate([*runs.values()][::-1], [images[2], images[0].take([*range(7, -1, -1)]), images[1]], **QUICK)
    assert numbers(other) == numbers(located)
    np.testing.assert_array_equal(other.nats[:8], located.nats[16:])
    np.testing.assert_array_equal(other.nats[8:16], located.nats[7::-1])
    alone = locate([*runs.values()], images[0].take([3]), **QUICK)
    np.testing.assert_array_equal(alone.odds[0], located.odds[3])


def test_one_run_gives_the_pose_alone(runs: dict[str, Run], images: list[Dataset], located: Located) -> None:
    pose = locate([runs["long"]], images[0], **QUICK)
    assert (pose.odds == 1).all() and "accuracy" not in pose.scores()
    assert pose.scores()["azimuth within 5°"] >= 0.8
    with pytest.raises(SarsplatError, match="no labelled image of a second class"):
        locate([runs["long"]], images[0].take([0]), calibrate=[images[0].take([1, 2])], **QUICK)


def test_images_to_be_located_do_not_calibrate(runs: dict[str, Run], images: list[Dataset], tmp_path: Path) -> None:
    every, tested = [*runs.values()], [one.take([0, 1]) for one in images]
    calibrated = locate(every, tested, calibrate=images, **QUICK)
    assert calibrated.calibration.images == 3 * 6
    assert 1 < calibrated.calibration.temperature < 4  # models are exact, and speckle is white
    assert calibrated.rows()[0]["calibrated"] == "yes"
    errors = {"`calibrate` has no image of these classes": tested, "no labelled image of angle": images[:1]}
    for sentence, nothing in errors.items():
        with pytest.raises(SarsplatError, match=sentence):
            locate(every, tested, calibrate=nothing, **QUICK)
    calibrated.calibration.write(tmp_path / "c.json")
    again = locate(every, tested, calibrate=tmp_path / "c.json", **QUICK)
    np.testing.assert_array_equal(again.odds, calibrated.odds)
    with pytest.raises(SarsplatError, match=r"c\.json was made with .*'step_deg': 6\.0.*, not .*'step_deg': 12\.0"):
        locate(every, tested, calibrate=tmp_path / "c.json", step_deg=12, window_m=8.4)


def test_fitted_odds_are_true() -> None:
    """Of likelihoods that are overconfident and prefer a class, in numbers that were not fitted."""
    rng, names = np.random.default_rng(0), ("a", "b", "c")
    usual = Calibration(runs=dict(zip(names, names, strict=True)), settings={})
    labels, samples = rng.integers(0, 3, 4000), np.full(4000, 1000.0)
    logits = rng.normal(0, 1.5, (4000, 3)) + 2.25 * np.eye(3)[labels]  # odds of these are true
    nats = -logits * 40 / samples[:, None] - np.array([0.02, 0, 0])
    fitted = usual.fitted(nats[:300], samples[:300], labels[:300], np.array([-2.0, 1.0, 3.0]) * 0.6745)
    assert fitted.temperature == pytest.approx(40, rel=0.25)
    assert fitted.bias["a"] - fitted.bias["b"] == pytest.approx(0.02, abs=0.015)
    assert fitted.azimuth_scale == pytest.approx(2)
    odds = fitted.odds(nats[300:], samples[300:])
    claimed, right = odds.max(axis=1), odds.argmax(axis=1) == labels[300:]
    for low, high in ((0.4, 0.7), (0.7, 0.9), (0.9, 1.0)):
        within = (claimed > low) & (claimed <= high)
        assert right[within].mean() == pytest.approx(claimed[within].mean(), abs=0.05)


def test_pictures_need_a_grazing_angle_alone(runs: dict[str, Run], images: list[Dataset], tmp_path: Path) -> None:
    level = np.sqrt(images[0].power[0] / images[0].power[0].max())
    Image.fromarray(np.rint(255 * level[::-1, ::-1]).astype(np.uint8)).save(tmp_path / "chip.png")
    every = [*runs.values()]
    found = locate(every, tmp_path, grazing_deg=20.0, near="bottom", **QUICK)
    assert found.chips[0].name == "chip.png"
    assert found.rows()[0]["class"] == "long"
    assert found.rows()[0]["labelled_azimuth_deg"] == ""
    assert found.scores() == {}
    with pytest.raises(SarsplatError, match="have no grazing angle; give it as `grazing_deg`"):
        locate(every, tmp_path)
    (tmp_path / "chip.png").unlink()
    np.save(tmp_path / "chip.npy", 20 * np.log10(np.maximum(level[::-1, ::-1], 1e-3)))
    with pytest.raises(SarsplatError, match="unknown meaning; say by `quantity`"):
        locate(every, tmp_path, grazing_deg=20.0, near="bottom", **QUICK)
    decibels = locate(every, tmp_path, grazing_deg=20.0, near="bottom", quantity="db", **QUICK)
    np.testing.assert_allclose(decibels.nats, found.nats, atol=0.02)
    coarser = Run.from_gaussians(
        runs["pair"].gaussians, replace(GRID, spacing_m=(0.4, 0.4)), runs["pair"].dataset.views
    )
    with pytest.raises(SarsplatError, match="pictures have the runs' pixels, but these differ"):
        locate([*every, coarser], tmp_path, grazing_deg=20.0)


def test_images_without_azimuth_are_located_too(runs, images, tmp_path: Path, monkeypatch) -> None:
    lost = {"name": "lost", "file": "unplaced/000.tif", "set": "test", "grazing_deg": 20.0}
    power = images[0].power[1]
    train = replace(images[0].entries[0], split="train")
    dataset = replace(images[0], entries=(train, *images[0].entries[1:]), source={"unplaced": [lost]})
    write_dataset(tmp_path / "data", dataset, pictures={lost["file"]: power}, masks=np.zeros_like(dataset.power, "u1"))
    found = locate([*runs.values()], tmp_path / "data", **QUICK)
    assert [chip.name for chip in found.chips] == [*(f"{k:03d}" for k in range(1, 8)), "lost"]
    np.testing.assert_array_equal(found.nats[7], found.nats[0])
    assert np.isnan(found.azimuth_errors_deg[7])
    copy = write_back(found, tmp_path / "data", tmp_path / "copy")
    assert copy.entries[:-1] == dataset.entries and (tmp_path / "copy" / "masks" / "000.png").is_file()
    placed = copy.entries[-1]
    assert (placed.name, placed.split, placed.view.grazing_deg) == ("lost", "test", 20.0)
    assert abs(placed.view.azimuth_deg - dataset.entries[1].view.azimuth_deg) < 5
    assert 0 < placed.azimuth_std_deg == pytest.approx(found.azimuth_std_deg[7, 1])
    np.testing.assert_array_equal(read_dataset(tmp_path / "copy").power[-1], power)
    signal = np.sqrt(dataset.power).astype(np.complex64)
    masks, waves = np.zeros_like(dataset.power, "u1"), replace(dataset, power=signal.real**2, signal=signal)
    write_dataset(tmp_path / "complex", waves, pictures={lost["file"]: power}, masks=masks)
    assert write_back(found, tmp_path / "complex", tmp_path / "of power").entries == copy.entries
    assert (tmp_path / "of power" / "masks" / "000.png").is_file()
    monkeypatch.setattr(sys.modules["sarsplat.recognition.located"], "_MAX_REVERSED", -1.0)
    with pytest.raises(SarsplatError, match=r"no image of .*data gets an azimuth"):
        write_back(found, tmp_path / "data", tmp_path / "other")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"runs": []}, "there are no runs"),
        ({"images": []}, "there are no images of the set test"),
        ({"split": "test-9"}, "there are no images of the set test-9"),
        ({"step_deg": 7}, "step_deg is 7; give a divisor of 360"),
        ({"ground": "wet"}, "ground is 'wet'; give one of 'learned', 'flat'"),
        ({"ground": "flat"}, "a run has learned no ground"),
        ({"window_m": 0.2}, "images of 44 × 40 pixels leave no window"),
        ({"images": "nowhere"}, "nowhere contains neither datasets nor pictures"),
    ],
)
def test_mistakes(runs: dict[str, Run], images: list[Dataset], changes: dict[str, object], sentence: str) -> None:
    given = {"runs": [*runs.values()], "images": images[0].take([0]), **QUICK, **changes}
    with pytest.raises(SarsplatError, match=sentence):
        locate(given.pop("runs"), given.pop("images"), **given)  # type: ignore[arg-type]


def test_grazing_angles_far_from_the_trainings_are_warned_of(runs: dict[str, Run], images: list[Dataset]) -> None:
    with pytest.warns(SarsplatWarning, match="are up to 25° from those that a run of angle has seen"):
        locate([*runs.values()], images[0].take([0]), grazing_deg=45.0, **QUICK)
    with pytest.raises(SarsplatError, match="000 is black; leave it out"):
        locate([*runs.values()], replace(images[0].take([0]), power=np.zeros((1, 44, 40), np.float32)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
@pytest.mark.skipif(not MSTAR.is_dir(), reason="needs the MSTAR chips in ../shared/data")
def test_mstar_chips(tmp_path: Path) -> None:
    few = {"iterations": 100, "gaussians": 3000, "fewest_gaussians": 3000, "points": FEW_POINTS}
    runs, images = [], []
    for name in ("T72", "BMP2"):
        chosen = {"labels": MSTAR / "labels.csv", "target_class": name, "train_views": 12}
        dataset = import_mstar(MSTAR, tmp_path / name, **chosen)
        runs.append(reconstruct(dataset, replace(preset("measured"), **few), quiet=True))
        images.append(dataset.select("test-15").take([*range(0, 190, 19)]))
    scores = locate(runs, images).scores()
    assert scores["accuracy"] >= 0.85
    assert scores["median azimuth error, °"] < 2


def test_table_and_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from sarsplat.cli import main

    for name in ("box", "cone"):
        made_up(name, tmp_path / name)
    words = [str(tmp_path / name) for name in ("box", "cone", "box-data")]
    out, more = tmp_path / "found.csv", ["--step", "30", "--ground", "flat"]
    assert main(["locate", *words, "--out", str(out), *more]) == 0
    said = capsys.readouterr()
    assert "the odds are uncalibrated; give --calibrate" in " ".join(said.err.split())
    lines = out.read_text().splitlines()
    assert len(lines) == 7
    assert lines[0].startswith("image,class,runner_up,odds,azimuth_deg,azimuth_std_deg,reversed_odds,azimuth_shift_m")
    page = out.with_suffix(".html").read_text()
    assert "The odds are uncalibrated" in page
    assert page.count("<img src=") == 12
    assert "Reliability" in page
    for change, sentence in (
        (["locate", *words, "--out", str(out)], "found.csv already exists"),
        (["locate", *words, "--out", str(tmp_path / "x.txt")], "does not end in .csv"),
        (
            ["locate", *words[:2], "--out", str(tmp_path / "x.csv"), "--write-back", str(tmp_path / "y")],
            "--write-back copies one dataset",
        ),
    ):
        assert main(change) == 2
        assert sentence in " ".join(capsys.readouterr().err.split())
