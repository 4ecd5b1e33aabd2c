"""Settings on the command line: a preset or a file gives them, and flags override them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import trimesh

from sarsplat import Config, Run
from sarsplat.cli import main
from sarsplat.reconstruction.config import Densification, Surroundings
from sarsplat.reconstruction.presets import PRESETS


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with datasets of a box on nothing, the same in speckle, and a box on the ground."""
    folder = tmp_path_factory.mktemp("settings")
    trimesh.creation.box(extents=(2.4, 1.2, 1.0)).apply_translation((0, 0, 0.5)).export(folder / "box.obj")
    simulate = ["simulate", "--mesh", str(folder / "box.obj"), "--azimuth", "0:360:120", "--grazing", "45"]
    assert main([*simulate, "--pixels", "16", "--out", str(folder / "plain")]) == 0
    assert main([*simulate, "--pixels", "16", "--looks", "4", "--out", str(folder / "speckled")]) == 0
    assert main([*simulate, "--pixels", "16", "--ground", "0.1", "--out", str(folder / "ground")]) == 0
    return folder


@pytest.fixture(autouse=True)
def there(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)


def printed(words: str, capsys: pytest.CaptureFixture[str], dataset: str = "plain") -> dict[str, Any]:
    capsys.readouterr()
    assert main(["reconstruct", dataset, "--out", "nowhere", *words.split(), "--print-config"]) == 0
    assert not Path("nowhere").exists()
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert data["method"] == "sar-gs"
    return data["config"]


def refused(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main(words.split()) == 2
    complaint = capsys.readouterr().err
    assert complaint.count("\n") == 1
    return complaint


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_alone(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert Config.from_dict(printed(f"--preset {name}", capsys)) == PRESETS[name]


@pytest.mark.parametrize(("dataset", "name"), [("plain", "default"), ("speckled", "speckled"), ("ground", "measured")])
def test_the_preset_that_fits_the_images(dataset: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert printed("", capsys, dataset)["preset"] == name
    assert printed("--seed 4", capsys, dataset) == {
        **PRESETS[name].as_dict(),
        "scale_bounds": [*PRESETS[name].scale_bounds],
        "seed": 4,
        **parts(name),
    }


def parts(name: str) -> dict[str, Any]:
    """The parts of a preset as JSON has them: lists, not tuples."""
    return {key: json.loads(json.dumps(value)) for key, value in PRESETS[name].as_dict().items() if key != "seed"}


def test_flags_override_the_preset_even_with_the_values_that_help_shows(capsys: pytest.CaptureFixture[str]) -> None:
    flags = "--preset paper --views-per-step 8 --rates.means .02 --scale-bounds 0.02 0.2 --points.method rays"
    changed = printed(f"{flags} --points.cluster-radius 0.5 --densification.every=7", capsys)
    expected = json.loads(json.dumps(PRESETS["paper"].as_dict()))
    expected |= {"views_per_step": 8, "scale_bounds": [0.02, 0.2]}
    expected["rates"]["means"] = 0.02
    expected["points"] |= {"method": "rays", "cluster_radius": 0.5}
    expected["densification"]["every"] = 7
    assert changed == expected


@pytest.mark.parametrize(
    ("words", "densification"),
    [
        ("", None),
        ("--densification on", Densification()),
        ("--densification.max-gaussians 60000", Densification()),
        ("--densification.start 5", Densification(start=5)),
        ("--preset paper", Densification()),
        ("--preset paper --densification off", None),
    ],
)
def test_density_control(words: str, densification: Densification | None, capsys: pytest.CaptureFixture[str]) -> None:
    assert Config.from_dict(printed(words, capsys)).densification == densification


def test_surroundings(capsys: pytest.CaptureFixture[str]) -> None:
    on = Config.from_dict(printed("--surroundings.noise-floor 0.5", capsys)).surroundings
    assert on == Surroundings(noise_floor=0.5)
    assert printed("--surroundings off", capsys, "ground")["surroundings"] is None
    complaint = refused("reconstruct plain --out new --surroundings off --surroundings.noise-floor 1", capsys)
    assert "--surroundings.noise-floor has no effect with --surroundings off" in complaint


def test_a_printed_configuration_is_read_back(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    first = printed("--preset measured --gaussians 30 --densification.start 3", capsys)
    (tmp_path / "mine.json").write_text(json.dumps(first))
    assert printed(f"--config {tmp_path / 'mine.json'}", capsys) == first
    assert printed(f"--config {tmp_path / 'mine.json'} --gaussians 31", capsys) == {**first, "gaussians": 31}
    assert "give only one" in refused(
        f"reconstruct plain --out new --config {tmp_path}/mine.json --preset paper", capsys
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{", "mine.json is not valid JSON"),
        ("3", "mine.json: expected `object`, got `int`"),
        ('{"iteratons": 5}', "mine.json: the setting 'iteratons' is unknown; did you mean iterations?"),
        (json.dumps({**PRESETS["default"].as_dict(), "p_min": "x"}), "mine.json: p_min is 'x'; it must be a number"),
    ],
)
def test_a_file_that_is_no_configuration(
    text: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.json").write_text(text)
    assert told in refused(f"reconstruct plain --out new --config {tmp_path / 'mine.json'}", capsys)


def test_a_run_is_resumed_and_extended_with_its_own_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(f"reconstruct plain --out {run} --iterations 2 --gaussians 40 --seed 7".split()) == 0
    resume = f"reconstruct plain --out {run} --resume"
    assert main(resume.split()) == 0
    assert main(f"{resume} --iterations 4 --seed 7 --preset default".split()) == 0
    extended = Run.load(run)
    assert (extended.iteration, extended.config.iterations, extended.config.gaussians) == (4, 4, 40)
    assert "started with seed 7, not 8" in refused(f"{resume} --iterations 5 --seed 8", capsys)
    assert "started with rates.means 0.067, not 0.5" in refused(f"{resume} --rates.means 0.5", capsys)
    assert "started with preset 'default', not 'paper'" in refused(f"{resume} --preset paper", capsys)
    assert "has already done 4 iterations, more than 3" in refused(f"{resume} --iterations 3", capsys)
    assert Run.load(run).config == extended.config
