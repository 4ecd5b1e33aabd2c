"""`make tables` in small: what has been done is not done again, and the tables say what the cells hold."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from programs import ROOT
from sarsplat import sweep
from sarsplat.cli.arguments import views_from
from sarsplat.cli.simulate import simulate
from sarsplat.evaluation import Yardstick, all_metrics
from sarsplat.reconstruction import preset
from sarsplat.sweeps import EXECUTORS, Means
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.plan import Plan
from sarsplat.sweeps.results import Result
from sarsplat.sweeps.work import Row, do
from scoring import few_samples

EXPERIMENTS = ROOT / "experiments"
MODULES = ("catalogue", "draw", "finding", "plans", "summary", "tables", "write")


@pytest.fixture
def made(module) -> SimpleNamespace:
    """The programs' modules."""
    return SimpleNamespace(**{name: module(f"experiments/{name}") for name in MODULES})


def experiment(made: SimpleNamespace, *rows: object, **fields: object):
    common = {"name": "made-up", "title": "Made up", "about": "Nothing was done.", "tables": (("cd_m", "f1@0.3"),)}
    return made.catalogue.Experiment(**{**common, "rows": rows, **fields})


def row(made: SimpleNamespace, label: str, targets: tuple[str, ...] = ("t72",), **fields: object):
    return made.catalogue.Row(label, tuple({"target": target} for target in targets), **fields)


def finished(line: object, seed: int, cd_m: float, f1: float | None = 0.9, older: bool = False) -> Result:
    """What a sweep says of a run of this row."""
    scores = {"images.test.psnr_db": 40.0, "points.visible.cd_m": cd_m, "points.visible.f1@0.1": 0.5, "time_s": 1.0}
    if f1 is not None:
        scores["points.visible.f1@0.3"] = f1
    cell = SimpleNamespace(labels={"part": line.name}, seed=seed, config={"preset": "default"})
    row = Row("address", "recipe", "code", "scoring", "finished", scores=scores, yardstick_m=0.5, took_s=2.0)
    return Result(cell, row, older)


def waiting(line: object, seed: int) -> Result:
    return Result(SimpleNamespace(labels={"part": line.name}, seed=seed), None)


def test_every_experiment_can_be_run_and_reported(made):
    options, keys = set(inspect.signature(simulate).parameters), {metric.key for metric in all_metrics(Yardstick(0.3))}
    every = made.catalogue.EXPERIMENTS
    assert len({found.name for found in every}) == len(every)
    for found in every:
        assert set(found.judged) <= set(found.columns) <= set(made.summary.METRIC)
        assert len({(line.group, line.label) for line in found.rows}) == len(found.rows)
        for line in found.rows:
            assert set(line.paper) <= keys
            assert preset("default" if line.preset == "auto" else line.preset).with_settings(line.changes)
            for dataset in line.drawn(0):
                assert set(dataset) <= options
                for angles in ("azimuth", "test_azimuth"):
                    assert views_from(dataset.get(angles, ("0",)), ("45",), ())
        assert {line.group for line in found.in_small().rows} == set(found.groups())


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


def test_settings_are_shortened(made):
    changed = row(made, "one", preset="paper", changes={"densification.stop": 12_000})
    config = preset("paper").with_settings(changed.changes | made.plans.shortened(changed))
    assert config.iterations == 60
    assert config.densification.stop / config.iterations == pytest.approx(12_000 / 30_000, rel=0.1)


def test_a_row_is_the_mean_over_targets_and_spreads_over_seeds(made):
    table = experiment(made, row(made, "both", ("t72", "kraz")), seeds=(0, 1, 2))
    (both,) = table.rows
    values = ((0, (0.1, 0.3)), (1, (0.2, 0.6)))
    results = [finished(both, seed, value) for seed, pair in values for value in pair]
    results += [finished(both, 2, 5.0), waiting(both, 2)]
    (line,) = made.summary.lines(table, results)
    assert (line.seeds, line.older) == (2, False)
    assert line.spreads["cd_m"].mean == pytest.approx(0.3)
    assert line.spreads["cd_m"].sd == pytest.approx(0.2 / 2**0.5)
    assert made.summary.scores(results[0].row) == {
        **{"psnr_db": 40.0, "cd_m": 0.1, "f1@0.3": 0.9, "f1@0.1": 0.5, "time_s": 1.0},
        **{"cd_cells": 0.2, "f1@cell": 0.9, "f1@third": 0.5},
    }
    assert "| both | 2 | 0.300 ± 0.141 | 0.900 ± 0.000 |" in made.write.page(table, [line], results)
    older = [finished(both, 0, 0.1, older=True), finished(both, 0, 0.3)]
    lines = made.summary.lines(table, older)
    assert "| both | 1, older code | 0.200 | 0.900 |" in made.write.page(table, lines, older)


