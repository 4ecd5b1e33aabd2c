"""What may be a mistake is one line on stderr, and the work goes on."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from chip_files import write_chips
from made_imports import rewrite
from sarsplat.cli import main
from sarsplat.data import read_dataset
from sarsplat.errors import SarsplatWarning


@pytest.fixture(autouse=True)
def warnings_are_shown() -> Iterator[None]:
    """As outside of tests, where no warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("default", SarsplatWarning)
        yield


def test_importing_counts_what_lacks_labels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of six chips the last has no azimuth, and one more has no label."""
    labels = write_chips(tmp_path, [("T72", "132", 17, 70 * k if k < 5 else "") for k in range(7)])
    rewrite(labels, lambda rows: rows[:-1])
    command = ["import", "mstar", str(tmp_path), "--labels", str(labels), "--class", "T72"]
    assert main([*command, "--train-views", "1", "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr()
    lines = told.err.splitlines()
    assert [line.startswith("warning: ") for line in lines] == [True, True, True]
    assert "has no label for 1 JPEG" in lines[0]
    assert "empty fields for 1 of 6 chips (the first: target_az_deg in line 7)" in lines[1]
    assert "one training view (azimuth 0°)" in lines[2]
    assert "5 views (1 train, 4 test-17)" in told.out
    assert len(read_dataset(tmp_path / "out").views) == 5


def test_radians_are_simulated_as_the_degrees_they_are_called(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulate", "--target", "t72", "--azimuth", "0:6.28:1.57", "--grazing", "0.3", "--pixels", "8"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    (line, *_) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: the azimuths (0° to 4.71°) and grazing angles (0.3° to 0.3°) look like radians")
    assert [view.azimuth_deg for view in read_dataset(tmp_path / "out").views] == [0, 1.57, 3.14, 4.71]


@pytest.mark.parametrize(("grazing", "uncertain"), [("15", True), ("60", False)])
def test_an_uncertain_shape_is_called_so_before_and_after(
    box: Path, grazing: str, uncertain: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    simulate = ["simulate", "--mesh", str(box / "box.obj"), "--azimuth", "0:360:45", "--grazing", grazing]
    assert main([*simulate, "--pixels", "16", "--out", str(tmp_path / "ring")]) == 0
    capsys.readouterr()
    train = ["reconstruct", str(tmp_path / "ring"), "--iterations", "20", "--gaussians", "200"]
    train += ["--points.voxel", "0.3", "--points.rays-per-pixel", "2"]
    assert main([*train, "--out", str(tmp_path / "run")]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(told) == (2 if uncertain else 0)
    if uncertain:
        assert "so the shape is uncertain; add views at other grazing angles" in told[0]
        assert "the shape in" in told[1]
        assert "is uncertain: the weakest direction of its views is 77° above the horizon" in told[1]
