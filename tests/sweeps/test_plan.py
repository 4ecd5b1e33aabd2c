"""Plans mean every combination of what they list; a run is stale when what it depends on has changed, and only then."""

import importlib
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from programs import ROOT
from sarsplat import SarsplatError, preset, read_dataset, write_dataset
from sarsplat.sweeps import Plan, cell
from sarsplat.sweeps.cell import Cell, cells_of


def cells(place: Path, text: str) -> list[Cell]:
    (place / "plan.toml").write_text(text)
    return cells_of(Plan.read(place / "plan.toml"), place)


def settings(cell: Cell, *names: str) -> list[Any]:
    return [cell.labels.get(name) for name in names]


def test_every_combination_is_a_run(place):
    text = """
    datasets = ["data/*"]
    preset = ["default", "quick"]
    seeds = [3, 4]
    [settings]
    iterations = [10, 20]
    rates.means = [0.1, 0.2]
    "points.voxel" = 0.5
    """
    found = cells(place, text)
    assert len(found) == 2 * 2 * 2 * 2 == len({cell.address for cell in found})
    assert [settings(cell, "preset", "iterations", "rates.means") for cell in found[::2]] == [
        [name, count, rate] for name in ("default", "quick") for count in (10, 20) for rate in (0.1, 0.2)
    ]
    first = found[1]
    assert (first.seed, first.config["seed"], first.config["iterations"]) == (4, 4, 10)
    assert (first.config["rates"]["means"], first.config["points"]["voxel"]) == (0.1, 0.5)
    assert first.config["loss"] == preset("default").loss


def test_methods_have_settings_of_their_own(place):
    text = """
    datasets = ["data/box"]
    [settings]
    iterations = 5
    [methods.sar-gs]
    gaussians = [100, 200]
    [methods.sar-nerf-grid]
    iterations = 7
    """
    found = cells(place, text)
    assert [settings(cell, "method", "gaussians", "iterations") for cell in found] == [
        ["sar-gs", 100, 5],
        ["sar-gs", 200, 5],
        ["sar-nerf-grid", None, 7],
    ]


def test_settings_are_said_as_on_the_command_line(place):
    text = """
    datasets = ["data/*"]
    [settings]
    densification = ["on", "off"]
    scale_bounds = [[0.1, 0.5], [0.2, 0.6]]
    gaussians = "None"
    """
    found = cells(place, text)
    assert [cell.config["densification"] is None for cell in found] == [False, False, True, True]
    assert [cell.config["scale_bounds"] for cell in found[:2]] == [(0.1, 0.5), (0.2, 0.6)]
    switched = cells(place, 'datasets = ["data/*"]\nsettings = { "densification.start" = 7 }')[0]
    assert switched.config["densification"]["start"] == 7


def test_plans_of_the_page_are_plans(place):
    for name in ("t72", "targets/box", "chips/box"):
        shutil.copytree(place / "data" / "box", place / name)
    page = (ROOT / "docs" / "how-to" / "sweep.md").read_text(encoding="utf-8")
    combined, parts = (
        cells(place, text) for text in re.findall(r"^```toml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    )
    # two datasets, three seeds, two counts of iterations: with two counts of Gaussians, and with the other method
    assert (len(combined), len(parts)) == (2 * 3 * 2 * (2 + 1), 2)


def test_parts_inherit_and_override(place):
    text = """
    datasets = ["data/*"]
    seeds = [1]
    [settings]
    iterations = 5
    [[parts]]
    name = "more"
    settings = { gaussians = 10 }
    [[parts]]
    seeds = [1, 2]
    """
    found = cells(place, text)
    assert [(cell.labels["part"], cell.seed, *settings(cell, "iterations", "gaussians")) for cell in found] == [
        ("more", 1, 5, 10),
        ("part 2", 1, 5, None),
        ("part 2", 2, 5, None),
    ]


def test_the_same_settings_are_the_same_run_whatever_led_to_them(place):
    two = 'datasets = ["data/*"]\npreset = ["default", "quick"]\n[settings]\n'
    same = "iterations = 9\ngaussians_per_cell = 9.0\nscale_bounds = [[0.1, 0.4]]\nfine_from = 1.0\nrates.means = 0.3\n"
    same += "points.rays_per_pixel = 9.0\npoints.voxel = 0.1\ncheckpoint_every = "
    found = cells(place, f"{two}{same}5") + cells(place, f"{two}{same}7")
    assert len({cell.address for cell in found}) == 1


DATA = 'datasets = ["data/*"]\n'


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("datasets = [", "plan.toml is not a TOML file"),
        ("seeds = [1]", "plan.toml: the setting datasets is missing"),
        ("datasets = []", "datasets is empty"),
        ('datasets = ["date/*"]', "no dataset is at .*date/.; correct the pattern 'date/.'"),
        (f"{DATA}seeds = [1, 1]", r"seeds is \[1, 1\], the same twice"),
        (f'{DATA}methods = ["sar-gz"]', "no method 'sar-gz'"),
        (f'{DATA}preset = "fast"', "preset 'fast' is unknown"),
        (f"{DATA}[settings]\nseed = 1", "give seeds"),
        (f"{DATA}[settings]\nrates.mean = 1", "'rates.mean' is unknown; did you mean rates.means?"),
        (f"{DATA}[settings]\niterations = []", "iterations is an empty list"),
        (f"{DATA}[settings]\niterations = [5, 0]", "iterations is 0"),
        (f"{DATA}[[parts]]\nseed = [1]", r"parts\[0\]: the setting 'seed' is unknown"),
        (f'{DATA}methods = ["sar-nerf"]\n[settings]\ngaussians = 9', "settings of sar-nerf: .* 'gaussians' is unknown"),
    ],
)
def test_mistakes_are_one_sentence(place, text, complaint):
    with pytest.raises(SarsplatError, match=complaint) as refused:
        cells(place, text)
    assert "\n" not in str(refused.value)