def test_what_is_missing_is_a_dash(made, tmp_path, monkeypatch):
    paper = {"cd_m": 0.187}
    table = experiment(
        made, row(made, "done", paper=paper), row(made, "open", changes={"gaussians": 5}, paper=paper), seeds=(0,)
    )
    made.write.write(table, [waiting(line, 0) for line in table.rows], tmp_path / "out")
    assert not (tmp_path / "out").exists()  # nothing is finished, so nothing is replaced
    made.write.write(table, [finished(table.rows[0], 0, 0.05, None), waiting(table.rows[1], 0)], tmp_path / "out")
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
    results = [finished(line, seed, value + 1e-4 * seed) for line, value in zip(rows, ours) for seed in table.seeds]
    (found,) = made.finding.findings(table, made.summary.lines(table, results))
    assert said in found


def test_rows_without_the_papers_figures_are_held_against_the_first(made):
    rows = [row(made, name, changes={"gaussians": k}) for k, name in enumerate(("clean", "alike", "hard"), 1)]
    table = experiment(made, *rows, judged=("cd_m",))
    results = [
        finished(line, seed, value + 0.01 * seed)
        for line, value in zip(rows, (0.1, 0.101, 0.5))
        for seed in table.seeds
    ]
    (found,) = made.finding.findings(table, made.summary.lines(table, results))
    assert found == (
        "Chamfer distance, m, 0.110 for clean; worse: hard (0.510); "
        "no different beyond the spread of the seeds: alike (0.111)."
    )


def test_a_whole_table_and_what_is_done_is_not_done_again(made, tmp_path, monkeypatch):
    pytest.importorskip("embreex")
    asked = []

    def here(cells: Sequence[Cell], out: Path, means: Means) -> Iterator[tuple[Cell, Row | None]]:
        asked.append(len(cells))
        with few_samples():
            for cell in cells:
                yield cell, do(cell, out)

    monkeypatch.setitem(EXECUTORS._entries, "here", None)
    monkeypatch.setitem(EXECUTORS._loaded, "here", here)
    monkeypatch.setattr(made.tables, "sweep", partial(sweep, executor="here"))
    views = {"azimuth": ("0:360:120",), "grazing": ("45",), "test_azimuth": ("60",)}
    small = {"target": "t72", "pixels": (32,), "spacing": (1.2,), **views}
    line = made.catalogue.Row("small", (small,), "auto", {"gaussians": 3000})
    table = experiment(made, line, seeds=(0,), quick=True, tables=(("psnr_db", "cd_m"),), judged=("cd_m",))
    assert made.tables.run([table], tmp_path, tmp_path / "out", Means(), True) == 0
    assert not asked  # only what is finished is written: nothing
    for _ in range(2):
        assert made.tables.run([table], tmp_path, tmp_path / "out", Means(), False) == 0
    assert asked == [1]
    assert "| small | 1 | " in (tmp_path / "out" / "made-up.md").read_text()


def test_quick_tables_do_not_reach_the_results(made, tmp_path, monkeypatch, capsys):
    written = []
    monkeypatch.setattr(made.tables, "write", lambda found, results, out: written.append((found.quick, out)))
    monkeypatch.setattr(made.tables, "write_index", lambda out, quick: None)
    monkeypatch.setattr(made.tables, "missing", lambda found, work: {})
    monkeypatch.setattr(made.tables, "plan_of", lambda found, work: {})
    monkeypatch.setattr(
        made.tables, "sweep", lambda plan, out, means, run: SimpleNamespace(results=[], failed=[], asked=run)
    )
    for words in (["--quick"], []):
        monkeypatch.setattr(sys, "argv", ["tables.py", "--write", "--only", "loss", "--work", str(tmp_path), *words])
        assert made.tables.main() == 0
    assert written == [(True, tmp_path / "quick"), (False, EXPERIMENTS.parent / "docs" / "results")]
    monkeypatch.setattr(sys, "argv", ["tables.py", "--only", "los"])
    with pytest.raises(SystemExit, match="2"):
        made.tables.main()
    assert "there is no experiment 'los'; choose from rendered, " in capsys.readouterr().err
