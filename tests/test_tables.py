"""`make tables` in small: what has been done is not done again, and the tables say what the cells hold."""

import inspect
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from chip_files import write_chips
from made import dataset_of
from programs import ROOT
from sarsplat import ImageGrid, View, import_mstar, preset, sweep
from sarsplat.cli.app import parse
from sarsplat.cli.arguments import views_from
from sarsplat.evaluation import Yardstick, all_metrics
from sarsplat.executors import EXECUTORS, Means
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.plan import Plan
from sarsplat.sweeps.results import Result
from sarsplat.sweeps.work import Row, do

EXPERIMENTS = ROOT / "experiments"
MODULES = ("catalogue", "draw", "experiment", "finding", "finished", "metrics", "plans", "summary", "tables", "write")


@pytest.fixture
def made(module, monkeypatch) -> SimpleNamespace:
    """The programs' modules; the code that makes datasets is not read."""
    found = SimpleNamespace(**{name: module(f"experiments/{name}") for name in MODULES})
    monkeypatch.setattr(found.plans, "code", lambda roots, device: "code")
    return found


def experiment(made: SimpleNamespace, *rows: object, **fields: object):
    common = {"name": "made-up", "title": "Made up", "about": "Nothing was done.", "tables": (("cd_m", "f1@0.3"),)}
    return made.experiment.Experiment(**{**common, "rows": rows, **fields})


def row(made: SimpleNamespace, label: str, targets: tuple[str, ...] = ("t72",), **fields: object):
    return made.experiment.Row(label, tuple({"target": target} for target in targets), **fields)


def finished(
    line: Any, seed: int, cd_m: float, f1: float | None = 0.9, older: bool = False, time_s: float = 1.0
) -> Result:
    """What a sweep says of a run of this row."""
    scores = {"images.test.psnr_db": 40.0, "points.visible.cd_m": cd_m, "points.visible.f1@0.1": 0.5, "time_s": time_s}
    if f1 is not None:
        scores["points.visible.f1@0.3"] = f1
    cell = SimpleNamespace(labels={"part": line.name}, seed=seed, config={"preset": "default"})
    row = Row("address", "recipe", "code", "scoring", "finished", scores=scores, yardstick_m=0.5, took_s=2.0)
    return Result(cell, row, older)


def waiting(line: Any, seed: int) -> Result:
    return Result(SimpleNamespace(labels={"part": line.name}, seed=seed), None)


def lines(made: SimpleNamespace, table, results: Sequence[Result], kept: Path | None = None):
    """What is known of its rows, and their runs."""
    runs = made.finished.runs_of(table, results, kept or Path("nowhere"))
    return made.summary.lines(table, runs), runs


def finding(made: SimpleNamespace, table, values: Sequence[float], of_a_seed: float) -> str:
    """What is found if the rows have these Chamfer distances, larger from seed to seed."""
    scores = [(line, seed, value + of_a_seed * seed) for line, value in zip(table.rows, values) for seed in table.seeds]
    (found,) = made.finding.findings(table, lines(made, table, [finished(*each) for each in scores])[0])
    return found


@pytest.mark.slow
def test_every_experiment_can_be_run_and_reported(made):
    keys = {metric.key for metric in all_metrics(Yardstick(0.3))}
    of_chips = {*inspect.signature(import_mstar).parameters, "folded", "seed"}
    every = made.catalogue.EXPERIMENTS
    assert len({found.name for found in every}) == len(every)
    for found in every:
        assert set(found.judged) <= set(found.columns) <= set(made.metrics.METRIC)
        assert len({(line.group, line.label) for line in found.rows}) == len(found.rows)
        for line in found.rows:
            assert set(line.paper) <= keys
            start = preset("default" if line.preset == "auto" else line.preset)
            start = start if line.method == "sar-gs" else made.plans.defaults(line)
            for changes in (line.changes, made.plans.shortened(line)):
                assert start.with_settings(changes)
            if found.name.endswith("terms"):
                assert (start.with_settings(line.changes) != start) == bool(line.changes), line.name
            assert not line.full or line.full in {other.label for other in found.groups()[line.group]}
            for dataset in line.drawn(0):
                if "target_class" in dataset:
                    assert set(dataset) <= of_chips
                else:
                    parse(made.plans.simulation_words(Path("made"), {**dataset, "scene": None, "hills": None}))
                for angles in ("azimuth", "test_azimuth"):
                    assert views_from(dataset.get(angles, ("0",)), ("45",), ())
        small = found.in_small()
        assert {line.group for line in small.rows} == set(found.groups())
        assert {line.full for line in small.rows} <= {line.label for line in small.rows} | {""}


