"""The report of runs of every kind."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from made import dataset_of
from made_runs import METRICS, POINT_KEYS, make_dataset, make_metrics, make_run
from sarsplat import ImageGrid, SarsplatError, View, write_dataset
from sarsplat.evaluation import Alignment, Scores
from sarsplat.report import write, write_report
from sarsplat.report.page import score_tables
from sarsplat.report.widget import widget


def words_of(page: Path) -> str:
    """The page without the letters that pictures are coded in."""
    return re.sub(r"base64,[A-Za-z0-9+/=]+", "base64,", page.read_text())


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a run with a few scores."""
    folder = tmp_path_factory.mktemp("page")
    return write_report(make_run(folder, make_dataset(folder), make_metrics(psnr_db=51.23, ssim=0.999)))


def test_the_page_stands_alone(page: Path) -> None:
    assert page.parts[-3:] == ("run", "report", "index.html")
    assert [file.name for file in page.parent.iterdir()] == ["index.html"]
    text = words_of(page)
    markup = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    for link in re.findall(r'(?:src|href|url)\s*[=(]\s*["\']?([^"\'>)\s]+)', markup):
        assert link == "data:image/png;base64,"
    assert not re.search(r"https?:|@import|<link", text)
    assert "default-src 'none'" in text


@pytest.mark.parametrize("pixels", [64, pytest.param(512, marks=pytest.mark.slow)])
def test_pages_of_speckled_images_stay_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pixels: int) -> None:
    rng = np.random.default_rng(0)
    grid = ImageGrid(pixels, pixels, spacing_m=(0.1, 0.1), resolution_m=(0.1, 0.1))
    views = [(View(7.0 * k, 30.0), "train" if k % 2 else "test") for k in range(50)]
    power = rng.exponential(size=(50, pixels, pixels)).astype(np.float32)
    dataset = dataset_of(grid, views, power, calibration="relative", looks=1.0, ground=True)
    dataset = write_dataset(tmp_path / "dataset", dataset)

    def render(views: list[View]) -> np.ndarray:
        return rng.exponential(size=(len(views), pixels, pixels)).astype(np.float32)  # worse than any model's

    monkeypatch.setattr("sarsplat.report.widget._MOST_RENDERED", 10**9)  # as many views as fit
    page = write_report(make_run(tmp_path, dataset, None, render=render, points=rng.normal(size=(50_000, 3))))
    assert 200_000 < page.stat().st_size < 5_000_000


def test_every_picture_has_words_units_and_a_scale(page: Path) -> None:
    text = words_of(page)
    for picture in re.findall(r"<img [^>]*>", text):
        assert re.search(r'alt="[^"]{5,}"', picture), picture
    for frame in text.split('<div class="frame"')[1:]:
        label = re.findall(r'<span class="label [xy]">([^<]+)</span>', frame)
        assert len(label) >= 2
        assert all(word.endswith((", m", ", degrees", "iteration", "amplitude", "Gaussians")) for word in label[:2])
    of_images = text.count("azimuth, m</span>")
    assert of_images == 3 * 5 + 3  # five views and the widget
    assert text.count('class="radar') == of_images
    of_surfaces = 3 * 3 + 2 * 3 + 1  # points thrice, meshes twice, the widget's cloud
    assert text.count('class="scale') == of_images + of_surfaces
    for bar in re.findall(r'<div class="bar-label">([^<]*)</div>', text):
        assert re.search(r", (dB|m)\b", bar), bar


def test_the_page_says_what_matters(page: Path) -> None:
    text = words_of(page)
    for words in (
        *("1,234 Gaussians", "51.23", "35.91", "0.0625", "0.187", "LPIPS: no weights here", "F1 at 0.3 m: no points"),
        *("12.5 s", "5 of 5 test views", "floor 0.1, lobe 0.9", "<dt>seed</dt><dd>7</dd>", "mean_power = 0.125"),
        "The paper&#39;s figures are not the same experiment",
    ):
        assert words in text, words
    assert '<td data-column="sar-gs" class="best">51.23</td>' in text
    assert f"<summary>SSIM ↑</summary><p>{METRICS[2].definition}</p>" in text
    assert METRICS[3].definition not in text  # LPIPS was not computed


