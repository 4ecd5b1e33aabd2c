"""The documentation tells the truth: its code runs, its links lead somewhere, its commands and names exist."""

import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from made import FEW_POINTS
from made_runs import made_up, make_metrics
from programs import ROOT, python
from sarsplat import PRESETS, Dataset, ImageGrid, SarImage, View, preset, reconstruct, simulate_images, write_dataset
from sarsplat.cli import main
from sarsplat.cli.app import parse
from sarsplat.cli.commands import COMMANDS
from sarsplat.evaluation import RUN_METRICS, UNSEEN_METRICS, Yardstick, metrics_of_points
from sarsplat.gaussians import SCATTERINGS
from sarsplat.scenes import target_mesh

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
CHEAP = ("completion", "doctor", "export", "info", "render", "report")
"""Commands that are run here as the pages show them; the others are only read."""


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def run_python(*arguments: str, folder: Path | None = None) -> str:
    """Standard output of a fresh interpreter in which every warning is an error."""
    done = python("-W", "error", *arguments, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_readme_example_gives_every_parameter_a_gradient(capsys):
    example = blocks(ROOT / "README.md", "python")[0]
    assert sum(bool(line.strip()) for line in example.splitlines()) < 20
    exec(compile(example, "README.md", "exec"), {})
    printed = capsys.readouterr().out
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


@pytest.fixture(scope="session")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages suppose: the dataset t72 and the runs t72-run and mstar-t72-run, all small."""
    folder = tmp_path_factory.mktemp("workshop")
    grid = ImageGrid(rows=32, columns=32, spacing_m=(0.4, 0.4), resolution_m=(0.4, 0.4))
    views = [View(azimuth, grazing) for grazing in (30.0, 60.0) for azimuth in range(0, 360, 90)]
    mesh = target_mesh("t72")
    images = [SarImage(power, view, grid) for power, view in zip(simulate_images(mesh, views, grid), views)]
    dataset = write_dataset(folder / "t72", Dataset.from_images(images, target="t72"))
    few = replace(preset("quick"), iterations=20, gaussians=400, points=FEW_POINTS)
    reconstruct(dataset, few, folder / "t72-run", quiet=True)
    made_up("T72", folder / "mstar-t72-run")
    return folder


@pytest.fixture
def bench(workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, to work in."""
    place = tmp_path / "bench"
    shutil.copytree(workshop, place)
    monkeypatch.chdir(place)
    return place


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda path: path.stem)
def test_python_of_a_page_runs_from_top_to_bottom(page, bench, threads, monkeypatch):
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)  # where a dataclass looks up its annotations
    monkeypatch.setattr(SCATTERINGS, "_entries", dict(SCATTERINGS._entries))  # a law is not registered for other tests
    for name, whole in PRESETS.items():
        few = min(whole.iterations, 5), min(whole.gaussians or 300, 300)
        short = replace(whole, iterations=few[0], gaussians=few[1], fewest_gaussians=few[1], points=FEW_POINTS)
        monkeypatch.setitem(PRESETS, name, short)
    exec(compile("\n".join(blocks(page, "python")), str(page), "exec"), vars(module))


@pytest.mark.slow
def test_own_arrays(tmp_path):
    printed = run_python(str(ROOT / "examples" / "own_arrays.py"), folder=tmp_path)
    count, height = re.findall(r"(\d+) points; heights up to ([\d.]+) m", printed)[0]
    assert int(count) > 1000
    assert 1.5 < float(height) < 4  # a vehicle's
    assert {path.name for path in tmp_path.iterdir()} == {"first-image.png", "unseen-view.png"}


@pytest.mark.slow
def test_own_loss(tmp_path):
    printed = run_python(str(ROOT / "examples" / "own_loss.py"), folder=tmp_path)
    preset_s, own = (float(value) for value in re.findall(r"([\d.]+) dB off", printed))
    assert own < preset_s


