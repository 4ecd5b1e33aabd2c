"""`make tables` in small: what has been done is not done again, and the tables say what the cells hold."""

from __future__ import annotations

import inspect
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from programs import ROOT, python
from sarsplat.cli.arguments import views_from
from sarsplat.cli.simulate import simulate
from sarsplat.evaluation import Yardstick, all_metrics
from sarsplat.reconstruction import preset
from scoring import few_samples

EXPERIMENTS = ROOT / "experiments"
MODULES = ("catalogue", "cell", "code_version", "draw", "finding", "runner", "summary", "tables", "write")

# Stands in for cell.py: notes that it was asked, and leaves a file as a cell does.
FAKE_CELL = """
import json, sys, time
from pathlib import Path
sys.path.insert(0, {experiments!r})
from cell import Cell
work = Path(sys.argv[1])
cell = Cell(**json.load(sys.stdin))
with (work / "asked").open("a") as log:
    log.write(f"{{cell.seed}}\\n")
if cell.seed == 7:
    sys.exit("out of luck")
time.sleep(0.2)
path = cell.path(work, "code")
path.parent.mkdir(exist_ok=True)
path.write_text("{{}}")
"""


@pytest.fixture
def made(module) -> SimpleNamespace:
    """The programs' modules."""
    return SimpleNamespace(**{name: module(f"experiments/{name}") for name in MODULES})


def experiment(made: SimpleNamespace, *rows: object, **fields: object):
    common = {"name": "made-up", "title": "Made up", "about": "Nothing was done.", "tables": (("cd_m", "f1@0.3"),)}
    return made.catalogue.Experiment(**{**common, "rows": rows, **fields})


def row(made: SimpleNamespace, label: str, targets: tuple[str, ...] = ("t72",), **fields: object):
    return made.catalogue.Row(label, tuple({"target": target} for target in targets), **fields)


def finish(made: SimpleNamespace, work: Path, cell: object, cd_m: float, f1: float | None = 0.9) -> None:
    """Leave what the cell would."""
    path = cell.path(work, "code")
    path.parent.mkdir(parents=True, exist_ok=True)
    points = {"visible": {"cd_m": cd_m, "f1@0.3": f1, "f1@0.1": 0.5}}
    content = {"images": {"test": {"psnr_db": 40.0}}, "points": points, "time_s": 1.0, "took_s": 2.0}
    path.write_text(json.dumps({**content, "config": {"preset": "default"}, "cell_m": 0.5}))


def test_every_experiment_can_be_run_and_reported(made):
    options, keys = set(inspect.signature(simulate).parameters), {metric.key for metric in all_metrics(Yardstick(0.3))}
    every = made.catalogue.EXPERIMENTS
    assert len({found.name for found in every}) == len(every)
    for found in every:
        assert set(found.judged) <= set(found.columns) <= set(made.summary.METRIC)
        assert len({(line.group, line.label) for line in found.rows}) == len(found.rows)
        for line in found.rows:
            assert set(line.paper) <= keys
            for cell in found.cells(line, 0):
                assert set(cell.dataset) <= options
                config = cell.config(preset("default" if cell.preset == "auto" else cell.preset))
                assert config.seed == cell.seed
                for angles in ("azimuth", "test_azimuth"):
                    assert views_from(cell.dataset.get(angles, ("0",)), ("45",), ())
        small = found.in_small()
        assert all(cell.quick for cell in small.every_cell())
        assert {line.group for line in small.rows} == set(found.groups())


def test_settings_are_changed_and_shortened(made):
    cell = made.cell.Cell({"target": "t72"}, "paper", {"densification.stop": 12_000}, seed=4)
    config = cell.config(preset("paper"))
    assert (config.densification.stop, config.seed, config.iterations) == (12_000, 4, 30_000)
    quick = replace(cell, quick=True).config(preset("paper"))
    assert quick.iterations == 60
    assert quick.densification.stop / quick.iterations == pytest.approx(12_000 / 30_000, rel=0.1)


