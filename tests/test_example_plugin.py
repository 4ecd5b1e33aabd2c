"""The example of a plugin: installed as a package of its own, its importer and its format of exports are commands."""

from __future__ import annotations

import os
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

from programs import ROOT, python

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


def sarsplat(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    return python("-m", "sarsplat", *words, cwd=site.parent, env={**os.environ, "PYTHONPATH": path})


def test_the_example_imports_and_exports(site: Path, tmp_path: Path) -> None:
    power = np.random.default_rng(0).gamma(1.0, size=(4, 24, 24)).astype(np.float32)
    power[:, 10:14, 10:14] *= 50
    np.savez(tmp_path / "box.npz", power=power, azimuth_deg=np.arange(4) * 90.0, grazing_deg=np.full(4, 40.0))
    for given in ("box.npz", tmp_path):
        done = sarsplat(site, "info", given)
        assert "box.npz --spacing METRES --out DIR" in done.stdout, done.stderr
    done = sarsplat(site, "import", "arrays", "box.npz", "--out", "box", "--spacing", "0.3")
    assert done.returncode == 0, done.stderr
    assert "assumed: row 0 is near range" in done.stdout
    done = sarsplat(site, "reconstruct", "box", "--out", "run", "--preset", "quick", "--iterations", "20")
    assert done.returncode == 0, done.stderr
    done = sarsplat(site, "export", "run", "points.csv")
    assert "open points.csv with any spreadsheet" in done.stdout, done.stderr
    assert (tmp_path / "points.csv").read_text().startswith("x,y,z\n")


def test_the_example_is_listed(site: Path) -> None:
    assert "arrays" in sarsplat(site, "import", "--help").stdout
    assert ".csv" in sarsplat(site, "export", "run", "points.xlsx").stderr


def test_a_broken_plugin_is_named_and_the_others_work(site: Path, tmp_path: Path) -> None:
    (site / "sarsplat_example.py").write_text("import nothing_that_exists\n")
    done = sarsplat(site, "import", "folder", tmp_path, "--out", "out")
    assert done.returncode == 2
    assert done.stderr.startswith("warning: the plugin arrays of sarsplat.importers cannot be imported from")
    assert "error: " in done.stderr
    assert "warning" not in sarsplat(site, "check", tmp_path).stderr
