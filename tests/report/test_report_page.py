"""The report of runs of every kind."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from datasets import dataset_of
from sarsplat.data import Dataset, write_dataset
from sarsplat.evaluation import PaperRow
from sarsplat.geometry import ImageGrid, View
from sarsplat.reconstruction import preset
from sarsplat.reconstruction.run import LogLine
from sarsplat.report import paper_beside, write_report
from sarsplat.report.scores import score_tables

GRID = ImageGrid(32, 32, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
IMAGE_SCORES = ("psnr_db", "psnr_target_db", "ssim", "lpips", "nats_per_pixel", "log_correlation")
POINT_SCORES = (
    *("accuracy_m", "completeness_m", "cd_m", "cd_squared_m2", "precision@0.3", "recall@0.3"),
    *("f1@0.3", "f1@0.2", "f1@0.1", "count"),
)


@pytest.fixture(autouse=True)
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that are quick to draw."""
    monkeypatch.setattr("sarsplat.report.write._SURFACE_SAMPLES", 500)


def words_of(page: Path) -> str:
    """The page without the letters that pictures are coded in."""
    return re.sub(r"base64,[A-Za-z0-9+/=]+", "base64,", page.read_text())


def make_dataset(
    folder: Path, *, measured: bool = False, tests: int = 5, target: str = "t72", mesh: bool = True
) -> Dataset:
    power = np.full((2 + tests, 32, 32), 1.0 if measured else 0.0, dtype=np.float32)
    power[:, 12:20, 10:22] = 5.0
    views = [(View(10.0 * k, 30.0), "train" if k < 2 else "test") for k in range(2 + tests)]
    fields = {"calibration": "relative", "looks": 1.0, "ground": True} if measured else {"protocol": "paper"}
    source = {"law": {"floor": 0.1, "lobe": 0.9}}
    dataset = dataset_of(GRID, views, power, target=target, source=source, **fields)
    return write_dataset(folder / "dataset", dataset, truth_mesh=trimesh.creation.box() if mesh else None)


def make_run(folder: Path, dataset: Dataset, metrics: dict[str, Any] | None, **changes: Any) -> Any:
    run = folder / "run"
    run.mkdir()
    rng = np.random.default_rng(0)
    fields = {
        "path": run,
        "folder": run,
        "dataset": dataset,
        "config": preset("measured" if dataset.ground else "default"),
        "metrics": metrics,
        "gaussians": range(1234),
        "points": rng.uniform(-0.5, 0.5, (200, 3)),
        "time_s": 12.5,
        "seed": 7,
        "iteration": 20,
        "history": [LogLine(k, float(k), 1 / k, 1234) for k in (1, 10, 20)],
        "render": lambda views: np.full((len(views), 32, 32), 0.5, dtype=np.float32),
    }
    return SimpleNamespace(**{**fields, **changes})


def make_metrics(**scores: float) -> dict[str, Any]:
    points = {name: None if name not in ("cd_m", "f1@0.3") else 0.0625 for name in POINT_SCORES}
    return {
        "images": {"test": {**dict.fromkeys(IMAGE_SCORES), **scores}},
        "points": {"visible": points, "whole": points},
        "domain": {"psnr_ssim_lpips": "what was compared"},
        "reasons": {"images.test.lpips": "no weights here"},
    }


def test_the_page_stands_alone(tmp_path: Path) -> None:
    page = write_report(make_run(tmp_path, make_dataset(tmp_path), make_metrics(psnr_db=51.23, ssim=0.999)))
    assert page == tmp_path / "run" / "report" / "index.html"
    text = words_of(page)
    for link in re.findall(r'(?:src|href|url)\s*[=(]\s*["\']?([^"\'>)\s]+)', text):
        assert link == "data:image/png;base64,"
    assert "http" not in text
    assert "<script" not in text
    assert "@import" not in text
    for name in ("views.png", "points.png", "curves.png"):
        assert (page.parent / name).read_bytes().startswith(b"\x89PNG")
    assert text.count("data:image/png;base64,") == 3


def test_the_page_says_what_matters(tmp_path: Path) -> None:
    run = make_run(tmp_path, make_dataset(tmp_path), make_metrics(psnr_db=51.23, ssim=0.999))
    text = words_of(write_report(run))
    expected = ("1,234 Gaussians", "51.23", "35.91", "0.062", "0.187", "no weights here", "what was compared")
    for words in (*expected, "12.5 s", "5 of 5 test views", "floor 0.1, lobe 0.9", "<dt>seed</dt><dd>7</dd>"):
        assert words in text, words
    assert '<td class="best">51.23</td>' in text


def test_the_figures_of_the_paper_stand_with_a_caution(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path)
    told = "The paper&#x27;s figures are not the same experiment"
    assert told in words_of(write_report(make_run(tmp_path, dataset, make_metrics())))
    elsewhere = replace(dataset, protocol=None)
    (tmp_path / "other").mkdir()
    assert told not in words_of(write_report(make_run(tmp_path / "other", elsewhere, make_metrics())))


def test_names_from_files_cannot_become_markup(tmp_path: Path) -> None:
    hostile = "<script>alert(1)</script>$style"
    text = words_of(write_report(make_run(tmp_path, make_dataset(tmp_path, target=hostile), None)))
    assert "<script>" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;$style" in text


def test_a_measured_run_is_compared_with_the_yardsticks(tmp_path: Path) -> None:
    metrics = make_metrics(nats_per_pixel=0.5, log_correlation=0.8)
    metrics["yardsticks"] = {"test": {"nearest_chip": {"nats_per_pixel": 0.6, "log_correlation": 0.85}}}
    metrics["points"] = {part: dict.fromkeys(POINT_SCORES) for part in ("visible", "whole")}
    text = words_of(write_report(make_run(tmp_path, make_dataset(tmp_path, measured=True, mesh=False), metrics)))
    assert "nearest chip" in text
    assert '<td class="best">0.500</td><td class="">0.600</td>' in text
    assert '<td class="">0.800</td><td class="best">0.850</td>' in text
    assert "paper, T72" not in text
    assert "3×3 means" in text


@pytest.mark.parametrize("tests", [0, 1, 3])
def test_few_views_no_points_no_history_no_scores(tmp_path: Path, tests: int) -> None:
    run = make_run(tmp_path, make_dataset(tmp_path, tests=tests), None, points=np.empty((0, 3)), history=[])
    page = write_report(run)
    assert "Not evaluated yet" in page.read_text()
    assert not (page.parent / "curves.png").exists()


def test_a_report_is_replaced(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path)
    run = make_run(tmp_path, dataset, None)
    write_report(run)
    run.metrics = make_metrics(psnr_db=44.44)
    assert "44.44" in write_report(run).read_text()


def test_scores_that_do_not_apply_have_no_row() -> None:
    images, points = score_tables(make_metrics(psnr_db=50.0), None)
    assert [row.name for row in images.rows] == ["PSNR, whole image, dB"]
    assert [row.name for row in points.rows] == ["Chamfer distance, m", "F1 at 0.3 m"]


def test_the_row_of_the_paper_is_that_of_the_target() -> None:
    def beside(**fields: Any) -> PaperRow | None:
        return paper_beside(dataset_of(GRID, [(View(0, 30), "train")], np.ones((1, 32, 32), np.float32), **fields))

    for name, target in (("BTR70", "BTR70"), ("unnamed", "T72")):
        row = beside(target=name, protocol="paper")
        assert row is not None
        assert row.target == target
    for other in ({"protocol": None}, {"protocol": "paper", "looks": 1.0}, {"protocol": "paper", "ground": True}):
        assert beside(**other) is None
