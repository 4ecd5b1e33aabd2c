"""Files beside the rooms: memory, threads, progress, plugins, and conversions of power."""

import io
import math
import re
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest
import torch
from rich.console import Console
from rich.progress import Progress

import sarsplat
from programs import python
from sarsplat import SarsplatError, SarsplatWarning, memory, progress, radiometry
from sarsplat.cli.render import Pictures
from sarsplat.plugins import discover
from sarsplat.threads import convert, decode

GIB = 2**30


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The root of a machine with 64 GiB free and without control groups."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=64 * GIB))
    monkeypatch.setattr(memory, "_SYSTEM", tmp_path)
    return tmp_path


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def test_the_tightest_of_machine_and_groups_counts(system: Path) -> None:
    assert memory.free_bytes() == 64 * GIB
    write(system, {"proc/self/cgroup": "0::/pod/work\n"})
    groups = system / "sys/fs/cgroup"
    used = {"memory.current": f"{3 * GIB}", "memory.stat": f"anon {2 * GIB}\ninactive_file {GIB}\n"}
    write(groups / "pod/work", {"memory.max": "max\n", **used})
    assert memory.free_bytes() == 64 * GIB
    write(groups / "pod", {"memory.max": f"{10 * GIB}\n", **used})
    assert memory.free_bytes() == 8 * GIB  # what files take can be had back


def test_the_older_groups_count_too(system: Path) -> None:
    write(system, {"proc/self/cgroup": "12:cpu,cpuacct:/a\n9:memory:/a\n"})
    files = {"limit_in_bytes": f"{4 * GIB}", "usage_in_bytes": f"{GIB}", "stat": "total_inactive_file 0"}
    write(system / "sys/fs/cgroup/memory/a", {f"memory.{name}": text for name, text in files.items()})
    assert memory.free_bytes() == 3 * GIB


def test_much_is_said_and_too_much_refused(system: Path) -> None:
    assert memory.required("this", 0.9 * GIB, "take less") is None
    assert memory.required("this", 2 * GIB, "take less") == "this takes about 2 GiB of memory, of 64 GiB that are free"
    with pytest.raises(SarsplatError, match=r"^this takes about 65 GiB of memory, and 64 GiB are free; take less$"):
        memory.required("this", 65 * GIB, "take less")


# ---- threads and Ctrl-C ----------------------------------------------------------------------------------------------
def test_one_thread_at_a_time_learns_a_type(monkeypatch: pytest.MonkeyPatch) -> None:
    inside, most, learn = threading.Semaphore(1), [], msgspec.json.Decoder

    def learning(kind: Any) -> Any:
        most.append(inside.acquire(blocking=False))  # false if another thread is at it
        time.sleep(0.02)
        if most[-1]:
            inside.release()
        return learn(kind)

    monkeypatch.setattr(msgspec.json, "Decoder", learning)
    kinds = [msgspec.defstruct(f"Kind{k}", [("number", int)]) for k in range(3)]
    with ThreadPoolExecutor(6) as pool:
        read = [pool.submit(decode, b'{"number": 1}', kind) for kind in kinds]
        made = [pool.submit(convert, {"number": 1}, kind) for kind in kinds]
        assert [one.result() for one in read] == [one.result() for one in made]
    assert len(most) >= len(kinds)
    assert all(most)


def test_nothing_else_lets_msgspec_learn_types() -> None:
    package = Path(sarsplat.__file__).parent
    pattern = re.compile(r"msgspec\.convert\(|msgspec\.\w+\.decode\(.*type=|\.Decoder\(")
    own = [path.name for path in package.rglob("*.py") if pattern.search(path.read_text())]
    assert own == ["threads.py"]


