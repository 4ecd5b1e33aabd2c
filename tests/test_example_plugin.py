"""The example of a plugin: installed as a package of its own, its importer and its format of exports are commands."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from programs import ROOT, sarsplat

EXAMPLE = ROOT / "examples" / "plugin"


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with what pip would install."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = tmp_path / "site" / "sarsplat_example_plugin-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = (
        f"[{group}]\n" + "\n".join(f"{name} = {value}" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (info / "entry_points.txt").write_text("\n".join(groups))
    (info.parent / "sarsplat_example.py").write_bytes((EXAMPLE / "sarsplat_example.py").read_bytes())
    return info.parent


def test_the_example_imports_and_exports(site: Path, tmp_path: Path) -> None:
    power = np.random.default_rng(0).gamma(1.0, size=(4, 24, 24)).astype(np.float32)
    power[:, 10:14, 10:14] *= 50
    np.savez(tmp_path / "box.npz", power=power, azimuth_deg=np.arange(4) * 90.0, grazing_deg=np.full(4, 40.0))
    done = sarsplat(
        site,
        "info box.npz",
        "info .",
        "import arrays box.npz --out box --spacing 0.3",
        "reconstruct box --out run --preset quick --iterations 5",
        "import --help",
        "export run points.csv",  # what its module was first loaded for does not matter
        "export run points.xlsx",
    )
    file, folder, imported, reconstructed, listed, exported, refused, _ = re.split(r"code \d\n", done.stdout)
    assert re.findall(r"code (\d)", done.stdout) == [*"0000002"], done.stderr
    for told in (file, folder):
        assert "box.npz --spacing METRES --out DIR" in told
    assert "assumed: row 0 is near range" in imported
    assert "wrote run" in reconstructed
    assert "arrays" in listed
    assert "open points.csv with any spreadsheet" in exported
    assert not refused
    assert ".csv" in done.stderr
    assert (tmp_path / "points.csv").read_text().startswith("x,y,z\n")


def test_a_broken_plugin_is_named_and_the_others_work(site: Path, tmp_path: Path) -> None:
    (site / "sarsplat_example.py").write_text("import nothing_that_exists\n")
    done = sarsplat(site, "import folder . --out out", "import --help", "import arrays box.npz")
    assert re.findall(r"code (\d)", done.stdout) == ["2", "0", "2"]
    assert "phase-history" in done.stdout
    first, second = done.stderr.split("warning: ")
    assert first.startswith("error: ")
    assert "plugin" not in first
    assert second.startswith("the plugin arrays of sarsplat.importers cannot be imported from")
    assert "error: " in second