# ---- stale runs ------------------------------------------------------------------------------------------------------
GS, DSR = ((cell.TRAINING, f"sarsplat.{name}") for name in ("learning.method_sar_gs", "baselines.method_dsr"))


def rooms(modules: dict[str, Path]) -> set[str]:
    return {name.split(".")[1] for name in modules if name.count(".")}


def test_training_depends_on_what_it_imports_and_on_nothing_else():
    ours, theirs = cell.imported_by(GS), cell.imported_by(DSR)
    assert not rooms(ours) & {"cli", "report", "viewer", "evaluation", "exports", "sweeps", "radar", "importers"}
    assert {"renderer", "geometry", "gaussians", "data", "learning", "runs", "surface"} <= rooms(ours)
    assert "baselines" not in rooms(ours)
    assert not {"sarsplat.baselines.method_sar_nerf", "sarsplat.learning.method_sar_gs"} & theirs.keys()
    assert "sarsplat.baselines.method_dsr" in theirs
    assert {"evaluation", "runs"} <= rooms(cell.imported_by([cell.SCORING]))


def test_modules_that_are_found_by_their_place_are_seen():
    found = cell.imported_by(GS)
    for folder in ("learning/parts", "learning/strategies", "geometry/responses"):
        files = {path for path in found.values() if path.parent.match(folder)}
        assert files == {*next(iter(files)).parent.glob("*.py")}, folder


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], str]:
    """Writes a module of a package and says what the package's code is."""
    (tmp_path / "foreign").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    caches = ("code", "_file", "_nodes", "_imports", "_statements", "_lazy")
    for name in caches:  # ours is read once for all tests
        monkeypatch.setattr(cell, name, cache(getattr(cell, name).__wrapped__))

    def written(name: str, text: str) -> str:
        (tmp_path / "foreign" / f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        for cached in caches:
            getattr(cell, cached).cache_clear()
        return cell.code(("foreign.method",), "cpu")

    written("__init__", "")
    return written


def test_code_is_what_it_does_and_not_its_words(code):
    first = code("method", '"""Words."""\nfrom foreign import used\n\ndef f():\n    """More."""\n    return 1  # why\n')
    used = code("used", "x = 1\n")
    assert used != first
    assert code("unused", "y = 1\n") == used
    assert code("method", "from foreign import used\ndef f():\n    return 1\n") == used
    assert code("method", "from foreign import used\ndef f():\n    return 2\n") != used
    said = code("method", "def f(x):\n    warn(f'{x} is odd')\n    raise ValueError('no ' + x)\n")
    assert code("method", "def f(x):\n    warn(f'{x} is new')\n    raise ValueError('never ' + x)\n") == said
    assert code("method", "def f(x):\n    warn(f'{x} is odd')\n    raise KeyError('no ' + x)\n") != said
    code("method", "from foreign import used\n")
    assert code("used", "x = 2\n") != used
    other = code("method", "from foreign import unused\n")
    assert code("unused", "y = 2\n") != other


def test_data_and_device_are_part_of_the_address(place):
    plan = Plan(("data/*",))
    before = {one.address for one in cells_of(plan, place)}
    assert not before & {one.address for one in cells_of(replace(plan, device="cuda"), place)}
    same = read_dataset(place / "data" / "box")
    (place / "data" / "box").unlink()
    write_dataset(place / "data" / "moved", same)
    assert {one.address for one in cells_of(plan, place)} == before
    write_dataset(place / "data" / "moved", replace(same, power=same.power * 2), overwrite=True)
    assert not {one.address for one in cells_of(plan, place)} & before


def test_masks_that_a_method_learns_from_are_data(place, tmp_path):
    plan = Plan(("data/*",), ("dsr", "sar-gs"))
    dsr, ours = cells_of(plan, place)
    masked = replace(plan, masks=str(tmp_path / "nowhere"))
    other_dsr, same = cells_of(masked, place)
    assert dsr.address != other_dsr.address
    assert ours.address == same.address
    assert ours.scoring != same.scoring
