"""The documentation tells the truth: its example runs, its links lead somewhere, its commands and names exist."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sarsplat.cli import main
from sarsplat.cli.parser import COMMANDS
from sarsplat.evaluation import IMAGE_METRICS, MASK_METRICS, RUN_METRICS, Yardstick, metrics_of_points
from sarsplat.scenes import target_mesh

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def run_python(*arguments: str, folder: Path | None = None) -> str:
    """Standard output of a fresh interpreter in which every warning is an error."""
    command = [sys.executable, "-W", "error", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def anchors(page: Path) -> set[str]:
    """The names under which a page's headings can be linked to."""
    headings = re.findall(r"^#+ +(.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_readme_example_gives_every_parameter_a_gradient():
    example = blocks(ROOT / "README.md", "python")[0]
    assert sum(bool(line.strip()) for line in example.splitlines()) < 20
    printed = run_python("-c", example)
    cross_section, image_sum = map(float, re.findall(r"([\d.]+) m²", printed))
    assert cross_section > 0
    assert image_sum == pytest.approx(cross_section, rel=0.01)
    for name in ("means", "quaternions", "scales", "optical_depth", "scattering"):
        (gradient,) = re.findall(rf"^{name}: tensor\((.*?)\)$", printed, re.MULTILINE)
        values = [float(number) for number in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", gradient)]
        assert any(value != 0 for value in values), name


def test_readme_example_is_the_example_script():
    script = (ROOT / "examples" / "one_gaussian.py").read_text(encoding="utf-8")
    assert script.endswith(blocks(ROOT / "README.md", "python")[0])


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.name)
def test_example_compiles(script):
    compile(script.read_text(encoding="utf-8"), str(script), "exec")


def test_own_arrays(tmp_path):
    printed = run_python(str(ROOT / "examples" / "own_arrays.py"), folder=tmp_path)
    count, height = re.findall(r"(\d+) points; heights up to ([\d.]+) m", printed)[0]
    assert int(count) > 1000
    assert 1.5 < float(height) < 4  # a vehicle's
    assert {path.name for path in tmp_path.iterdir()} == {"first-image.png", "unseen-view.png"}


def test_own_loss(tmp_path):
    printed = run_python(str(ROOT / "examples" / "own_loss.py"), folder=tmp_path)
    preset_s, own = (float(value) for value in re.findall(r"([\d.]+) dB off", printed))
    assert own < preset_s


def test_watch_training(tmp_path):
    printed = run_python(str(ROOT / "examples" / "watch_training.py"), folder=tmp_path)
    losses = [float(value) for value in re.findall(r"loss ([\d.]+)", printed)]
    assert losses == sorted(losses, reverse=True)
    assert len(list(tmp_path.glob("step-*.png"))) == len(losses) > 1


@pytest.mark.slow
def test_fit_gaussians_reaches_a_good_fit():
    last = run_python(str(ROOT / "examples" / "fit_gaussians.py")).splitlines()[-1]
    assert float(re.findall(r"PSNR ([\d.]+) dB", last)[0]) > 40


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(path), f"{page.name}: {target}"


def commands(page: Path) -> list[str]:
    lines = [line for block in blocks(page, "bash") for line in block.splitlines()]
    return [words[0] for line in lines if (words := re.findall(r"(?:^|\()(sarsplat [^)]*)", line))]


def test_readme_shows_every_command():
    shown = {shlex.split(command)[1] for command in commands(ROOT / "README.md")}
    assert shown == set(COMMANDS)


def test_commands_in_readme_have_the_options_shown(capsys):
    for command in commands(ROOT / "README.md"):
        _, name, *words = shlex.split(command)
        command_words = [name, words[0]] if isinstance(COMMANDS[name], dict) else [name]
        with pytest.raises(SystemExit):
            main([*command_words, "--help"])
        known = set(re.findall(r"--[\w.-]+", capsys.readouterr().out))
        assert {word for word in words if word.startswith("--")} <= known, command


def test_names_in_the_paper_map_exist():
    text = (ROOT / "docs" / "paper-map.md").read_text(encoding="utf-8")
    references = re.findall(r"`([\w/]+\.(?:py|h))`(?:: ((?:`\w+`(?:, )?)+))?", text)
    assert len(references) > 20
    for file, names in references:
        path = ROOT / "src" / "sarsplat" / file
        assert path.is_file(), file
        for name in re.findall(r"\w+", names):
            assert re.search(rf"\b(def|class|struct) {name}\b|\b{name}\(", path.read_text(encoding="utf-8")), (
                file,
                name,
            )


def test_results_table_comes_from_metrics_and_leaves_gaps_open():
    spec = importlib.util.spec_from_file_location("readme_results", ROOT / "docs" / "readme_results.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    metrics = {
        "images": {"test": {"psnr_db": 50.13, "psnr_target_db": 33.0, "ssim": 0.999, "lpips": None}},
        "points": {"visible": {"cd_m": 0.08, "f1@0.3": 0.97, "f1@0.1": 0.7}},
        "baselines": None,
        "parameters": {"yardstick_m": 0.3},
        "truth": {"mesh": None},
        "time_s": 83.2,
    }
    table = module.table(metrics)
    assert "| 50.13 | 35.91 |" in table
    assert "| LPIPS (↓) | – | 0.0165 |" in table
    assert "| training time (s, ↓) | 83 | 400 |" in table
    assert "| F1 at 0.1 m, visible surface (↑) | 0.700 | – |" in table
    assert module.BLOCK.search((ROOT / "README.md").read_text(encoding="utf-8"))


def test_documented_metrics_are_those_of_the_registry():
    text = (ROOT / "docs" / "datasets-and-runs.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(images\.<set>|points\.<surface>)\.(.*?)` \| (.*) \|$", text, re.MULTILINE)
    expected = [("images.<set>", metric.key, metric.definition) for metric in (*IMAGE_METRICS, *MASK_METRICS)]
    expected += [("points.<surface>", metric.key, metric.definition) for metric in metrics_of_points(Yardstick(0.3))]
    assert rows == expected
    assert re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE).count(("time_s", RUN_METRICS[0].definition)) == 1


@pytest.mark.slow
def test_readme_commands_work_in_the_order_shown(tmp_path):
    """As printed; measured chips only where there are some."""
    target_mesh("t72").export(tmp_path / "vehicle.obj")
    chips = ROOT.parent / "shared" / "data" / "mstar"
    if chips.is_dir():
        (tmp_path / "chips").symlink_to(chips)
        (tmp_path / "labels.csv").symlink_to(next(chips.glob("*.csv")))
    for command in commands(ROOT / "README.md"):
        if "mstar" in command and not chips.is_dir():
            continue
        line = f"{shlex.quote(sys.executable)} -m {command}"
        done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=900)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        assert done.stdout or done.stderr or ">" in command, command
    for made in ("t72-run/report/index.html", "t72-run/metrics.json", "sweep/contact-sheet.png", "t72.ply"):
        assert (tmp_path / made).stat().st_size > 0, made