@pytest.mark.slow
def test_watch_training(tmp_path):
    printed = run_python(str(ROOT / "examples" / "watch_training.py"), folder=tmp_path)
    losses = [float(value) for value in re.findall(r"loss ([\d.]+)", printed)]
    assert losses[-1] == min(losses) < max(losses) / 2
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
            headings = re.findall(r"^#+ +(.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in anchors, f"{page.name}: {target}"


def commands(page: Path) -> list[str]:
    """Command lines of ours in a page's shell blocks, and those of its indented blocks."""
    text = page.read_text(encoding="utf-8")
    lines = [line for block in blocks(page, "bash") for line in block.splitlines()]
    lines += [line.strip() for line in re.findall(r"^    sarsplat .*$", text, re.MULTILINE)]
    return [words[0] for line in lines if (words := re.findall(r"(?:^|\()(sarsplat [^)]*)", line))]


def words_of(command: str) -> list[str]:
    """What the program is given; not what is the shell's."""
    return shlex.split(command.partition(">")[0], comments=True)[1:]


EVERY_COMMAND = [(page, command) for page in PAGES for command in dict.fromkeys(commands(page))]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
    assert (ROOT / "docs" / "images" / "sweep.gif").stat().st_size <= 1.5e6


def test_the_lab_notes_are_listed_by_their_titles():
    lab = ROOT / "docs" / "lab"
    titles = {
        note.name: note.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ") for note in lab.glob("2*.md")
    }
    listed = re.findall(r"^- .*: \[(.*)\]\((.*)\)$", (lab / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted((name, title) for title, name in listed) == sorted(titles.items())


def test_the_page_of_the_command_line_shows_every_command():
    shown = {words_of(command)[0] for command in commands(ROOT / "docs" / "reference" / "command-line.md")}
    assert shown == set(COMMANDS)


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda path: path.stem)
def test_commands_in_pages_are_understood(page):
    for command in commands(page):
        assert callable(parse(words_of(command))), command


def test_cheap_commands_in_pages_work(bench, capfd):
    cheap = dict.fromkeys(" ".join(words_of(command)) for _, command in EVERY_COMMAND)
    done = set()
    for words in [shlex.split(line) for line in cheap if line.startswith(CHEAP)]:
        named = [word for word in words[1:2] if words[0] not in ("completion", "doctor")]
        if any(not Path(name).exists() for name in named):
            continue  # of a dataset or a run that a dear command makes
        words += ["--overwrite"] if "--out" in words or words[0] == "export" else []
        words += ["--frames", "12"] if "--sweep" in words and "--frames" not in words else []
        words = [re.sub(r"^0:360:\d+$", "0:360:120", word) for word in words]
        assert main(words) == 0, words
        done.add(words[0])
    assert done == set(CHEAP)
    assert Path("t72.glb").stat().st_size > 0
    assert "wrote" in capfd.readouterr().out


def test_names_in_the_paper_map_exist():
    text = (ROOT / "docs" / "concepts" / "paper-map.md").read_text(encoding="utf-8")
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


def test_results_table_comes_from_metrics_and_leaves_gaps_open(module):
    results = module("docs/readme_results")
    points = {"visible": {"cd_m": 0.08, "f1@0.3": 0.97, "f1@0.1": 0.7}}
    table = results.table(make_metrics(psnr_db=50.13, ssim=0.999) | {"points": points, "time_s": 83.2})
    assert "| 50.13 | 35.91 |" in table
    assert "| LPIPS (↓) | – | 0.0165 |" in table
    assert "| training time (s, ↓) | 83 | 400 |" in table
    assert "| F1 at 0.1 m, visible surface (↑) | 0.700 | – |" in table
    assert results.BLOCK.search((ROOT / "README.md").read_text(encoding="utf-8"))


def test_documented_metrics_are_those_of_the_registry():
    text = (ROOT / "docs" / "reference" / "formats" / "run.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(images\.<set>|points\.<surface>)\.(.*?)` \| (.*) \|$", text, re.MULTILINE)
    expected = [("images.<set>", metric.key, metric.definition) for metric in UNSEEN_METRICS]
    expected += [("points.<surface>", metric.key, metric.definition) for metric in metrics_of_points(Yardstick(0.3))]
    assert rows == expected
    assert re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE).count(("time_s", RUN_METRICS[0].definition)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("page", ["learn/getting-started.md", "reference/command-line.md"])
def test_commands_of_a_page_work_in_the_order_shown(page, tmp_path):
    """As printed; measured chips only where there are some."""
    target_mesh("t72").export(tmp_path / "vehicle.obj")
    chips = ROOT.parent / "shared" / "data" / "mstar"
    if chips.is_dir():
        (tmp_path / "chips").symlink_to(chips)
        (tmp_path / "labels.csv").symlink_to(next(chips.glob("*.csv")))
    plan = 'datasets = ["t72"]\npreset = "quick"\n'
    (tmp_path / "plan.toml").write_text(plan)
    for command in commands(ROOT / "docs" / page):
        serves = words_of(command)[0] == "view"  # until it is ended
        if serves or ("mstar" in command and not chips.is_dir()):
            continue
        line = f"{shlex.quote(sys.executable)} -m {command}"
        done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=900)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        assert done.stdout or done.stderr or ">" in command, command
    for made in ("t72-run/report/index.html", "t72-run/metrics.json", "sweep/contact-sheet.png", "t72.glb"):
        assert (tmp_path / made).stat().st_size > 0, made