def test_names_from_files_cannot_become_markup(tmp_path: Path) -> None:
    hostile = "<script>alert(1)</script>{{ 7 * 7 }}{% raw %}"
    text = words_of(write_report(make_run(tmp_path, make_dataset(tmp_path, target=hostile), None)))
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;{{ 7 * 7 }}{% raw %}" in text


def test_a_measured_run_is_compared_with_the_baselines_and_headlines_say_who_won(tmp_path: Path) -> None:
    nats, correlation = "registered_nats_per_pixel", "registered_log_correlation"
    metrics = make_metrics(**{nats: 0.5, correlation: 0.8})
    metrics["baselines"] = {"test": {"nearest_chip": {nats: 0.6, correlation: 0.85}}}
    for kind in ("points", "mesh"):
        metrics[kind] = {part: dict.fromkeys(POINT_KEYS) for part in ("visible", "whole")}
    text = words_of(write_report(make_run(tmp_path, make_dataset(tmp_path, measured=True, mesh=False), metrics)))
    cards = text.split('<div class="card">')[1:]
    assert "0.500" in cards[0] and "nearest chip" in cards[0] and "This run is the best." in cards[0]
    assert "Better than this run: nearest chip." in cards[1]
    best = re.findall(r'<td data-column="([^"]*)" class="best">([\d.]+)</td>', text)
    assert best == [("sar-gs", "0.500"), ("nearest chip", "0.850")]
    assert "paper, T72" not in text
    assert "residual ÷ σ of the speckle" in text
    assert "speckle of 1 look leaves in that average of 9.0 independent samples" in text


def test_best_median_and_worst_views_come_first(tmp_path: Path) -> None:
    metrics = make_metrics(psnr_db=50.0)
    metrics["by_image"] = {"test": {"metric": "psnr_db", "scores": [50.0, 40.0, None, 60.0, 55.0]}}
    text = words_of(write_report(make_run(tmp_path, make_dataset(tmp_path), metrics)))
    shown = re.findall(r"<figcaption>azimuth (\d+)°, grazing 30°([^<]*)</figcaption>", text)
    assert shown == [
        *(("50", " (best: 60.00 dB)"), ("20", " (median: 50.00 dB)"), ("30", " (worst: 40.00 dB)")),
        *(("40", ""), ("60", "")),
    ]
    assert "by PSNR, whole image" in text


@pytest.mark.parametrize("kinds", [0, 1, 2])
def test_outlines_are_drawn_if_masks_were_given(tmp_path: Path, kinds: int) -> None:
    from PIL import Image

    mask, folder = np.zeros((32, 32), np.uint8), tmp_path / "masks"
    mask[12:20, 10:22] = min(kinds, 1)
    mask[20:28, 10:22] = kinds
    folder.mkdir()
    for index in range(2, 7):
        Image.fromarray(mask).save(folder / f"{index:03d}.png")
    metrics = {**make_metrics(psnr_db=50.0, target_iou=0.875), "masks": str(folder)}
    masks = lambda views: np.stack([mask] * len(views))  # noqa: E731
    page = write_report(make_run(tmp_path, make_dataset(tmp_path, measured=True), metrics, masks=masks))
    text = words_of(page)
    assert text.count('class="outline true target"') == (5 if kinds else 0)
    assert text.count('class="outline own shadow"') == (5 if kinds == 2 else 0)
    assert "chip" not in text
    assert "5 of 5 test views with true masks" in text
    assert "0.875" in text


@pytest.mark.parametrize("tests", [0, 1, 3])
def test_few_views_no_points_no_history_no_scores(tmp_path: Path, tests: int) -> None:
    run = make_run(tmp_path, make_dataset(tmp_path, tests=tests), None, points=np.empty((0, 3)), history=[])
    page = write_report(run)
    assert "Not evaluated yet" in page.read_text()
    assert "The loss is" not in page.read_text()


