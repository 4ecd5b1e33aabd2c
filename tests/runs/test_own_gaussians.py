"""Runs that leave the memory, and runs of Gaussians that no training of ours has made."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from made import upright
from sarsplat import Dataset, Harmonics, Place, Run, SarsplatError, SarsplatWarning, View, evaluate_run, reconstruct
from sarsplat.exports import export
from sarsplat.report import write_report
from sarsplat.runs.own_gaussians import usual_grid, without_strays
from sarsplat.settings import Config

VIEWS = [View(10.0, 30.0), View(200.0, 50.0)]
PLACES = torch.rand(60, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(autouse=True)
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points cost little here, on whatever grid."""
    monkeypatch.setattr("sarsplat.surface.points._MOST_RAYS", 1e5)


@pytest.mark.filterwarnings("ignore:missing")
def test_a_run_in_memory_is_saved_with_its_scores_and_resumed(dataset: Dataset, config: Config, tmp_path: Path) -> None:
    short = replace(config, iterations=6, gaussians=80)
    held = reconstruct(dataset, short, on_step=lambda step: step.iteration == 3, quiet=True)
    with pytest.warns(SarsplatWarning, match="the run is unfinished, 3 of 6 iterations"):
        scores = evaluate_run(held, quiet=True)
    saved = held.save(tmp_path / "run")
    again = Run.load(tmp_path / "run")
    assert again.metrics == saved.metrics == scores
    assert np.array_equal(again.points, held.points)
    assert np.array_equal(again.render(VIEWS), held.render(VIEWS))
    assert again.history == held.history
    assert again.dataset.fingerprint() == dataset.fingerprint()
    resumed = reconstruct(dataset, out=tmp_path / "run", resume=True, quiet=True)  # with its settings
    assert torch.equal(resumed.gaussians.means, reconstruct(dataset, short, quiet=True).gaussians.means)
    with pytest.raises(SarsplatError, match="run already exists"):
        held.save(tmp_path / "run")
    assert Run.load(held.save(tmp_path / "run", overwrite=True).folder).iteration == 3