def test_an_experiment_is_a_plan(made, tmp_path):
    drawn = row(made, "drawn", random=True, group="group")
    table = experiment(made, row(made, "plain", ("t72", "kraz"), changes={"gaussians": 5}), drawn, seeds=(0, 1))
    plan = Plan.from_dict(made.plans.plan_of(table, tmp_path), "the plan")
    parts = list(plan.each_part())
    assert [(part.name, part.seeds, len(part.datasets)) for part in parts] == [
        ("plain", (0, 1), 2),
        ("group, drawn", (0,), 1),
        ("group, drawn", (1,), 1),
    ]
    assert len({folder for part in parts for folder in part.datasets}) == 4
    assert parts[0].settings == {"gaussians": 5}
    assert len(made.plans.missing(table, tmp_path)) == 4


def test_a_row_is_the_mean_over_targets_and_spreads_over_seeds(made, tmp_path):
    table = experiment(made, row(made, "both", ("t72", "kraz")), seeds=(0, 1, 2))
    (both,) = table.rows
    values = ((0, (0.1, 0.3)), (1, (0.2, 0.6)))
    results = [finished(both, seed, value) for seed, pair in values for value in pair]
    results += [finished(both, 2, 5.0), waiting(both, 2)]
    (line,), runs = lines(made, table, results)
    assert (line.seeds, line.older) == (2, False)
    assert line.spreads["cd_m"].mean == pytest.approx(0.3)
    assert line.spreads["cd_m"].sd == pytest.approx(0.2 / 2**0.5)
    assert made.finished.scores(results[0].row, both) == {
        **{"psnr_db": 40.0, "cd_m": 0.1, "f1@0.3": 0.9, "f1@0.1": 0.5, "time_s": 1.0},
        **{"cd_cells": 0.2, "f1@cell": 0.9, "f1@third": 0.5},
    }
    assert "| both | 2 | 0.300 ± 0.141 | 0.900 ± 0.000 |" in made.write.page(table, [line], runs, tmp_path)
    older = [finished(both, 0, 0.1, older=True), finished(both, 0, 0.3)]
    assert "| both | 1, older code | 0.200 | 0.900 |" in made.write.page(table, *lines(made, table, older), tmp_path)