def test_a_cell_is_known_by_its_recipe_and_its_code(made, tmp_path):
    cell = made.cell.Cell({"target": "t72"}, seed=1)
    others = [replace(cell, **changed) for changed in ({"seed": 2}, {"preset": "paper"}, {"quick": True})]
    paths = {cell.path(tmp_path, "a"), cell.path(tmp_path, "b"), *(other.path(tmp_path, "a") for other in others)}
    assert len(paths) == 5
    same = replace(cell, changes={"initialisation": preset("default").initialisation})
    assert cell.path(tmp_path, "a") == same.path(tmp_path, "a")


def test_a_row_is_the_mean_over_targets_and_spreads_over_seeds(made, tmp_path):
    table = experiment(made, row(made, "both", ("t72", "kraz")), seeds=(0, 1, 2))
    for seed, values in ((0, (0.1, 0.3)), (1, (0.2, 0.6))):
        for cell, value in zip(table.cells(table.rows[0], seed), values):
            finish(made, tmp_path, cell, value)
    finish(made, tmp_path, table.cells(table.rows[0], 2)[0], 5.0)  # the other target is not finished
    (line,) = made.summary.lines(table, tmp_path, "code")
    assert line.seeds == 2
    assert line.spreads["cd_m"].mean == pytest.approx(0.3)
    assert line.spreads["cd_m"].sd == pytest.approx(0.2 / 2**0.5)
    assert made.summary.scores(made.summary.read(table.cells(table.rows[0], 0)[0], tmp_path, "code")) == {
        **{"psnr_db": 40.0, "cd_m": 0.1, "f1@0.3": 0.9, "f1@0.1": 0.5, "time_s": 1.0},
        **{"cd_cells": 0.2, "f1@cell": 0.9, "f1@third": 0.5},
    }
    text = made.write.page(table, [line], "code")
    assert "| both | 2 | 0.300 ± 0.141 | 0.900 ± 0.000 |" in text


def test_what_is_missing_is_a_dash(made, tmp_path, monkeypatch):
    paper = {"cd_m": 0.187}
    table = experiment(made, row(made, "done", paper=paper), row(made, "open", changes={"gaussians": 5}, paper=paper))
    made.write.write(table, tmp_path / "work", tmp_path / "out", "code")
    assert not (tmp_path / "out").exists()  # nothing is finished, so nothing is replaced
    finish(made, tmp_path / "work", table.cells(table.rows[0], 0)[0], 0.05, f1=None)
    made.write.write(table, tmp_path / "work", tmp_path / "out", "code")
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
def test_trends_are_compared_with_the_papers(made, tmp_path, ours, said):
    rows = [row(made, f"{x}", changes={"gaussians": x}, x=x, paper={"cd_m": 1 - x / 100}) for x in (10, 20, 30)]
    table = experiment(made, *rows, axis="Gaussians", judged=("cd_m",), tables=(("cd_m",),))
    for line, value in zip(rows, ours):
        for seed in table.seeds:
            finish(made, tmp_path, table.cells(line, seed)[0], value + 1e-4 * seed)
    (found,) = made.finding.findings(table, made.summary.lines(table, tmp_path, "code"))
    assert said in found


def test_rows_without_the_papers_figures_are_held_against_the_first(made, tmp_path):
    rows = [row(made, name, changes={"gaussians": k}) for k, name in enumerate(("clean", "alike", "hard"), 1)]
    table = experiment(made, *rows, judged=("cd_m",))
    for line, value in zip(rows, (0.1, 0.101, 0.5)):
        for seed in table.seeds:
            finish(made, tmp_path, table.cells(line, seed)[0], value + 0.01 * seed)
    (found,) = made.finding.findings(table, made.summary.lines(table, tmp_path, "code"))
    assert found == (
        "Chamfer distance, m, 0.110 for clean; worse: hard (0.510); "
        "no different beyond the spread of the seeds: alike (0.111)."
    )


