"""Runs side by side."""

import re
from pathlib import Path
from typing import Any

import pytest

from chromium import chromium
from made_runs import MadeUpRun, make_dataset, make_metrics, make_run
from sarsplat.errors import SarsplatError
from sarsplat.report import compare, write_comparison
from sarsplat.report.page import compared_tables
from sarsplat.runs.run_folder import TrainingState


def two_runs(folder: Path, **changes: Any) -> list[Any]:
    dataset = make_dataset(folder)
    runs = []
    for name, psnr in (("one", 50.0), ("two", 40.0)):
        (folder / name).mkdir()
        metrics = make_metrics(psnr_db=psnr) | {"time_s": psnr}
        metrics["by_image"] = {"test": {"metric": "psnr_db", "scores": [psnr, psnr, psnr - 10, psnr, psnr]}}
        run = make_run(
            folder / name, dataset, metrics, fingerprint="same", grid=dataset.grid, dataset_path=dataset.path
        )
        run.folder = run.path = run.path.rename(folder / f"run-{name}")
        runs.append(run)
    for name, value in changes.items():
        setattr(runs[1], name, value)
    return runs


def test_the_best_of_a_row_is_marked_and_every_run_has_its_column(tmp_path: Path) -> None:
    images, points, training = compare(two_runs(tmp_path)).tables
    assert [column.name for column in images.columns] == ["run-one", "run-two"]
    assert [(cell.text, cell.best) for cell in images.rows[0].cells] == [("50.00", True), ("40.00", False)]
    assert [cell.best for cell in points.rows[0].cells] == [True, True]
    assert [(cell.text, cell.best) for cell in training.rows[0].cells] == [("50", False), ("40", True)]


def test_baselines_stand_beside_the_runs_and_are_named_where_they_win(tmp_path: Path) -> None:
    runs = two_runs(tmp_path)
    for run in runs:
        run.metrics["baselines"] = {"test": {"rotated_average": {"psnr_db": 45.0}}}
    comparison = compare(runs)
    images = comparison.tables[0]
    assert [column.name for column in images.columns] == ["run-one", "run-two", "rotated average"]
    assert [cell.text for cell in images.rows[0].cells] == ["50.00", "40.00", "45.00"]
    (sentence,) = comparison.beaten
    assert sentence.startswith("on the set test the baseline rotated average") and "better than run-two" in sentence
    assert f"O{sentence[1:]}." in write_comparison(comparison, tmp_path / "page").read_text()


def test_runs_with_different_thresholds_and_test_sets_keep_theirs() -> None:
    one, two = make_metrics(psnr_db=50.0) | {"time_s": 1.0}, make_metrics(ssim=0.5) | {"time_s": None}
    two["images"] = {"test-15": two["images"]["test"]}
    two["parameters"] = two["parameters"] | {"yardstick_m": 3.0}
    two["points"] = {"visible": {"f1@3": 0.75}}
    titles = {table.title: [row.metric.title for row in table.rows] for table in compared_tables("ab", [one, two])}
    assert titles["Unseen views: test"] == ["PSNR, whole image, dB"]
    assert titles["Unseen views: test-15"] == ["SSIM"]
    assert titles["Points, visible surface"] == ["Chamfer distance, m", "F1 at 0.3 m", "F1 at 3 m"]


def test_the_page_shows_the_same_views_of_every_run(tmp_path: Path) -> None:
    comparison = compare(two_runs(tmp_path))
    assert comparison.caution is None
    page = write_comparison(comparison, tmp_path / "page")
    text = page.read_text()
    assert not re.search(r"https?:|@import|<link|<script", text)
    assert "(worst of all)" in text
    for name in ("run-one", "run-two"):
        assert len(re.findall(f'alt="{name}, azimuth', text)) == 5
        assert len(re.findall(f'alt="error of {name}, azimuth', text)) == 5
        assert f'alt="error of {name}, from the top"' in text
    with pytest.raises(SarsplatError, match="already exists"):
        write_comparison(comparison, tmp_path / "page")
    write_comparison(comparison, tmp_path / "page", overwrite=True)


