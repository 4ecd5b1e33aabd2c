"""The example of a plugin: installed as a package of its own, its importer and its format of exports are commands."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from programs import ROOT
from sarsplat.cli import main

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


FEW = "--preset quick --iterations 5 --points.voxel 0.3 --points.rays-per-pixel 2"


def test_the_example_imports_and_exports(site: Path, tmp_path: Path, beside, capsys) -> None:
    power = np.random.default_rng(0).gamma(1.0, size=(4, 24, 24)).astype(np.float32)
    power[:, 10:14, 10:14] *= 50
    np.savez(tmp_path / "box.npz", power=power, azimuth_deg=np.arange(4) * 90.0, grazing_deg=np.full(4, 40.0))
    done = beside(
        site,
        "info box.npz",
        "info .",
        "import arrays box.npz --out box --spacing 0.3",
        f"reconstruct box --out run {FEW}",
        "export run points.csv",  # what its module was first loaded for does not matter
        "export run points.xlsx",
    )
    file, folder, imported, reconstructed, exported, _ = (out for _, out, _ in done)
    assert [code for code, _, _ in done] == [0, 0, 0, 0, 0, 2]
    for told in (file, folder):
        assert "import with: sarsplat import arrays" in told
    assert "assumed: row 0 is near range" in imported
    assert "wrote run" in reconstructed
    assert "open points.csv with any spreadsheet" in exported
    assert done[-1][1] == ""
    assert ".csv" in done[-1][2]
    with pytest.raises(SystemExit):
        main(["import", "--help"])
    assert "arrays" in capsys.readouterr().out
    assert (tmp_path / "points.csv").read_text().startswith("x,y,z\n")


@pytest.mark.filterwarnings("default::sarsplat.SarsplatWarning")
def test_a_broken_plugin_is_named_and_the_others_work(site: Path, beside, capsys) -> None:
    (site / "sarsplat_example.py").write_text("import nothing_that_exists\n")
    (first, _, worked), (second, _, broken) = beside(site, "import folder . --out out", "import arrays box.npz")
    assert (first, second) == (2, 2)
    assert worked.startswith("error: ")
    assert "plugin" not in worked
    named = "the plugin arrays of sarsplat.importers cannot be imported from"
    assert broken.startswith(f"error: {named}")
    with pytest.raises(SystemExit):
        main(["import", "--help"])
    shown = capsys.readouterr()
    assert "phase-history" in shown.out
    assert shown.err.startswith(f"warning: {named}")
