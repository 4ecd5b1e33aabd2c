"""A run is stale when what it depends on has changed, and only then."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from sarsplat import read_dataset, write_dataset
from sarsplat.sweeps import Plan, cell
from sarsplat.sweeps.cell import cells_of

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
