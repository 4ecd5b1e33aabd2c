"""`make bench` and `make guard` in small: the parts run, the page can be made, and worse scores are found."""

import json
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from programs import ROOT, python

BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture
def generator(module) -> ModuleType:
    """What fills docs/reference/performance.md."""
    return module("benchmarks/performance_page")


@pytest.fixture
def bench(module) -> ModuleType:
    """What runs the parts."""
    return module("benchmarks/bench")


def results() -> dict:
    """The committed results."""
    return json.loads((BENCHMARKS / "results" / "cpu.json").read_text())


def spread(median: float) -> dict[str, float]:
    return {"median": median, "p10": 0.9 * median, "p90": 1.25 * median, "samples": 9}


def test_the_page_is_what_the_committed_results_say(generator):
    text = (ROOT / "docs" / "reference" / "performance.md").read_text()
    devices = [json.loads(path.read_text()) for path in sorted((BENCHMARKS / "results").glob("cuda-*.json"))]
    assert generator.section(results(), devices) in text


def test_the_section_says_what_was_measured(generator):
    found = results()
    naive, growth = found["parts"]["naive"], found["parts"]["growth"]
    naive["ratios"] = {"plain torch / engine": spread(40.0)}
    naive["times"] = {"plain torch": spread(0.1), "engine": spread(0.0025)}
    growth["slopes"]["gaussians"], growth["bytes_each"]["gaussian"] = 1.02, 411.0
    scores = {"psnr_db": 50.0, "lpips": None, "cd_m": 0.2, "f1@0.3": 0.75, "f1@0.1": 0.5}
    found["parts"]["paper"] = {"iterations": 30_000, "training_s": 100.0, "scores": scores}
    text = generator.section(found, []).replace("\n", " ")
    for said in (
        "| image and gradients, one view | 100 ms | 2.5 ms | 40 (36 … 50) |",
        "| time grows with the number of Gaussians to this power (1: twice as many take twice as long) | 1.02 |",
        "| peak memory for each Gaussian, gradients included | 411 B |",
        "takes 100 s on these cores; the paper reports 400 s on an RTX 3060 Ti",
        "PSNR 50.00 dB (35.91), CD 0.200 m (0.187), F1@0.3 0.750 (0.925). The",
        "The CUDA engine has not been run on a GPU.",
    ):
        assert said in text
    assert not [word for word in ("contender", "floor", "lane", "twin", "degenerate") if word in text.lower()]


def test_quick_results_do_not_reach_the_page(generator, monkeypatch, tmp_path):
    page, picture = tmp_path / "performance.md", tmp_path / "growth.png"
    page.write_text("above\n<!-- performance: begin -->\nsuperseded\n<!-- performance: end -->\nbelow\n")
    for name, value in {"RESULTS": tmp_path, "PAGE": page, "PICTURE": picture}.items():
        monkeypatch.setattr(generator, name, value)
    with pytest.raises(SystemExit, match="run `make bench`"):
        generator.main()
    found = results()
    for quick in (True, False):
        found["machine"]["quick"] = quick
        (tmp_path / "cpu.json").write_text(json.dumps(found))
        if quick:
            with pytest.raises(SystemExit, match="quick run"):
                generator.main()
            assert "superseded" in page.read_text()
    generator.main()
    assert "superseded" not in page.read_text()
    assert page.read_text().endswith("-->\nbelow\n")
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_quick_bench_finds_all_that_the_section_needs(generator, tmp_path):
    done = python("-W", "error", BENCHMARKS / "bench.py", "--quick", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["cpu.json"]
    made = json.loads((tmp_path / "cpu.json").read_text())
    assert made["machine"]["quick"]
    assert "nan" not in generator.section(made, [])
    assert done.stdout.endswith("Quick run: it shows that everything works; the numbers mean nothing.\n")
    growth = made["parts"]["growth"]
    assert growth["slopes"]["gaussians"] != growth["slopes"]["pixels"]
    assert all(row["peak_bytes"] > 0 and row["floor_s"] > 0 for row in growth["series"]["gaussians"])
    assert not {"/", "\\"} & set(json.dumps({k: v for k, v in made["machine"].items() if k != "processor"}))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nave"], "there is no part 'nave'; choose from determinism, iteration"),
        (["--threads", "0"], "--threads must be at least 1"),
        (["floor", "--out", "x"], "leave out the names of parts"),
    ],
)
def test_a_wrong_command_line_is_told_so(bench, monkeypatch, capsys, words, said):
    monkeypatch.setattr(sys, "argv", ["bench.py", *words])
    with pytest.raises(SystemExit, match="2"):
        bench.main()
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_the_whole_training_is_measured(generator, module):
    made = results()
    made["parts"]["paper"] = module("benchmarks/paper_run").measure(quick=True)
    assert "20 iterations" in generator.section(made, [])


