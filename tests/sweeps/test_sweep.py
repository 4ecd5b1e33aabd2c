"""What is done is not done again, what failed is a row, and tables say what the rows hold."""

import csv
import json
import os
import re
import shutil
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sarsplat import Run, SarsplatError, SarsplatWarning, sweep
from sarsplat.cli import main
from sarsplat.evaluation import Scores, Yardstick, summary_metrics
from sarsplat.executors import EXECUTORS, Means
from sarsplat.runs.run_folder import LogLine, log_text
from sarsplat.sweeps import Plan, Results, cell, fleet, work
from sarsplat.sweeps.cell import cells_of
from sarsplat.sweeps.page import _panel
from sarsplat.sweeps.results import Line, Spread


def done(plan: dict[str, Any], out: Path, **options: Any) -> Results:
    return sweep(plan, out, executor="here", quiet=True, **options)


def runs(out: Path) -> dict[str, int]:
    """When the newest checkpoint of every run was written."""
    return {
        run.name: max(path.stat().st_mtime_ns for path in run.rglob("*.safetensors"))
        for run in (out / "runs").iterdir()
    }


def table(out: Path) -> list[dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def out(place: Path) -> Path:
    return place / "out"


@pytest.fixture(scope="session")
def _finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("finished") / "out"


@pytest.fixture
def finished(_finished: Path, out: Path, plan: dict[str, Any]) -> Path:
    """A sweep of two runs that is finished, once for all tests."""
    if not _finished.exists():
        done(plan, _finished)
    shutil.copytree(_finished, out)
    return out


def test_runs_are_runs_done_once_with_means_and_spreads(finished, plan):
    before = runs(finished)
    rows = table(finished)
    assert [(row["dataset"], row["preset"], row["iterations"], row["seed"], row["state"]) for row in rows] == [
        ("box", "quick", "4", seed, "finished") for seed in ("0", "1")
    ]
    for row in rows:
        assert row["iterations_done"] == "4"
        run = Run.load(finished / row["run"])
        assert (run.iteration, run.seed) == (4, int(row["seed"]))
        assert run.metrics["images"]["test"]["psnr_db"] == float(row["images.test.psnr_db"])
    results = done(plan, finished)
    assert runs(finished) == before
    assert [one.state for one in results.results] == ["finished"] * 2
    (line,) = results.lines()
    scores = [float(row["images.test.psnr_db"]) for row in rows]
    assert (line.done, line.of) == (2, 2)
    assert line.spreads["psnr_db"].mean == pytest.approx(sum(scores) / 2)
    assert line.spreads["psnr_db"].sd == pytest.approx(abs(scores[0] - scores[1]) / 2**0.5)
    page = (finished / "index.html").read_text()
    links = re.findall(r'<a href="(runs/[0-9a-f]{16}/)">folder</a>', page)  # there are no reports to open
    assert sorted(links) == sorted(f"runs/{name}/" for name in before)
    assert not re.search(r">[^<]*[0-9a-f]{16}", page)


def test_only_what_differs_is_done(finished, plan):
    before = runs(finished)
    done({**plan, "seeds": [1, 2]}, finished)
    assert runs(finished).items() > before.items()
    assert len(runs(finished)) == 3
    done({**plan, "settings": {**plan["settings"], "gaussians": [100, 150]}, "seeds": [0]}, finished)
    assert len(runs(finished)) == 4


def test_a_run_that_was_stopped_goes_on_to_the_same_bits(finished, plan):
    address = json.loads(next((finished / "rows").iterdir()).read_text())["address"]
    run = finished / "runs" / address
    whole = {name: (run / name).read_bytes() for name in ("gaussians.ply", "points.ply")}
    for stale in ("rows/" + address + ".json", f"runs/{address}/checkpoints/00000004.safetensors"):
        (finished / stale).unlink()
    (run / "points.ply").unlink()
    done(plan, finished)
    assert whole == {name: (run / name).read_bytes() for name in whole}
    assert len(runs(finished)) == 2


def test_a_failing_run_is_a_row_with_its_reason_and_the_others_go_on(place, out, plan, plan_file, monkeypatch, capsys):
    bad = place / "data" / "bad"
    shutil.copytree(place / "data" / "box", bad)
    image = next((bad / "images").iterdir())
    image.write_bytes(b"no tiff")
    results = done(plan, out)
    assert [(one.cell.labels["dataset"], one.state) for one in results.results] == [
        (name, state) for name, state in (("bad", "failed"), ("box", "finished")) for _ in range(2)
    ]
    assert image.name in results.failed[0].reason
    page = (out / "index.html").read_text()
    assert "What failed" in page and image.name in page
    assert main(["sweep", "plan.toml", "--out", "out"]) == 1  # nothing is left to do
    complaint = " ".join(capsys.readouterr().err.split())
    assert complaint.startswith("error: 2 of 4 runs failed: ")
    assert image.name in complaint and complaint.endswith("; the first is bad, seed 0")
    asked = []
    monkeypatch.setattr(work, "_train_and_score", lambda *words: asked.append(words))
    done(plan, out)
    assert asked == []
    done(plan, out, means=Means(again=True))
    assert len(asked) == 2


def test_reasons_and_warnings_of_runs_are_said_without_their_folders_names(out, plan, monkeypatch):
    def bad(one: Any, folder: Path, row: Any) -> None:
        warnings.warn("it is dark", SarsplatWarning, stacklevel=1)
        if one.seed:
            raise SarsplatError(f"cannot write {folder}/points.ply, for {folder} is gone")

    monkeypatch.setattr(work, "_train_and_score", bad)
    (failed,) = done(plan, out).failed
    assert failed.reason == "cannot write points.ply, for the run is gone"
    page = (out / "index.html").read_text()
    assert not re.search(r">[^<]*[0-9a-f]{16}", page)
    assert re.search(r'"warning">it is dark</td><td data-column="of">1 run</td>', page)


def test_what_may_pass_is_tried_again(out, plan, monkeypatch):
    def full(*words: object) -> None:
        try:
            raise OSError("no space")
        except OSError as error:
            raise SarsplatError("the disk is full") from error

    for bad, reason in ((full, "the disk is full"), (lambda *words: 1 / 0, "ZeroDivisionError: division by zero")):
        monkeypatch.setattr(work, "_train_and_score", bad)
        assert [one.reason for one in done(plan, out).failed] == [reason] * 2
    monkeypatch.setattr(work, "_train_and_score", lambda *words: None)
    assert not done(plan, out).failed


def test_rows_of_older_code_stay_and_say_so(finished, plan, monkeypatch):
    monkeypatch.setattr(cell, "code_of", lambda method, device: "newer")
    shown = done(plan, finished, run=False)
    assert [one.state for one in shown.results] == ["finished, older code"] * 2
    assert all(line.older for line in shown.lines())
    assert len(runs(finished)) == 2
    assert [one.state for one in done(plan, finished).results] == ["finished"] * 2
    assert len(runs(finished)) == len(list((finished / "rows").iterdir())) == 4


def test_what_is_scored_otherwise_is_not_trained_again(finished, plan, monkeypatch):
    before = runs(finished)
    monkeypatch.setattr(cell, "scoring_code", lambda: "newer")
    assert done(plan, finished, run=False).results[0].older
    results = done(plan, finished)
    assert not results.results[0].older
    assert runs(finished) == before


def test_shards_share_the_runs(out, plan, untrained):
    three = {**plan, "seeds": [0, 1, 2]}
    results = [done(three, out, shard=f"{k}/2") for k in (1, 2)]
    assert [[one.state for one in found.results] for found in results] == [
        ["finished", "waiting", "finished"],
        ["finished"] * 3,
    ]
    for shard in ("0/2", "3/2", "2", "a/b", "1/0"):
        with pytest.raises(SarsplatError, match="give 1/8 for the first of eight"):
            done(three, out, shard=shard)


def test_what_another_process_does_is_waited_for(out, plan, untrained, monkeypatch):
    monkeypatch.setattr("sarsplat.sweeps.fleet._PATIENCE_S", 0.0)
    asked: list[int] = []

    def busy(cells: list[Any], out: Path, means: Means) -> Iterator[tuple[Any, Any]]:
        asked.append(len(cells))
        for index, one in enumerate(cells):
            yield one, None if len(asked) < 3 and index else work.do(one, out)

    monkeypatch.setitem(EXECUTORS._loaded, "here", busy)
    assert all(one.finished for one in done({**plan, "seeds": [0, 1, 2]}, out).results)
    assert asked == [3, 2, 1]


def test_the_page_has_a_figure_for_every_swept_setting_and_links_to_reports(out, plan):
    plan |= {"seeds": [0], "reports": True, "settings": {**plan["settings"], "iterations": [2, 4]}}
    done(plan, out)
    page = (out / "index.html").read_text()
    assert "PSNR, whole image, dB against iterations" in page
    assert "against gaussians" not in page
    links = re.findall(r'href="(runs/[^"]+)"', page)
    assert len(links) == 2
    assert all((out / link).is_file() for link in links)
    assert 'http-equiv="refresh"' not in page


def test_it_fills_while_it_runs(out, plan, untrained, monkeypatch):
    seen = []

    def watched(cells: list[Any], out: Path, means: Means) -> Iterator[tuple[Any, Any]]:
        for one in cells:
            yield one, work.do(one, out)
            seen.append((out / "index.html").read_text())

    monkeypatch.setitem(EXECUTORS._loaded, "here", watched)
    done(plan, out)
    assert "2 runs: 1 finished and 1 waiting." in seen[0]
    assert 'http-equiv="refresh"' in seen[0]


def test_runs_that_lose_against_a_baseline_say_so(finished, plan):
    key = "registered_nats_per_pixel"
    for path, nats in zip(sorted((finished / "rows").iterdir()), (0.625, 0.4), strict=True):
        row = json.loads(path.read_text())
        beside = {"nearest_chip": 0.7, "rotated_average": 0.5}
        row["scores"] = {f"baselines.test.{name}.{key}": value for name, value in beside.items()}
        row["scores"][f"images.test.{key}"] = nats
        path.write_text(json.dumps(row))
    results = done(plan, finished, run=False)
    (line,) = results.lines()
    names, metrics = results.columns()
    assert names == ["dataset", "method"]
    assert line.texts(names, metrics)[:3] == ["box", "sar-gs", "2/2, 1 worse than a baseline"]
    assert [one.texts(names, metrics) for one in results.baselines()] == [
        ["box", "nearest chip", "–", "0.700"],
        ["box", "rotated average", "–", "0.500"],
    ]
    sentence = "1 of 2 finished runs is worse than a baseline, which knows no third dimension; farthest box, seed "
    assert str(results.beaten).startswith(sentence)
    assert ", on the set test: rotated average 0.500 against 0.625 (negative log-likelihood" in str(results.beaten)
    assert sorted(row["beaten_by"] for row in table(finished)) == ["", "rotated average on test"]
    page = (finished / "index.html").read_text()
    assert sentence in page and "finished, worse than rotated average on test" in page


def test_a_foreign_folder_is_left_alone(place, out, plan):
    with pytest.raises(SarsplatError, match="exists and is not the folder of a sweep"):
        done(plan, place / "data")
    out.mkdir()
    (out / "sweep.json").write_text("{}")
    with pytest.raises(SarsplatError, match="is not of a sweep"):
        done(plan, out)
    with pytest.raises(SarsplatError, match=r"executor .rai. is unknown; did you mean ray\?"):
        sweep(plan, out, executor="rai")
    with pytest.raises(SarsplatError, match="processes is 0"):
        replace(Means(), processes=0)


def test_the_command_shows_the_table(finished, plan_file, capsys):
    assert main(["sweep", "plan.toml", "--out", "out", "--show"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"box\s+2/2\s+[\d.]+ ± [\d.]+", said)
    assert "2 of 2 runs" in said
    assert main(["sweep", "plan.toml", "--out", "data"]) == 2


def test_progress_names_the_runs_and_how_far_they_are(place, out, plan, monkeypatch):
    said: list[str] = []

    class Shown:
        def advance(self, steps: int, status: str) -> None:
            said.append(status)

    monkeypatch.setattr(fleet, "_EVERY_S", 0.01)
    one = cells_of(Plan.from_dict(plan, ""), place)[0]
    with fleet.Live([one], out, Shown()) as live:
        log = out / "runs" / f".{one.address}.sarsplat-new" / "metrics.jsonl"
        log.parent.mkdir(parents=True)

        def write(iteration: int) -> None:
            log.write_bytes(log_text([LogLine(iteration, 1.0, 0.25, 100)]))
            os.utime(log, (time.time() + 60, time.time() + 60))

        write(2)
        seen = "1 under way, 0 waiting; box, seed 0: "

        def told(stage: str) -> None:
            while not any(status == seen + stage for status in said):
                time.sleep(0.01)

        told("training, 2 of 4, loss 0.25")
        write(4)
        told("extracting points")
        for name, stage in (("points.ply", "scoring"), ("metrics.json", "report")):
            (log.parent / name).touch()
            told(stage)
        live.ended(one)
        live.ended(one, failed=True)
    assert {"box, seed 0: done", "box, seed 0: failed"} <= {*said}
    assert one.words(one.labels).startswith("box, sar-gs, quick, iterations 4")


def test_a_figure_of_an_unfinished_sweep_compares_the_same_datasets():
    """One dataset lacks a value: its other one does not move the mean there."""

    def line(dataset: str, count: int, db: float) -> Line:
        return Line({"dataset": dataset, "gaussians": count}, {"psnr_db": Spread((db,))}, 1, 1, False)

    (psnr,) = [one for one in summary_metrics([Scores("", {"psnr_db": 1.0})], Yardstick(0.3)) if one.key == "psnr_db"]
    both = [line("a", 100, 30.0), line("a", 200, 40.0)]
    alone = _panel("gaussians", [100, 200], both, psnr)
    assert alone is not None
    assert _panel("gaussians", [100, 200], [*both, line("b", 100, 10.0)], psnr) == alone
    assert _panel("gaussians", [100, 200], [*both, line("b", 100, 10.0), line("b", 200, 90.0)], psnr) != alone