def test_what_is_missing_is_a_dash(made, tmp_path, monkeypatch):
    paper = {"cd_m": 0.187}
    table = experiment(
        made, row(made, "done", paper=paper), row(made, "open", changes={"gaussians": 5}, paper=paper), seeds=(0,)
    )
    made.write.write(table, lines(made, table, [waiting(line, 0) for line in table.rows])[1], tmp_path / "out")
    assert not (tmp_path / "out").exists()  # nothing is finished, so nothing is replaced
    results = [finished(table.rows[0], 0, 0.05, None), waiting(table.rows[1], 0)]
    made.write.write(table, lines(made, table, results)[1], tmp_path / "out")
    text = (tmp_path / "out" / "made-up.md").read_text()
    assert "| done | 1 | 0.0500 | 0.187 | – |" in text
    assert "| open | 0 | – | 0.187 | – |" in text
    assert "**Found.** Better than the paper's figure, or equal, in 1 of 1 comparisons." in text
    assert (tmp_path / "out" / "made-up.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "out" / "made-up.csv").read_text().splitlines()[1] == ",done,,cd_m,0.05,,1,0.187"
    monkeypatch.setattr(made.write, "EXPERIMENTS", (table, replace(table, name="other", title="Other")))
    made.write.write_index(tmp_path / "out", quick=False)
    index = (tmp_path / "out" / "README.md").read_text()
    assert "[Made up](made-up.md)\n\nBetter than the paper's figure, or equal, in 1 of 1 comparisons." in index
    assert "## Other\n\nNot run yet" in index
    runs = (tmp_path / "out" / "made-up-runs.csv").read_text().splitlines()
    assert [line.split(",")[1:4] for line in runs[1:]] == [["done", "0", "--target t72"]]
    kept = tmp_path / "out" / "made-up-runs.csv"
    (done, opened), again = lines(made, table, [waiting(line, 0) for line in table.rows], kept)
    assert (done.spreads["cd_m"].mean, done.older, opened.seeds) == (0.05, True, 0)
    made.write.write(table, again, tmp_path / "out")
    assert "| done | 1, older code | 0.0500 | 0.187 | – |" in (tmp_path / "out" / "made-up.md").read_text()
    assert kept.read_text().splitlines() == runs
    (done, _), _ = lines(made, table, [finished(table.rows[0], 0, 0.07), waiting(table.rows[1], 0)], kept)
    assert (done.spreads["cd_m"].mean, done.older) == (0.07, False)


@pytest.mark.parametrize(
    ("ours", "said"),
    [
        ((0.3, 0.2, 0.1), "falls with the Gaussians (r = -1.00); in the paper it falls (r = -1.00): as ours."),
        ((0.1, 0.2, 0.3), "in the paper it falls (r = -1.00): **our trend differs from the paper's**."),
        ((0.2, 0.2, 0.2), "Chamfer distance shows no trend beyond chance with the Gaussians"),
        ((0.2, 0.1, 0.2), "it falls (r = -1.00): **the paper's trend is not seen in ours**."),
    ],
)
def test_trends_are_compared_with_the_papers(made, ours, said):
    rows = [row(made, f"{x}", changes={"gaussians": x}, x=x, paper={"cd_m": 1 - x / 100}) for x in (10, 20, 30)]
    table = experiment(made, *rows, axis="Gaussians", judged=("cd_m",), tables=(("cd_m",),))
    assert said in finding(made, table, ours, 1e-4)


def test_rows_without_the_papers_figures_are_held_against_the_first(made):
    rows = [row(made, name, changes={"gaussians": k}) for k, name in enumerate(("clean", "alike", "hard"), 1)]
    table, ours = experiment(made, *rows, judged=("cd_m",)), (0.1, 0.101, 0.5)
    alike = "no different beyond the spread of the seeds: alike (0.111)."
    assert finding(made, table, ours, 0.01) == (f"Chamfer distance, m, 0.110 for clean; worse: hard (0.510); {alike}")
    assert finding(made, replace(table, contest=True), ours, 0.01).endswith(f"0.110 for clean; {alike}")


def test_others_get_our_time(made, tmp_path):
    common = {"group": "box", "method": "dsr"}
    rows = [
        row(made, "ours", group="box"),
        row(made, "theirs, in our time", full="theirs, full", **common),
        row(made, "theirs, full", **common),
    ]
    table = experiment(made, *rows, seeds=(0, 1))
    assert [line.label for line in made.plans.in_our_time(table, []).rows] == ["ours", "theirs, full"]
    times = ((rows[0], 9.0), (rows[0], 11.0), (rows[2], 210.0), (rows[2], 190.0))
    _, runs = lines(made, table, [finished(line, k % 2, 0.1, time_s=time) for k, (line, time) in enumerate(times)])
    planned = made.plans.in_our_time(table, runs)
    assert planned.rows[1].changes == {"iterations": 100}  # of 2000
    parts = list(Plan.from_dict(made.plans.plan_of(planned, tmp_path), "the plan").each_part())
    assert [(part.methods, part.settings) for part in parts] == [
        (("sar-gs",), {}),
        (("dsr",), {"iterations": 100}),
        (("dsr",), {}),
    ]


def test_rows_are_of_a_test_set_or_of_a_simpler_method(made):
    scores = {"images.test-15.ssim": 0.1, "images.test-17.ssim": 0.3, "points.visible.cd_m": 0.2, "time_s": 9.0}
    scores["baselines.test-15.nearest_chip.ssim"] = 0.05
    found = Row("address", "recipe", "code", "scoring", "finished", scores=scores, yardstick_m=0.5)
    every, one, simpler = (
        made.finished.scores(found, row(made, "row", scored=where))
        for where in ("", "images.test-15.", "baselines.test-15.nearest_chip.")
    )
    assert (every["ssim"], one["ssim"], one["cd_m"], simpler) == (0.2, 0.1, 0.2, {"ssim": 0.05})


def test_training_chips_alone_are_folded(made):
    grid = ImageGrid(16, 16, (0.2, 0.2), (0.3, 0.3))
    views = [(View(20.0 * k, 17.0), "test-17" if k in (0, 5) else "train") for k in range(10)]
    images = np.ones((10, 16, 16), np.float32)
    fold = made.plans.folded(dataset_of(grid, views, images, calibration="relative", looks=1.0, ground=True))
    assert [entry.name for entry in fold.select("test").entries] == ["002", "007"]  # the second and the sixth
    assert [entry.name for entry in fold.select("train").entries] == ["001", "003", "004", "006", "008", "009"]


def test_a_whole_table_and_what_is_done_is_not_done_again(made, tmp_path, monkeypatch):
    pytest.importorskip("embreex")
    asked = []

    def here(cells: Sequence[Cell], out: Path, means: Means) -> Iterator[tuple[Cell, Row | None]]:
        asked.append(len(cells))
        for cell in cells:
            yield cell, do(cell, out)

    monkeypatch.setitem(EXECUTORS._entries, "here", None)
    monkeypatch.setitem(EXECUTORS._loaded, "here", here)
    monkeypatch.setattr(made.tables, "sweep", partial(sweep, executor="here"))
    views = {"azimuth": ("0:360:120",), "grazing": ("45",), "test_azimuth": ("60",)}
    small = {"target": "t72", "pixels": (32,), "spacing": (1.2,), **views}
    line = made.experiment.Row("small", (small,), "auto", {"gaussians": 3000})
    table = experiment(made, line, seeds=(0,), quick=True, tables=(("psnr_db", "cd_m"),), judged=("cd_m",))
    assert made.tables.run([table], tmp_path, tmp_path / "out", Means(), True) == 0
    assert not asked  # only what is finished is written: nothing
    for _ in range(2):
        assert made.tables.run([table], tmp_path, tmp_path / "out", Means(), False) == 0
    assert asked == [1]
    assert "| small | 1 | " in (tmp_path / "out" / "made-up.md").read_text()


def test_quick_tables_do_not_reach_the_results(made, tmp_path, monkeypatch, capsys):
    written = []
    stand_ins = {
        "write": lambda found, runs, out: written.append((found.quick, out)),
        "write_index": lambda out, quick: None,
        "missing": lambda found, work: {},
        "plan_of": lambda found, work, chips: {},
        "runs_of": lambda found, results, kept: [],
        "sweep": lambda plan, out, means, run: SimpleNamespace(results=[], failed=[], asked=run),
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(made.tables, name, stand_in)
    for words in (["--quick"], []):
        monkeypatch.setattr(sys, "argv", ["tables.py", "--write", "--only", "loss", "--work", str(tmp_path), *words])
        assert made.tables.main() == 0
    assert written == [(True, tmp_path / "quick"), (False, EXPERIMENTS.parent / "docs" / "results")]
    monkeypatch.setattr(sys, "argv", ["tables.py", "--only", "los"])
    with pytest.raises(SystemExit, match="2"):
        made.tables.main()
    assert "there is no experiment 'los'; choose from rendered, " in capsys.readouterr().err


def test_classes_and_azimuths_are_reported_by_arm_and_kept(made, module, tmp_path, monkeypatch):
    recognise = module("experiments/recognise")
    scores = {"accuracy": 0.9, "median azimuth error, °": 1.25, "azimuth within 5°": 0.8, "images": 40}
    asked = []

    def scores_of(folders: Sequence[Path], seed: int, each: int, networks: object):
        asked.append((len(folders), seed, each))
        return [(arm, {**scores, "calibrated by": 20}) for arm in recognise.ARMS]

    monkeypatch.setattr(recognise, "scores_of", scores_of)
    rows = recognise.rows((5, 12), (), 2)
    assert [len(one.datasets) for one in rows] == [2, 2]
    table = replace(recognise.RECOGNISE, rows=rows, report=partial(recognise.report, each=7))
    results = [finished(rows[1], 0, 0.1), finished(rows[1], 0, 0.1), finished(rows[0], 0, 0.1), waiting(rows[0], 0)]
    for _ in range(2):
        table.report(table, results, tmp_path, tmp_path / "out")
    assert asked == [(2, 0, 7)] * 2  # of five chips, a training is missing
    page = (tmp_path / "out" / "recognise.md").read_text()
    assert page.count("| 12 | flat ground | 90.0 % | 1.25° | 80.0 % | – | – | – | – | 40 | 1 |") == 1
    assert "From 12 chips of a class, 90.0 % of chips are recognised (rotated average 90.0 %, network 90.0 %" in page


@pytest.mark.filterwarnings("ignore::sarsplat.SarsplatWarning")
def test_chips_are_drawn_by_the_seed_and_the_others_are_predicted(made, tmp_path):
    chips = [("T72", "132", 17, azimuth) for azimuth in range(0, 300, 60)] + [("T72", "132", 15, 8), ("D7", "1", 17, 9)]
    labels, drawn = write_chips(tmp_path, chips), set()
    for seed in range(8):
        options = {"target_class": "T72", "train_views": 2, "train_depression": (17,)}
        table = made.plans.drawn(labels, {**options, "seed": seed}, tmp_path / "drawn.csv")
        every = import_mstar(tmp_path, tmp_path / str(seed), labels=table, **options)
        found = made.plans.with_the_others(every, options)
        assert {name: len(found.select(name)) for name in found.splits()} == {"train": 2, "test-17": 3, "test-15": 1}
        drawn.add(tuple(view.azimuth_deg for view in found.select("train").views))
    assert len(drawn) > 3


def test_products_of_odds_trust_neither_factor_blindly(module):
    labels = np.arange(80) % 2
    weak, noise = (
        np.log(np.where(np.eye(2)[k] > 0, p, 1 - p)) for k, p in ((labels, 0.6), (np.arange(80) // 2 % 2, 0.99))
    )
    odds = module("experiments/with_network").product([weak, noise], labels, 40)
    np.testing.assert_allclose(odds.sum(axis=1), 1)
    assert (odds.argmax(axis=1) == labels).all()


def test_rotated_averages_are_displaced_with_their_grid(module, monkeypatch):
    recognise = module("experiments/recognise")
    grid = ImageGrid(16, 16, (0.2, 0.3), (0.3, 0.3))
    images = 1 + np.arange(256.0).reshape(1, 16, 16)
    dataset = dataset_of(grid, [(View(0, 17), "train")], images.astype(np.float32))
    run = object.__new__(recognise.Averaged)
    monkeypatch.setattr(recognise.Averaged, "dataset", property(lambda run: dataset))
    monkeypatch.setattr(recognise, "levelled_average", lambda train, views: train.power.astype(float))
    moved = run.render([View(0, 17)], replace(grid, center_m=(0.1, 0.15)))
    here = run.render([View(0, 17)])
    np.testing.assert_allclose(moved[:, 1:-1, 1:-1], (here[:, 1:-1, 1:-1] + here[:, 2:, 2:]) / 2)
