"""Geocoded images are recognised without tags, and images in azimuth and range are not taken for such."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from test_contradictions import with_views

from geocoded import on_map
from made import dataset_of, lorry
from sarsplat import ScatteringLaw, add_speckle, import_folder, import_mstar, simulate_raycast
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatWarning
from sarsplat.examination.contradictions import examine
from sarsplat.geometry import ImageGrid, View

trimesh = pytest.importorskip("trimesh")

GRID = ImageGrid(64, 60, (0.3, 0.25), (0.4, 0.35))
CHIPS = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
ROUND = tuple(range(0, 360, 30))
TWO_SIDES = (74, 77, 80, 83, 86, 89, 92, 270, 273, 276, 279, 282, 285)


def cylinder():
    """The same from all sides."""
    made = trimesh.creation.cylinder(1.2, 2.5, sections=180)
    made.apply_translation([0, 0, 1.25])
    return made


@cache
def simulated(target, azimuths: tuple[int, ...], looks: float | None, grazings: tuple[float, ...] = (35.0,)) -> Dataset:
    views = [View(float(azimuth), grazing) for azimuth in azimuths for grazing in grazings]
    options = {"ground_gamma0": 0.05, "ray_spacing": 0.08}
    power = np.stack([simulate_raycast(target(), view, GRID, ScatteringLaw(), **options) for view in views])
    if looks is not None:
        power = add_speckle(power, looks, np.random.default_rng(0))
    return dataset_of(GRID, [(view, "train") for view in views], power, ground=True, looks=looks)


def geocoded(dataset: Dataset) -> Dataset:
    """What an import without a word of it would make of its images on a map."""
    pitch = max(dataset.grid.spacing_m)
    sizes = (dataset.grid.rows, dataset.grid.columns)
    side = int(min(np.multiply(sizes, dataset.grid.spacing_m[::-1])) / pitch)
    power = [on_map(image, view, dataset.grid, side, pitch) for image, view in zip(dataset.power, dataset.views)]
    grid = ImageGrid(side, side, (pitch, pitch), (0.4, 0.4))
    floor = 1e-5 * float(dataset.power.mean())
    return replace(dataset, grid=grid, power=np.maximum(np.stack(power), floor), signal=None)


def called_geocoded(dataset: Dataset) -> bool:
    return any(text.startswith("the images seem to be geocoded") for text in examine(dataset).contradictions)


@pytest.mark.parametrize("looks", [None, 1.0])
@pytest.mark.parametrize(
    ("target", "azimuths", "grazings"),
    [
        (lorry, ROUND, (35.0,)),
        (lorry, ROUND, (20.0, 50.0)),
        (lorry, tuple(range(0, 360, 15)), (35.0,)),
        (lorry, tuple(range(0, 360, 45)), (35.0,)),
        (lorry, TWO_SIDES, (35.0,)),
        (cylinder, ROUND, (35.0,)),
    ],
)
def test_by_what_stays_and_what_turns(target, azimuths, grazings, looks) -> None:
    radar = simulated(target, azimuths, looks, grazings)
    assert not called_geocoded(radar)
    assert called_geocoded(geocoded(radar))


def test_azimuths_from_elsewhere_or_the_other_way() -> None:
    radar = simulated(lorry, ROUND, 1.0)
    for sign, offset in ((1, 40.0), (-1, 0.0)):
        for dataset, expected in ((radar, False), (geocoded(radar), True)):
            views = [replace(view, azimuth_deg=sign * view.azimuth_deg + offset) for view in dataset.views]
            assert called_geocoded(with_views(dataset, views)) == expected


def test_the_import_says_it_and_its_remedy_mends_it(tmp_path: Path) -> None:
    """Pictures without tags, as tables of bearings; of headings that are taken for these, the check tells."""
    radar = simulated(lorry, ROUND, 1.0)
    rows = []
    for number, (image, view) in enumerate(zip(radar.power, radar.views, strict=True)):
        np.save(tmp_path / f"{number}.npy", on_map(image, view, radar.grid, 60, 0.3))
        rows.append((f"{number}.npy", (view.azimuth_deg + 90) % 360, view.grazing_deg))

    def contradictions(**options) -> list[str]:
        lengths = {"spacing_m": (0.3, 0.3), "resolution_m": (0.4, 0.35)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SarsplatWarning)  # which say the same
            made = import_folder(tmp_path, tmp_path / "out", quantity="power", overwrite=True, **lengths, **options)
        return made.source.get("contradictions", [])

    lines = [f"{name},{bearing},{grazing}" for name, bearing, grazing in rows]
    (tmp_path / "t.csv").write_text("\n".join(["file,azimuth,grazing", *lines]))
    (said,) = contradictions()
    assert "import them with geocoded='level', or" in said
    assert contradictions(geocoded="level") == []
    lines = [f"{name},{(bearing + 90) % 360},{grazing}" for name, bearing, grazing in rows]
    (tmp_path / "t.csv").write_text("\n".join(["file,direction,grazing", *lines]))
    (said,) = contradictions(geocoded="level", columns={"azimuth": "direction"})
    assert "(`columns={'heading': 'NAME'}` look='right')" in said
    (tmp_path / "t.csv").write_text("\n".join(["file,heading,grazing", *lines]))
    assert contradictions(geocoded="level", look="right") == []
    for name, _, _ in rows:  # an interpolation that averages
        np.save(tmp_path / name, gaussian_filter(np.load(tmp_path / name), 0.5))
    (said,) = contradictions(geocoded="level", look="right")
    assert (match := re.search(r"interpolated to the map \(`looks=(\S+)`\), or square the values", said))
    assert contradictions(geocoded="level", look="right", looks=float(match[1])) == []


@pytest.mark.skipif(not CHIPS.is_dir(), reason="no measured chips")
@pytest.mark.filterwarnings("ignore:.* hold the largest value of their image")
def test_measured_chips(tmp_path: Path) -> None:
    chips = import_mstar(
        CHIPS, tmp_path / "out", labels=CHIPS / "labels.csv", target_class="T72", train_views=18, test=False
    )
    assert not called_geocoded(chips)
    assert called_geocoded(geocoded(chips))