@pytest.fixture
def fake(made: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program in place of cell.py."""
    path = tmp_path / "fake.py"
    path.write_text(FAKE_CELL.format(experiments=str(EXPERIMENTS)))
    monkeypatch.setattr(made.runner, "_PROGRAM", path)
    return path


def test_a_killed_run_goes_on_where_it_was(made, tmp_path, fake):
    table = experiment(made, row(made, "one"), seeds=(0, 1, 2))
    driver = (
        f"import sys; sys.path.insert(0, {str(EXPERIMENTS)!r})\n"
        "import runner\nfrom cell import Cell\nfrom pathlib import Path\n"
        f"runner._PROGRAM = Path({str(fake)!r})\n"
        "cells = [Cell({'target': 't72'}, seed=seed) for seed in (0, 1, 2)]\n"
        f"runner.Runner(Path({str(tmp_path)!r}), 'code', 1).run('made-up', cells, alone=False)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", driver], start_new_session=True)
    first = table.cells(table.rows[0], 0)[0].path(tmp_path, "code")
    deadline = time.monotonic() + 60
    while not first.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    runner = made.runner.Runner(tmp_path, "code", 2)
    assert 1 <= runner.plan(list(table.every_cell())) <= 2
    runner.run(table.name, list(table.every_cell()), alone=False)
    assert runner.plan(list(table.every_cell())) == 0
    assert (tmp_path / "asked").read_text().splitlines().count("0") == 1


def test_a_cell_that_fails_is_told_and_the_others_go_on(made, tmp_path, fake, capsys):
    table = experiment(made, row(made, "one"), seeds=(7, 8))
    runner = made.runner.Runner(tmp_path, "code", 1)
    assert made.tables.run([table], runner, tmp_path / "out", only_write=True) == 0
    with pytest.raises(KeyError):  # the fake cell of seed 8 is finished, but holds nothing
        made.tables.run([table], runner, tmp_path / "out", only_write=False)
    assert runner.failed == ["target=t72 default seed 7: out of luck"]
    printed = capsys.readouterr().out
    assert "made-up 1/2: target=t72 default seed 7 FAILED: out of luck; " in printed
    assert "made-up 2/2: target=t72 default seed 8; 0 min left" in printed


def test_other_sources_end_the_run(made, tmp_path, fake):
    with pytest.raises(made.tables.SarsplatError, match="sources have changed"):
        made.runner.Runner(tmp_path, "other code", 1).run("made-up", [made.cell.Cell({"target": "t72"})], alone=False)


def test_a_refused_cell_is_one_sentence(tmp_path):
    done = python(EXPERIMENTS / "cell.py", tmp_path, input=json.dumps({"dataset": {"target": "tank"}}))
    assert done.returncode == 2
    assert done.stderr.startswith("there is no target named 'tank'")
    assert done.stderr.count("\n") == 1


def test_a_whole_cell(made, tmp_path):
    pytest.importorskip("embreex")
    views = {"azimuth": ("0:360:120",), "grazing": ("45",), "test_azimuth": ("60",)}
    cell = made.cell.Cell({"target": "t72", "pixels": (32,), "spacing": (1.2,), **views}, "auto", {"gaussians": 3000})
    cell = replace(cell, quick=True)
    with few_samples():
        path = made.cell.run(cell, tmp_path)
    assert path == cell.path(tmp_path, made.code_version.code_version("sar-gs"))
    found = made.summary.scores(json.loads(path.read_text()))
    assert found["psnr_db"] > 15
    assert found["cd_m"] < 5
    before = path.stat().st_mtime_ns
    assert made.cell.run(cell, tmp_path) == path
    assert path.stat().st_mtime_ns == before


def test_quick_tables_do_not_reach_the_results(made, tmp_path, monkeypatch, capsys):
    written = []
    monkeypatch.setattr(made.tables, "write", lambda found, work, out, code: written.append((found.quick, out)))
    monkeypatch.setattr(made.tables, "write_index", lambda out, quick: None)
    for words in (["--quick"], []):
        monkeypatch.setattr(sys, "argv", ["tables.py", "--write", "--only", "loss", "--work", str(tmp_path), *words])
        assert made.tables.main() == 0
    assert written == [(True, tmp_path / "quick"), (False, EXPERIMENTS.parent / "docs" / "results")]
    monkeypatch.setattr(sys, "argv", ["tables.py", "--only", "los"])
    with pytest.raises(SystemExit, match="2"):
        made.tables.main()
    assert "there is no experiment 'los'; choose from rendered, " in capsys.readouterr().err