# ---- which scores of the demo count as worse -------------------------------------------------------------------------
@pytest.fixture
def guard(module) -> ModuleType:
    return module("benchmarks/guard")


def demo(folder: Path, psnr_db: float | None = 40.0, cd_m: float = 0.03, gaussians: int = 900) -> Path:
    """An evaluated run of made-up scores."""
    points = {"cd_m": cd_m, "f1@0.3": 0.9, "f1@0.1": 0.8, "count": 1000}
    surfaces = {"visible": points, "whole": points}
    images = {"psnr_db": psnr_db, "psnr_target_db": 30.0, "ssim": 0.99, "lpips": None}
    metrics: dict[str, Any] = {"images": {"test": images}, "points": surfaces, "mesh": surfaces, "time_s": 7.0}
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "metrics.jsonl").write_text(f'{{"iteration": 4}}\n{{"iteration": 8, "gaussians": {gaussians}}}\n')
    return folder


@pytest.mark.parametrize(
    ("changes", "name", "verdict", "fine"),
    [
        ({}, "images.test.psnr_db", "", True),
        ({"psnr_db": 40.4}, "images.test.psnr_db", "", True),  # within five times the range of the seeds
        ({"psnr_db": 41.0}, "images.test.psnr_db", "better, +0.5 past its band", True),
        ({"psnr_db": 39.0}, "images.test.psnr_db", "WORSE, -0.5 past its band", False),
        ({"cd_m": 0.01}, "points.visible.cd_m", "better, -0.02 past its band", True),
        ({"cd_m": 0.05}, "mesh.whole.cd_m", "WORSE, +0.02 past its band", False),
        ({"gaussians": 901}, "gaussians", "WORSE, +1 past its band", False),
        ({"gaussians": 899}, "gaussians", "WORSE, -1 past its band", False),
        ({"psnr_db": None}, "images.test.psnr_db", "missing", False),
    ],
)
def test_a_score_that_leaves_its_band_is_named(guard, tmp_path, changes, name, verdict, fine):
    seeds = [guard.scores(demo(tmp_path / f"{psnr_db}", psnr_db)) for psnr_db in (39.9, 40.0, 40.1)]
    lines, passed = guard.compare(guard.scores(demo(tmp_path / "run", **changes)), guard.bands(seeds))
    assert passed == fine
    (line,) = (line for line in lines if line.split()[:1] == [name])
    assert line.split(maxsplit=4)[4:] == ([verdict] if verdict else [])
    assert len(lines) == 2 + len(guard.BETTER)
    assert "7  not judged" in lines[-1]


def test_a_run_of_former_code_is_not_judged(guard, tmp_path):
    """Whenever it was evaluated."""
    run, kernel = demo(tmp_path / "run"), tmp_path / "src" / "csrc" / "kernel.cuh"
    checkpoint = run / "checkpoints" / "00000900.safetensors"
    for file in (checkpoint, kernel):
        file.parent.mkdir(parents=True)
        file.touch()
    trained = (run / "metrics.json").stat().st_mtime - 60
    os.utime(checkpoint, (trained, trained))
    for name, age_s, found in (("kernel.cuh", 5, None), ("notes.txt", -5, None), ("kernel.cuh", -5, kernel)):
        file = kernel.with_name(name)
        file.touch()
        os.utime(file, (trained - age_s, trained - age_s))
        assert guard.newer(run, tmp_path / "src") == found


def test_the_stored_bands_are_of_what_is_judged(guard):
    stored = json.loads((ROOT / "benchmarks" / "results" / "demo.json").read_text(encoding="utf-8"))
    assert stored["bands"].keys() == guard.BETTER.keys()
    assert stored["widened"] == guard.WIDENED
    assert all(low <= high for low, high in stored["bands"].values())