PROGRAM = """
import os, signal, threading
import numpy as np
from scipy.spatial import cKDTree
from sarsplat.threads import uninterruptible

points = np.random.default_rng(0).normal(size=(60_000, 3))
tree = cKDTree(points)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background process starts without
threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    uninterruptible(tree.query, points, k=64, workers=-1)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def test_a_search_that_is_interrupted_harms_nothing() -> None:
    done = python("-c", PROGRAM)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr


# ---- lines of progress where there is no terminal --------------------------------------------------------------------
def test_the_time_left_is_told_once_something_is_done_here(monkeypatch, capsys) -> None:
    now = iter(range(0, 100, 10))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(now)))
    with progress.progress("sweep", 8) as reporter:
        reporter.start_at(4)  # done before
        reporter.advance(0, "running")
        reporter.advance(2, "box")
    lines = [re.sub(r" +", " ", line).rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines == ["sweep: 4/8", "sweep: 4/8 running", "sweep: 6/8 box 30 s left"]


def test_short_parts_of_long_work_are_not_silent_together(monkeypatch, capsys) -> None:
    now = iter(range(0, 100, 3))  # the work and its parts look at the clock when they begin, and at every step
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(now)))
    with progress.progress("report", 2) as reporter:
        reporter.advance(0, "points")
        with progress.stage("mesh", 3) as part:
            part.advance(1)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["mesh:"]


@pytest.mark.parametrize("width", [60, 80, 110, 200])
@pytest.mark.parametrize(("seconds", "left"), [(1, ""), (10, ""), (60, "0:21:13 left"), (25, "531 s left")])
def test_narrow_terminals_cut_words_and_no_figures(width: int, seconds: float, left: str) -> None:
    """And nothing is foretold of the first twentieth, until it has taken long."""
    console = Console(width=width, file=io.StringIO())
    bar = Progress(*progress._columns(width, 44), console=console)
    reporter = progress.Reporter(20_000, bar, "evaluate /home/someone/data/t72/runs/first-run")
    reporter._begun -= seconds
    reporter.update(900, "distances: points from the visible surface  12345 Gaussians")
    with console.capture() as shown:
        console.print(bar.get_renderable())
    (line,) = shown.get().splitlines()
    assert "900/20000" in line
    assert "0:00:00" in line  # the bar's own clock
    assert line.rstrip().endswith(left or "0:00:00")


def test_a_tally_says_where_the_time_went() -> None:
    with progress.tally() as spent, progress.progress("work", 3, quiet=True) as shown:
        time.sleep(0.12)
        shown.advance(1, "digging: a hole")
        time.sleep(0.06)
        shown.advance(1, "digging: another")
        shown.advance(1)
    assert spent["digging"] >= 0.18 > spent["work"]
    assert re.fullmatch(r"\d\.\d s \(digging \d\.\d s\)", str(spent))
    with progress.progress("work", 1, quiet=True) as shown:
        shown.advance(1, "unasked")
    assert "unasked" not in spent


# ---- plugins ---------------------------------------------------------------------------------------------------------
GROUP = "sarsplat.formats"


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Two packages with format_NAME.py, and an installed third with entry points."""
    files = {
        "ours_a/__init__.py": "",
        "ours_a/format_long_name.py": "FORMAT = 'ours'",
        "ours_a/other.py": "raise RuntimeError",
        "ours_b/__init__.py": "",
        "ours_b/format_c.py": "FORMAT = 'c'",
        "theirs.py": "GOOD = 'theirs'",
        "broken.py": "raise KeyError('no luck')",
        "theirs-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n",
        "theirs-1.0.dist-info/entry_points.txt": f"[{GROUP}]\nfine = theirs:GOOD\nbad = broken:GOOD\n",
    }
    write(tmp_path, files)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for module in ("ours_a", "ours_a.format_long_name", "ours_b", "ours_b.format_c", "theirs"):
        sys.modules.pop(module, None)


def found():
    return discover("ours_a", "format_", "FORMAT", GROUP, "ours_b")


def test_plugins_are_found_by_name_and_imported_when_asked_for(home):
    plugins = found()
    assert list(plugins) == ["long-name", "c", "fine", "bad"]
    assert "theirs" not in sys.modules and "ours_a.format_long_name" not in sys.modules
    assert (plugins["long-name"], plugins["fine"]) == ("ours", "theirs")
    assert "ours_b.format_c" not in sys.modules


def test_a_broken_plugin_is_named_and_stops_no_other(home):
    plugins = found()
    with pytest.raises(SarsplatError, match=r"the plugin bad of sarsplat.formats .* broken:GOOD \(KeyError: .*no luck"):
        plugins["bad"]
    with pytest.warns(SarsplatWarning, match="the plugin bad") as warned:
        assert plugins.loaded() == {"long-name": "ours", "c": "c", "fine": "theirs"}
    assert len(warned) == 1


def test_a_name_that_is_taken_is_refused_with_a_warning(home):
    (home / "theirs-1.0.dist-info" / "entry_points.txt").write_text(f"[{GROUP}]\nc = theirs:GOOD\n")
    with pytest.warns(SarsplatWarning, match=r"the plugin c .* from theirs:GOOD is ignored, because ours_b.format_c"):
        assert found()["c"] == "c"


# ---- decibels, amplitudes and conversions of β⁰ ----------------------------------------------------------------------
POWER = np.array([1.0, 10.0, 0.5])


def test_decibels_of_power() -> None:
    np.testing.assert_allclose(radiometry.to_db(POWER, 10.0), [-10, 0, -13.0103], atol=1e-4)
    np.testing.assert_allclose(radiometry.from_db(radiometry.to_db(POWER)), POWER, rtol=1e-14)
    assert radiometry.to_db(0.0) == pytest.approx(-379.3, abs=0.1)
    assert radiometry.to_db(np.float32(0.001)) == pytest.approx(-30)
    assert radiometry.to_db(0.0, least=0.0) == -np.inf
    np.testing.assert_allclose(radiometry.amplitude(POWER) ** 2, POWER)


