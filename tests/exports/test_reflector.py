"""A corner reflector in SICDs comes out of a LAS file where the SICDs' own projection has it."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sarkit")
pytest.importorskip("laspy")
pytest.importorskip("pyproj")

import laspy
import pyproj
import sarkit.sicd
import sarkit.wgs84
from sarkit.sicd import projection

from made import upright
from made_runs import with_points
from sarsplat import Dataset, Run, SarsplatWarning, View, export, import_sicd, preset, reconstruct
from sarsplat.importers.sicd_file import read_sicd
from sicds import SPOT, Recording, Track, axes, ecef, write_sicd

pytestmark = pytest.mark.filterwarnings("ignore:.*_text is deprecated:DeprecationWarning")  # sarkit reads its schemas

CORNER = (6.0, -4.0, 1.5)  # m east, north and above the spot
HEIGHT = float(sarkit.wgs84.cartesian_to_geodetic(ecef(CORNER))[2])
TRACKS = [Track(20.0, 35.0, "R"), Track(140.0, 45.0, "L"), Track(260.0, 40.0, "R")]


def imported(folder: Path, squint_deg: float = 0.0, tracks: Sequence[Track] = TRACKS) -> tuple[Dataset, np.ndarray]:
    """A dataset, x towards north-east, and where on earth the files say that the reflector is."""
    tracks = [replace(track, squint=squint_deg) for track in tracks]
    files = [write_sicd(folder / f"{k}.nitf", track, [CORNER], Recording()) for k, track in enumerate(tracks)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SarsplatWarning)
        made = import_sicd(
            files,
            folder / "set",
            size_m=24.0,
            around=SPOT,
            heading_deg=45.0,
            tilted=squint_deg > 0,
            looks=None,
            ground=False,
        )
    return made, np.array([projected(path) for path in files])


def projected(path: Path) -> np.ndarray:
    """The brightest place of a SICD, projected by sarkit to the height of the reflector, ECEF."""
    with path.open("rb") as file, sarkit.sicd.NitfReader(file) as reader:
        image = np.abs(reader.read_image())
    pixel = peak(image)
    sicd = read_sicd(path)
    seen = projection.compute_projection_sets(sicd.projection, sicd.place_of(pixel))
    ground, _, _ = projection.r_rdot_to_constant_hae_surface(
        sicd.projection.LOOK, sicd.projection.SCP, seen, HEIGHT, delta_hae_max=1e-3, nlim=20
    )
    return np.squeeze(ground)


def peak(image: np.ndarray) -> np.ndarray:
    """Row and column of the brightest place, by parabolas."""
    at = np.unravel_index(image.argmax(), image.shape)
    found = []
    for axis in (0, 1):
        line, k = image.take(at[1 - axis], axis=1 - axis), at[axis]
        before, here, after = line[k - 1 : k + 2]
        found.append(k + (before - after) / (2 * (before - 2 * here + after)))
    return np.array(found)


def las_of(run: Run, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """ECEF of the points of a LAS file, by the system that it states, and their γ⁰."""
    export(run, path)
    read = laspy.read(path)
    system = read.header.parse_crs()
    assert system.to_2d().to_epsg() == 32632
    back = pyproj.Transformer.from_crs(system.to_2d(), "EPSG:4326", always_xy=True)
    longitude, latitude = back.transform(read.x, read.y)
    return sarkit.wgs84.geodetic_to_cartesian(np.column_stack([latitude, longitude, read.z])), read["gamma0"]


@pytest.mark.parametrize("squint_deg", [0.0, 12.0], ids=["level", "tilted"])
def test_a_reflector_found_in_the_images(tmp_path: Path, squint_deg: float) -> None:
    """By the frames of the views alone: least squares of its azimuths and ranges."""
    dataset, truth = imported(tmp_path, squint_deg)
    assert any(view.tilt_deg for view in dataset.views) == (squint_deg > 0)
    grid, rows, seen = dataset.grid, [], []
    for image, view in zip(dataset.power, dataset.views, strict=True):
        row, column = peak(np.sqrt(image))
        seen += [grid.azimuth_m[0] + column * grid.spacing_m[0], grid.range_m[0] + row * grid.spacing_m[1]]
        rows.append(view.look.gradients)
    place = np.linalg.lstsq(np.concatenate(rows), np.array(seen), rcond=None)[0]
    run = Run.from_gaussians(upright(place[None]), views=[View(0.0, 40.0)])
    run = with_points(run, [place], [[0.0, 0.0, 1.0]], [1.0], place=dataset.place)
    found, _ = las_of(run, tmp_path / "a.las")
    assert np.abs((truth - ecef(CORNER)) @ axes()[:2].T).max() < 0.1  # parabolas are no more exact
    off = (found - truth.mean(axis=0)) @ axes().T
    assert np.hypot(*off[0, :2]) < 0.1
    assert abs(off[0, 2]) < 0.1


@pytest.mark.slow
def test_a_reflector_that_was_reconstructed(tmp_path: Path) -> None:
    """The mean of the points of three trainings, by the square of their brightness, which ghosts have little of."""
    around = [Track(20.0 + 60 * k, (35.0, 45.0, 40.0)[k % 3], "RL"[k % 2]) for k in range(6)]
    dataset, truth = imported(tmp_path, tracks=around)
    off = []
    for seed in range(3):  # each scatters by a third of a cell
        run = reconstruct(dataset, replace(preset("quick"), seed=seed), quiet=True)
        found, gamma0 = las_of(run, tmp_path / f"{seed}.las")
        off.append(np.average((found - truth.mean(axis=0)) @ axes().T, axis=0, weights=gamma0.astype(float) ** 2))
    assert np.hypot(*np.mean(off, axis=0)[:2]) < 0.2