def test_corrections_of_azimuths_are_drawn_where_there_are_any(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, measured=True, mesh=False)
    dataset = replace(dataset, entries=tuple(replace(entry, azimuth_std_deg=1.5) for entry in dataset.entries))
    run = make_run(tmp_path, dataset, None)
    assert "Azimuth corrections" not in words_of(write_report(run))
    run.azimuth_offset_deg = np.array([-1.0, 1.0])
    text = words_of(write_report(run))
    assert "Azimuth corrections" in text and "rms 1.00°, largest 1.00°" in text


def test_of_many_gaussians_fewer_directions_are_rendered(tmp_path: Path) -> None:
    run = make_run(tmp_path, make_dataset(tmp_path, measured=True), None)
    few, many = (widget(SimpleNamespace(**vars(run) | {"gaussians": range(n)})) for n in (100, 4000))
    assert few is not None and many is not None and len(many["data"]["views"]) < len(few["data"]["views"])


def test_a_report_is_replaced_and_its_progress_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path, make_dataset(tmp_path), None)
    write_report(run)
    assert "report: 22/22" in capsys.readouterr().out
    run.metrics = make_metrics(psnr_db=44.44)
    (tmp_path / "run" / "report" / "notes.txt").write_text("the user's")
    page = write_report(run, quiet=True)
    assert capsys.readouterr().out == ""
    assert "44.44" in page.read_text()
    assert {path.name for path in page.parent.iterdir()} == {"index.html", "notes.txt"}


def test_every_method_has_its_column_and_the_best_of_all_is_marked() -> None:
    others = [Scores("one", {"psnr_db": 40.0, "cd_m": 0.05}), Scores("two", {"psnr_db": 55.0})]
    images, points = score_tables(make_metrics(psnr_db=50.0), others)
    assert [row.metric.title for row in images.rows] == ["PSNR, whole image, dB"]  # of nothing else is there a score
    assert [row.metric.title for row in points.rows] == ["Chamfer distance, m", "F1 at 0.3 m"]
    assert [column.name for column in points.columns] == [
        *("sar-gs, visible surface", "whole surface", "mesh, visible surface", "mesh, whole surface", "one", "two")
    ]
    assert [(cell.text, cell.best) for cell in images.rows[0].cells] == [
        *(("50.00", False), ("40.00", False), ("55.00", True))
    ]
    assert [(cell.text, cell.best) for cell in points.rows[0].cells] == [
        *(("0.0625", False), ("0.0625", False), ("0.0375", False), ("0.0625", False), ("0.0500", True), ("–", False))
    ]


def test_a_report_that_fails_leaves_no_folder(tmp_path: Path) -> None:
    def end(views: Any) -> Any:
        raise KeyboardInterrupt

    run = make_run(tmp_path, make_dataset(tmp_path), None, render=end)
    with pytest.raises(KeyboardInterrupt):
        write_report(run)
    assert not (run.path / "report").exists()


@pytest.mark.parametrize("damage", [{"reasons": None}, {"points": {}}, {"images": {"test": {"psnr_db": "high"}}}])
def test_scores_of_another_make_are_refused_in_one_sentence(tmp_path: Path, damage: dict[str, Any]) -> None:
    run = make_run(tmp_path, make_dataset(tmp_path), {**make_metrics(psnr_db=50.0), **damage})
    with pytest.raises(SarsplatError, match="does not contain all scores"):
        write_report(run)


def test_a_report_does_not_move_the_mesh_of_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where points are aligned with the truth, the report shows a copy beside it."""
    box = trimesh.creation.box((1, 1, 1))
    run = SimpleNamespace(mesh=lambda: box)
    monkeypatch.setattr(write, "_truth", lambda _: (None, Alignment((5.0, 0.0, 0.0), 0.0)))
    shown = []
    monkeypatch.setattr(write, "mesh_boards", lambda mesh, _: shown.append(mesh.bounds.mean(axis=0)) or ())
    assert write._mesh(run) is not None
    np.testing.assert_allclose(shown, [[5, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(box.bounds.mean(axis=0), 0, atol=1e-9)
