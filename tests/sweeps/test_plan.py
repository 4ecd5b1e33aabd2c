"""A plan means every combination of what it lists, and says in one sentence what is wrong with it."""

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from programs import ROOT
from sarsplat import SarsplatError, preset
from sarsplat.sweeps import Plan
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
    assert (first.seed, first.config["seed"], first.config["rates"]["means"], first.config["iterations"]) == (
        4,
        4,
        0.1,
        10,
    )
    assert first.config["points"]["voxel"] == 0.5
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
