"""Coregistered SICDs become one stack: its offsets, signs and heights are those of the antennas."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sarkit")

from sarsplat.cli import main
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import ImageGrid, radar_frame
from sarsplat.importers import import_sicd
from sicds import FREQUENCY, LIGHT, SPOT, Recording, Track, describe, ecef, write_sicd

pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # there is but one view

PLACES = [(0.0, 0.0, 0.0), (6.0, -5.0, 0.0), (-7.0, 5.0, 3.0), (5.0, 7.0, -2.0)]  # m east, north and above the spot
OFFSETS = (0.0, 0.0008, -0.0005)  # rad
SMALL = Recording(rows=100, columns=96)


def write_pass(path: Path, track: Track, recording: Recording) -> Path:
    """A pass whose scatterers have the phases of their ranges, less that of the scene centre point."""
    antenna, centre = ecef(track.position()), ecef(recording.offset)
    _, grid_of = describe(track, recording)
    amplitudes = []
    for place in PLACES:
        farther = math.dist(antenna, ecef(place)) - math.dist(antenna, centre)
        own = farther - grid_of(ecef(place))[0]  # `write_sicd` gives it the phase of its place in the image
        amplitudes.append(np.exp(recording.sign * 4j * np.pi * FREQUENCY / LIGHT * own))
    return write_sicd(path, track, PLACES, recording, amplitudes)


def passes(folder: Path, first: Track, recording: Recording, offsets=OFFSETS) -> list[Path]:
    """One file for each offset; the later ones lie on the grid of the first."""
    files = []
    for number, offset in enumerate(offsets):
        track = replace(first, grazing=first.grazing + math.degrees(math.atan(offset)))
        own = recording if number == 0 else replace(recording, coregistered_to=first)
        files.append(write_pass(folder / f"{number}.nitf", track, own))
    return files


def imported(folder: Path, files: list[Path], **options) -> Dataset:
    options = {"around": SPOT, "looks": None, "ground": False, "size_m": 26.0, "stack": True} | options
    return import_sicd(files, folder / "set", overwrite=True, **options)


@pytest.mark.parametrize(
    ("track", "recording"),
    [
        (Track(90.0, 35.0), SMALL),
        (Track(200.0, 50.0, "L"), replace(SMALL, sign=1)),
        (Track(10.0, 40.0), replace(SMALL, turn=10, offset=(3.0, -2.0, 1.5), rows=120, columns=120)),
        (Track(10.0, 40.0), replace(SMALL, kind="RGZERO", offset=(3.0, -2.0, 1.5))),
        (Track(120.0, 45.0, distance=4e3), replace(SMALL, offset=(0.0, 3.0, 0.0))),
        (Track(90.0, 35.0, squint=15.0), replace(SMALL, rows=140, columns=140)),
        (Track(90.0, 35.0, "L", climb=10.0), replace(SMALL, rows=140, columns=140)),
    ],
    ids=["slant", "left, other sign", "turned, elsewhere", "zero Doppler", "near", "tilted", "left, tilted"],
)
def test_phases_are_those_of_heights_above_the_spot(tmp_path, track, recording):
    tilted = bool(track.squint or track.climb)
    made = imported(tmp_path, passes(tmp_path, track, recording), tilted=tilted)
    [stack], [view], grid = made.stacks, made.views, made.grid
    assert (abs(view.tilt_deg) > 8) == tilted
    across = math.cos(math.radians(view.tilt_deg))  # of the baseline, along the tilted elevation axis
    assert stack.offsets_rad == pytest.approx([across * offset for offset in OFFSETS], abs=4e-7 if tilted else 2e-8)
    assert stack.offsets_rad[0] == 0
    assert stack.wavelength_m == pytest.approx(LIGHT / FREQUENCY)
    assert (stack.transmit, stack.polarisations) == ("each", ("VV",) * 3)
    assert view.grazing_deg == pytest.approx(track.grazing)
    assert read_dataset(tmp_path / "set").fingerprint() == made.fingerprint()
    numbers = stack.elevation_numbers(view)
    for place in PLACES:
        azimuth, _, away = radar_frame(view) @ place
        row, column = np.abs(grid.range_m - away).argmin(), np.abs(grid.azimuth_m - azimuth).argmin()
        here = ImageGrid(1, 1, grid.spacing_m, grid.resolution_m, (azimuth, away))
        for n in (1, 2):
            pair = made.signal[0, n, row, column] * made.signal[0, 0, row, column].conj()
            k_z = (numbers[n] - numbers[0]) / view.look.height_per_elevation
            expected = k_z * place[2] + stack.plane_phases(view, here)[n, 0, 0]
            off = np.angle(pair * np.exp(-1j * expected))
            assert off == pytest.approx(0, abs=0.08 if tilted else 0.05 if track.distance < 1e5 else 0.02)


def test_polarisations_of_one_pass(tmp_path):
    files = []
    for number, name in enumerate(("H:H", "V:H", "V:V")):  # transmitted, received
        files.append(write_pass(tmp_path / f"{number}.nitf", Track(), replace(SMALL, polarisation=name)))
    made = imported(tmp_path, files)
    assert made.stacks[0].polarisations == ("HH", "HV", "VV")
    assert made.stacks[0].offsets_rad == (0.0, 0.0, 0.0)
    assert made.polarimetric
    np.testing.assert_array_equal(made.signal[0, 0], made.signal[0, 2])


def test_other_polarisations_of_views_are_said(tmp_path):
    files = [
        write_pass(tmp_path / f"{k}.nitf", Track(90.0 * k), replace(SMALL, polarisation=name))
        for k, name in enumerate(("V:V", "H:V"))
    ]
    with pytest.warns(SarsplatWarning, match="polarisations differ"):
        made = imported(tmp_path, files, stack=False, size_m=20.0)
    assert any("polarisations differ (H:V, V:V), but are taken" in text for text in made.source["assumptions"])


def test_what_is_refused(tmp_path):
    first, second, _ = files = passes(tmp_path, Track(), SMALL)
    other = write_pass(tmp_path / "other.nitf", Track(grazing=36.0), SMALL)
    turned = write_pass(tmp_path / "turned.nitf", Track(), replace(SMALL, turn=2.0))
    large = write_pass(tmp_path / "large.nitf", Track(), replace(SMALL, rows=110))
    same = write_pass(tmp_path / "same.nitf", Track(), SMALL)
    circular = write_pass(tmp_path / "circular.nitf", Track(), replace(SMALL, polarisation="S:E"))
    data = second.read_bytes()
    tuned = tmp_path / "tuned.nitf"
    tuned.write_bytes(data.replace(b"<MinProc>9300000000.0", b"<MinProc>9200000000.0"))
    for paths, words in (
        ([first], "is one file; a stack needs several"),
        ([first, other], r"other.nitf has another grid than .*0.nitf: .* corners up to .* m apart; coregister"),
        ([first, turned], r"turned.nitf has another grid"),
        ([first, large], r"large.nitf has another grid than .*: \(110, 96\) and \(100, 96\) pixels"),
        ([first, same], r"0.nitf, same.nitf are no stack: offsets_rad is .*, where two passes are the same"),
        ([first, circular], r"are no stack: a polarisation is 'S:E' \(transmitted, received\); give files of H, V"),
        ([first, tuned], r"are no stack: centre frequencies are 9.55 to 9.6 GHz; give files of one"),
    ):
        with pytest.raises(SarsplatError, match=words):
            imported(tmp_path, paths)
        assert not (tmp_path / "set").exists()
    assert len(imported(tmp_path, files, stack=False)) == 3


@pytest.mark.usefixtures("undrawn")
def test_the_command(tmp_path, capsys):
    files = passes(tmp_path, Track(), SMALL)
    words = ["import", "sicd", *map(str, files), "--size", "32m", "--out", str(tmp_path / "set"), "--stack"]
    main(words)
    told = capsys.readouterr().out
    assert "1 view of 3 channels" in told
    assert "assumed: the files are coregistered to the grid of the first" in told
    assert "polarisations differ" not in told