def test_points_are_not_extracted_again(
    finished: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    held = Run.from_gaussians(finished.gaussians, views=VIEWS)
    held.save(tmp_path / "new")
    assert "extracting the surface: 1/1  points and normals" in capsys.readouterr().out
    assert len(held.points) == len(held.normals)
    for name in ("points", "normals_at"):
        monkeypatch.setattr(f"sarsplat.learning.method_sar_gs.GaussianReconstruction.{name}", None)
    held.save(tmp_path / "held", quiet=True)
    Run.load(tmp_path / "held").save(tmp_path / "loaded")
    for name in ("points.ply", "gaussians.ply", "about.json"):
        whole = (tmp_path / "new" / name).read_bytes()
        assert whole == (tmp_path / "held" / name).read_bytes() == (tmp_path / "loaded" / name).read_bytes()
    assert capsys.readouterr().out == ""


def test_own_gaussians_are_scored_exported_and_reported(dataset: Dataset, finished: Run, tmp_path: Path) -> None:
    run = Run.from_gaussians(finished.gaussians, dataset=dataset, time_s=7.0)
    assert (run.grid, run.snapshot.views) == (dataset.grid, dataset.select("train").views)
    np.testing.assert_allclose(run.render(VIEWS), finished.render(VIEWS), rtol=1e-5)
    assert len(run.points) > 200
    assert len(run.mesh().faces) > 100
    scores = evaluate_run(run, quiet=True)
    assert scores["images"]["test"]["psnr_db"] > 15
    assert (scores["time_s"], run.metrics) == (7.0, scores)
    page = write_report(run, tmp_path / "pages" / "own.html")
    with pytest.raises(SarsplatError, match="in memory and has no folder"):
        write_report(run)
    with pytest.raises(SarsplatError, match="is a folder; give"):
        write_report(run, tmp_path)
    html = page.read_text()
    assert f"{scores['points']['visible']['cd_m']:#.3g}" in html and "own loop" in html and "Iterations" not in html
    export(run, tmp_path / "own.splat")
    export(run, tmp_path / "own.obj")
    saved = Run.load(run.save(tmp_path / "run").folder)
    assert saved.dataset.fingerprint() == dataset.fingerprint()
    assert saved.facts == {"made by": "own loop", "scattering": saved.gaussians.scattering.in_words}
    with pytest.raises(SarsplatError, match="Gaussians that were not trained here, which cannot be resumed"):
        reconstruct(dataset, replace(saved.config, iterations=9), saved.folder, resume=True, quiet=True)


def test_without_images_they_are_shown_whole_from_all_sides(finished: Run, dataset: Dataset, tmp_path: Path) -> None:
    tenfold = finished.gaussians.with_tensors(
        means=10 * finished.gaussians.means, scales=10 * finished.gaussians.scales
    ).to(torch.float64)
    run, large = Run.from_gaussians(finished.gaussians), Run.from_gaussians(tenfold)
    assert large.grid.spacing_m[0] == pytest.approx(10 * run.grid.spacing_m[0], rel=0.05)
    for each in (run, large):
        images = each.render(each.snapshot.views)
        lit = (images > 1e-3 * images.max()).any(axis=0)
        assert not (lit[[0, -1]].any() or lit[:, [0, -1]].any())  # nothing is cut off
        assert lit.any(axis=0).sum() > 8  # pixels, none finer than the Gaussians
        assert each.brightest == pytest.approx(images.max(), rel=0.02)
    saved = Run.load(run.save(tmp_path / "run").folder)
    np.testing.assert_array_equal(saved.render(VIEWS), run.render(VIEWS))
    with pytest.raises(SarsplatError, match="has no dataset, or was made"):
        _ = saved.dataset
    assert Run.load(saved.folder, dataset=dataset).dataset is dataset


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_of_every_degree_and_p_min_are_kept(degree: int, tmp_path: Path) -> None:
    law = Harmonics(torch.randn(20, (degree + 1) ** 2, generator=torch.Generator().manual_seed(0)), p_min=0.25)
    own = upright(PLACES[:20], 0.1, 30.0, law)
    saved = Run.load(Run.from_gaussians(own, views=VIEWS).save(tmp_path / "run").folder).gaussians
    assert saved.scattering.settings() == own.scattering.settings()
    for name, tensor in own.tensors().items():
        assert torch.equal(saved.tensors()[name], tensor), name


def test_what_no_run_can_hold_is_refused(finished: Run) -> None:
    own = finished.gaussians
    for gaussians, options, words in (
        (own, {"views": []}, "at least one view"),
        (own[:0], {}, "at least one Gaussian"),
        (own.with_tensors(means=own.means * torch.nan), {}, "a Gaussian is not finite"),
        (upright(PLACES[:1] * 0, 1e13), {}, r"reach .* m from the origin, farther than any image shows"),
    ):
        with pytest.raises(SarsplatError, match=words):
            Run.from_gaussians(gaussians, **options)


def test_an_outlier_does_not_set_the_grid_and_is_said() -> None:
    whole, far = upright(PLACES), PLACES.clone()
    far[7, 1] = 900.0
    with pytest.warns(SarsplatWarning, match=r"1 of 60 Gaussians lies apart .*: up to 90\d m .*, 1.\d % of"):
        grid = usual_grid(upright(far))
    assert grid.spacing_m[0] == pytest.approx(usual_grid(whole).spacing_m[0], rel=0.1)
    rest, said = without_strays(upright(far))
    assert len(rest) == 59 and said.startswith("1 of 60 Gaussians")
    assert without_strays(whole)[1] == ""


def test_a_run_keeps_the_place_of_its_scene(dataset: Dataset, config: Config, finished: Run, tmp_path: Path) -> None:
    short = replace(config, iterations=6, gaussians=80)
    place = Place(-33.0, 151.0, 40.0, 20.0)
    made = reconstruct(replace(dataset, place=place), short, tmp_path / "run", quiet=True)
    assert made.place == Run.load(tmp_path / "run").place == place
    assert Run.load(made.save(tmp_path / "copy").folder).place == place
    assert Run.from_gaussians(finished.gaussians, dataset=replace(dataset, place=place)).place == place
    assert "place" not in json.loads((finished.save(tmp_path / "nowhere").folder / "config.json").read_text())