@pytest.mark.parametrize("grazing_deg", [10.0, 45.0, 80.0])
def test_flat_ground(grazing_deg: float) -> None:
    """σ⁰ counts area on the ground, β⁰ in the slant plane, γ⁰ across the line of sight: one scatterer, three areas."""
    ground, slant = 7.0, 7.0 * math.cos(math.radians(grazing_deg))
    across = 7.0 * math.sin(math.radians(grazing_deg))
    beta0, sigma0, gamma0 = 3.0 / slant, 3.0 / ground, 3.0 / across
    assert radiometry.beta0_of_gamma0(gamma0, grazing_deg) == pytest.approx(beta0)
    assert radiometry.gamma0_of_beta0(beta0, grazing_deg) == pytest.approx(gamma0)
    assert radiometry.beta0_of_sigma0(sigma0, grazing_deg) == pytest.approx(beta0)
    assert radiometry.sigma0_of_beta0(beta0, grazing_deg) == pytest.approx(sigma0)
    tensor = torch.tensor([gamma0], requires_grad=True)
    radiometry.beta0_of_gamma0(tensor, grazing_deg).backward()
    assert tensor.grad.item() == pytest.approx(beta0 / gamma0)


def test_the_bright_level_ignores_a_glint_and_is_never_zero() -> None:
    power = np.ones((50, 50))
    power[0, 0] = 1e6
    assert radiometry.bright_level(power) == 1.0
    lone = np.zeros((50, 50))
    lone[0, 0] = 4.0
    assert radiometry.bright_level(lone) == 4.0
    assert radiometry.bright_level(np.zeros((2, 2))) == 1.0


@pytest.mark.parametrize("db", [20, 30, 40])
def test_the_usual_peak_is_the_largest_power_but_for_few_echoes_that_outshine_all_others(db: int) -> None:
    target = np.exp(np.random.default_rng(0).normal(0, 1.5, 3000))
    image = np.zeros((100, 100))
    image.flat[: len(target)] = target
    assert radiometry.usual_peak(image) == image.max()  # 19 dB above its upper quartile
    image.flat[5000:5100] = 10 ** (db / 10) * image.max() * np.exp(-np.linspace(0, 14, 100))  # with its skirts
    assert 1 <= radiometry.usual_peak(image) / target.max() < 3
    assert radiometry.usual_peak(np.pad(image, 300)) == radiometry.usual_peak(image)  # of any size
    assert radiometry.usual_peak(np.zeros(3)) == 0
    assert radiometry.usual_peak(np.eye(5)) == 1


def test_white_is_the_largest_power_unless_it_outshines_all() -> None:
    image = np.geomspace(1.0, 30.0, 10000)
    assert radiometry.white_level(image) == image.max()
    image[:9] = 1e6
    assert radiometry.white_level(image) == 100 * radiometry.bright_level(image) < 3001
    assert [radiometry.white_level(np.zeros(n)) for n in (0, 3)] == [1, 1]
    alone = np.zeros((128, 128))
    alone[5, 5:27] = np.geomspace(1.0, 1e-3, 22)  # a scatterer and its response, on nothing
    assert radiometry.white_level(alone) == 1
    alone[90, 90] = 1e6
    assert radiometry.white_level(alone) < 100


def test_brightness_is_linear_in_decibels() -> None:
    np.testing.assert_allclose(radiometry.shade(np.array([200.0, 100.0, 1.0, 0.0]), 100.0), [1, 1, 0.5, 0])
    np.testing.assert_allclose(radiometry.shade(np.array([1.0]), 100.0, 25.0), [0.2])
    assert radiometry.brighter(np.array([1.0, 0.11, 0.1]), -10.0).tolist() == [True, True, False]
    assert radiometry.brighter(np.array([1.0, 0.11, 0.1]), -10.0, 10.0).tolist() == [False, False, False]


def test_what_is_darker_than_the_darkest_makes_no_difference() -> None:
    rendered, truth = np.array([2.0, 1e-9, 1.0]), np.array([1.0, 1e-6, 0.0])
    np.testing.assert_allclose(radiometry.difference_db(rendered, truth, 10.0, -30.0), [3.0103, 0, 20], atol=1e-4)


def test_there_is_one_dynamic_range() -> None:
    """The command's own default is written there: its options are read without numpy."""
    assert Pictures.range_db == radiometry.DYNAMIC_RANGE_DB


def test_decibels_are_computed_nowhere_else() -> None:
    package = Path(sarsplat.__file__).parent
    pattern = re.compile(r"10(\.0)? ?\* ?(np|math|torch)\.log10|\*\* ?\(.*/ 10\)")
    own = [path for path in package.rglob("*.py") if path.name != "radiometry.py" and pattern.search(path.read_text())]
    assert not own