def test_other_surfaces_and_unfinished_trainings_are_said(tmp_path: Path) -> None:
    runs = two_runs(tmp_path)
    runs[0].metrics["truth"] = {"mesh": None, "sha256": "a"}
    assert compare(runs).caution is None  # the other one is of an older version, and does not say
    runs[1].metrics["truth"] = {"mesh": "other.ply", "sha256": "b"}
    assert "held against different surfaces" in str(compare(runs).caution)
    runs[1].state = TrainingState(1200, 5000, has_results=False)
    caution = str(compare(runs).caution)
    assert caution.startswith("The points of these runs")
    assert caution.endswith("run-two is unfinished, 1,200 of 5,000 iterations.")


def test_runs_of_different_datasets_are_compared_with_a_caution(tmp_path: Path) -> None:
    (tmp_path / "ship").mkdir()
    ship = make_dataset(tmp_path / "ship", tests=2, target="ship", mesh=False)
    runs = two_runs(tmp_path, fingerprint="other", dataset=ship)
    runs[1].metrics["by_image"]["test"]["scores"] = [40.0, 30.0]
    comparison = compare(runs)
    assert "different datasets" in str(comparison.caution)
    assert not [cell for table in comparison.tables for row in table.rows for cell in row.cells if cell.best]
    text = write_comparison(comparison, tmp_path / "page").read_text()
    assert str(comparison.caution).split(":")[0] in text
    assert "<h1>t72 and ship</h1>" in text
    assert "The best of a row" not in text
    for name, views in (("run-one", 5), ("run-two", 2)):  # each against the images of its own dataset
        assert len(re.findall(f'alt="error of {name}, azimuth', text)) == views
        assert f"The same views: {name}" in text
    assert 'alt="error of run-one, from the top"' in text
    assert 'alt="error of run-two, from the top"' not in text


@pytest.mark.parametrize(
    ("chosen", "changes", "words"),
    [
        ((0, 1), {"metrics": None}, "run-two has no scores yet; run `sarsplat evaluate"),
        ((0, 1), {"metrics": {"images": {}}}, "does not contain all scores"),
        ((0, 0), {}, "given twice"),
        ((0,), {}, "at least two"),
    ],
)
def test_what_cannot_be_compared(tmp_path: Path, chosen: tuple[int, ...], changes: dict[str, Any], words: str) -> None:
    runs = two_runs(tmp_path, **changes)
    with pytest.raises(SarsplatError, match=words):
        compare([runs[k] for k in chosen])


@pytest.mark.parametrize("shared", [(2,), (3,), (4,), (1, 1), (2, 1, 1), (1, 1, 1, 1), (3, 1)])
def test_the_page_is_at_most_three_screens_long_and_its_tables_aligned(tmp_path: Path, shared: tuple[int, ...]) -> None:
    runs = []
    for number, count in enumerate(shared):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        first, _ = two_runs(folder, fingerprint=f"{number}")
        for copy in range(count):
            named = {"folder": folder / f"run-{number}-{copy}", "fingerprint": f"{number}"}
            runs.append(MadeUpRun(**{**vars(first), **named}))
    page = write_comparison(compare(runs), tmp_path / "page")
    with chromium() as browser:
        browser.page.size(1400, 900)
        browser.page.open(page.as_uri())
        assert browser.page.value("document.documentElement.scrollHeight") <= 3 * 900
        edges = "[...document.querySelectorAll('thead')].map(e => [...e.querySelectorAll('th')].map(c => c.offsetLeft))"
        first, *others = browser.page.value(edges)
        assert len(first) == 1 + len(runs) and others == [first] * len(others)
        places = browser.page.value("[...document.querySelectorAll('.halves .figure')].map(e => e.offsetLeft)")
        if len(shared) > 1:
            assert len(places) == len(shared) and len(set(places)) == 2  # side by side
        assert browser.page.value("document.querySelectorAll('.board').length") == len(runs)
        browser.page.size(390, 900)
        assert browser.page.value("document.documentElement.scrollWidth") <= 390
