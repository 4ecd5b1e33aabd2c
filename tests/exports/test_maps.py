"""Maps of a run, read back by GDAL through rasterio."""

import math
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made import FEW_POINTS, upright
from made_runs import at, with_points
from sarsplat import Dataset, Place, Run, SarsplatError, View, preset, reconstruct
from sarsplat.cli import main
from sarsplat.data.geotiff import Raster, write_raster
from sarsplat.data.terrain_file import read_heights
from sarsplat.exports import export, export_terrain, format_of
from sarsplat.settings.sections import FlatGround

rasterio = pytest.importorskip("rasterio")
pyproj = pytest.importorskip("pyproj")

HALF = np.array([6.0, 3.0, 2.5])
"""Of a block on the ground, m: 12 × 6 m, 5 m high, its middle at (4, −2)."""
MIDDLE = np.array([4.0, -2.0, 2.5])


def points_of_block() -> tuple[np.ndarray, np.ndarray]:
    """Points on the roof and on the walls of the block, 5 cm apart, and their normals."""
    points, normals = [], []
    for axis, side in ((2, 1), (0, 1), (0, -1), (1, 1), (1, -1)):
        a, b = (np.arange(-HALF[k] + 0.025, HALF[k], 0.05) for k in range(3) if k != axis)
        face = np.stack(np.meshgrid(a, b), axis=-1).reshape(-1, 2)
        points.append(np.insert(face, axis, side * HALF[axis], axis=1))
        normals.append(np.tile(side * np.eye(3)[axis], (len(face), 1)))
    return np.concatenate(points) + MIDDLE, np.concatenate(normals)


@pytest.fixture(scope="module")
def block() -> Run:
    run = Run.from_gaussians(upright(np.random.default_rng(0).normal(size=(40, 3))), views=[View(0.0, 40.0)])
    points, normals = points_of_block()
    return with_points(run, points, normals, np.where(normals[:, 2] > 0.5, 0.25, 4.0))


def read(path: Path) -> tuple[Any, np.ndarray]:
    with rasterio.open(path) as file:
        return file.profile, file.read(1, masked=True).filled(np.nan) if file.dtypes[0] == "float32" else file.read(1)


def test_heights_and_brightness_are_of_the_roof_in_the_scenes_own_axes(block: Run, tmp_path: Path) -> None:
    for name, roof in (("dsm", 5.0), ("gamma0", 0.25)):
        said = export(block, tmp_path / f"{name}.tif", pixel_m=0.5)
        profile, values = read(tmp_path / f"{name}.tif")
        assert (profile["dtype"], profile["count"], math.isnan(profile["nodata"])) == ("float32", 1, True)
        assert profile["transform"].a == 0.5
        inside = values[2:-2, 2:-2]
        np.testing.assert_allclose(inside, roof, atol=1e-5)
        left, top = profile["transform"] @ (0, 0)
        assert (left, top) == (pytest.approx(-2, abs=0.51), pytest.approx(1, abs=0.51))  # MIDDLE ∓ HALF
        assert values.shape in ((13, 25), (12, 24), (12, 25), (13, 24))
        assert "in the target's own frame" in said.summary
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.descriptions == ("height of the surface, z of the scene, m",)
        assert "HEIGHTS_ABOVE" not in file.tags()
    assert read_heights(tmp_path / "dsm.tif").place is None


@pytest.mark.parametrize("place", [Place(45.29, 7.5, 312.0), Place(-33.9, 151.2, -12.0, 17.0)])
def test_on_earth_it_lies_where_pyproj_says(block: Run, tmp_path: Path, place: Place) -> None:
    run = at(block, place)
    assert "EPSG:32" in export(run, tmp_path / "dsm.tif", pixel_m=0.25).summary
    corners = [[x, y, 1] for x in (-0.9, 0.9) for y in (-0.9, 0.9)]
    outside = [[1.25, 0, 1], [-1.25, 0, 1], [0, 1.5, 1], [0, -1.5, 1]]
    with rasterio.open(tmp_path / "dsm.tif") as file:
        to_map = pyproj.Transformer.from_crs("EPSG:4978", file.crs.to_wkt(), always_xy=True)
        east, north, _ = to_map.transform(*place.to_ecef(MIDDLE + HALF * np.array(corners + outside)).T)
        found = np.ravel([*file.sample(zip(east, north, strict=True))])  # no data beyond its edges
    np.testing.assert_allclose(found, [place.height_m + 5] * 4 + [np.nan] * 4, atol=0.01)


@pytest.mark.parametrize(
    ("name", "above", "said"),
    [
        ("dsm", "ellipsoid", "the WGS 84 ellipsoid"),
        ("gamma0", "sea level", "sea level"),
        ("layover-shadow", "unknown", "an unknown level"),
    ],
)
def test_a_map_names_the_zero_level_of_its_heights(
    block: Run, tmp_path: Path, name: str, above: Any, said: str
) -> None:
    placed = at(block, Place(45.29, 7.5, 312.0, height_above=above))
    export(placed, tmp_path / "a.tif", name, pixel_m=0.5, view=View(0, 40) if name == "layover-shadow" else None)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.crs.to_epsg() == 32632
        assert file.tags()["HEIGHTS_ABOVE"] == said
        assert file.descriptions == (file.tags()["TIFFTAG_IMAGEDESCRIPTION"],)
        if name == "dsm":
            assert file.units == ("m",)
            assert file.descriptions == (f"height of the surface, above {said}, m",)
    read_back = read_heights(tmp_path / "a.tif")
    assert read_back.place is not None
    assert read_back.place.height_above == read_back.raster.height_above == above
    export_terrain(tmp_path / "a.tif", tmp_path / "b.tif", View(0, 40))
    with rasterio.open(tmp_path / "b.tif") as file:
        assert file.tags()["HEIGHTS_ABOVE"] == said


def test_layover_is_before_the_block_and_shadow_behind_it(block: Run, tmp_path: Path) -> None:
    place = Place(45.29, 7.5, 312.0, 17.0)  # x towards north-north-east
    for run, turn in ((block, 0.0), (at(block, place), 90.0 - 17.0)):
        path = tmp_path / "layover-shadow.tif"
        said = export(run, path, view=View(40.0, 35.0), pixel_m=0.25).summary
        stated = float(said.partition("in the direction ")[2].partition("°")[0])
        assert stated == pytest.approx(130 - turn, abs=1.6)  # the north of the map is not the true one
        profile, classes = read(path)
        assert (profile["dtype"], profile["nodata"]) == ("uint8", 255)
        with rasterio.open(path) as file:
            assert file.colormap(1)[1] != file.colormap(1)[2]
        shadow, layover = (np.argwhere(classes == bit).mean(axis=0) for bit in (1, 2))
        down, right = layover - shadow
        bearing = math.degrees(math.atan2(right, -down))
        assert abs((bearing - (130 - turn) + 180) % 360 - 180) < 12


def test_shares_are_of_what_was_seen_however_far_the_map_goes_on(block: Run, tmp_path: Path) -> None:
    """The block alone was seen: its roof lies over the ground before it along the near edge, and nothing shades it."""
    view = View(0.0, 50.0)
    said = export(block, tmp_path / "layover-shadow.tif", view=view, pixel_m=0.25).summary
    over, shaded = 5.0 * math.tan(math.radians(50.0)), 5.0 / math.tan(math.radians(50.0))  # m along the ground
    share = float(re.search(r"layover on ([0-9.]+)%", said)[1]) / 100  # type: ignore[index]
    assert share == pytest.approx(over / 12, abs=0.05)  # all of its 6 m across
    assert "shadow on 0.0% of what views saw" in said
    assert "level ground at z = 0 (the lowest point of the surface is at 0.0" in said
    layover_m2, shadow_m2 = (float(one) for one in re.findall(r"([0-9.]+) m²", said))
    assert shadow_m2 == pytest.approx(6 * shaded, rel=0.1)
    classes = read(tmp_path / "layover-shadow.tif")[1]
    assert layover_m2 == pytest.approx(np.isin(classes, (2, 3)).sum() * 0.25**2, rel=1e-3)
    heights = Raster(np.zeros((40, 40), np.float32), (0.0, 40.0), (1.0, 1.0))
    heights.values[15:25, 15:25] = 8.0
    heights.values[:2] = np.nan
    write_raster(tmp_path / "a.tif", heights, "m")
    said = export_terrain(tmp_path / "a.tif", tmp_path / "b.tif", view).summary
    classes = read(tmp_path / "b.tif")[1]
    shadow = np.isin(classes, (1, 3)).sum()
    assert f"shadow on {shadow / (38 * 40):.1%} of known heights" in said and f"{shadow:.4g} m² of the whole" in said


def test_a_map_whose_metres_are_half_as_long_shows_the_same_shadows(block: Run, tmp_path: Path) -> None:
    placed = at(block, Place(60.0, 10.0, 100.0))
    shares = {}
    for name, pixel_m, crs in (("utm", 0.25, None), ("mercator", 0.5, "EPSG:3857")):
        view = View(20, 40)
        export(placed, tmp_path / f"{name}.tif", "layover-shadow", pixel_m=pixel_m, crs=crs, view=view)
        shares[name] = np.bincount(read(tmp_path / f"{name}.tif")[1].ravel(), minlength=4)[1:3]
    np.testing.assert_allclose(shares["mercator"], shares["utm"], rtol=0.03)


def test_a_dsm_alone_gives_the_same_classes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    x = np.arange(80) * 0.5
    heights = np.where((abs(x[:, None] - 20) < 5) & (abs(x - 15) < 4), 6.0, 0.0).astype(np.float32)
    heights[:5] = np.nan
    dsm = Raster(heights, (500000.0, 5e6), (0.5, 0.5), pyproj.CRS.from_epsg(32633))
    write_raster(tmp_path / "heights.tif", dsm, "m")
    assert "32% " not in export_terrain(tmp_path / "heights.tif", tmp_path / "a.tif", View(0, 30)).summary
    profile, classes = read(tmp_path / "a.tif")
    assert profile["crs"].to_epsg() == 32633
    assert profile["transform"] == rasterio.Affine(0.5, 0, 500000, 0, -0.5, 5e6)
    assert (classes[:5] == 255).all()
    assert (classes == 1).sum() * 0.25 == pytest.approx(9.5 * 6 / math.tan(math.radians(30)), abs=9.5 * 0.5)
    command = ["export", str(tmp_path / "heights.tif"), str(tmp_path / "layover-shadow.tif")]
    assert main([*command, "--azimuth", "0", "--incidence", "60"]) == 0
    np.testing.assert_array_equal(read(tmp_path / "layover-shadow.tif")[1], classes)
    capsys.readouterr()
    assert main([*command, "--overwrite"]) == 2
    assert "from one direction" in capsys.readouterr().err


def test_learned_ground_has_heights_where_it_was_seen(small_box: Dataset, tmp_path: Path) -> None:
    few = replace(preset("quick"), iterations=25, gaussians=600, points=FEW_POINTS, ground=FlatGround())
    run = reconstruct(small_box, few, quiet=True)
    export(run, tmp_path / "dsm.tif")
    _, values = read(tmp_path / "dsm.tif")
    assert np.nanmedian(values) == 0.0
    assert 0.3 < np.isfinite(values).mean() < 1
    export(run, tmp_path / "gamma0.tif")
    assert np.nanmin(read(tmp_path / "gamma0.tif")[1]) > 0


def test_names_decide_what_a_map_holds_and_what_does_not_fit_is_refused(block: Run, tmp_path: Path) -> None:
    assert format_of(Path("gamma0.tif"))[1] == "gamma0"
    assert format_of(Path("Layover-Shadow.TIF"))[1] == "layover-shadow"
    assert format_of(Path("village-gamma0.tif"))[1] == format_of(Path("a_gamma0.tif"))[1] == "gamma0"
    assert format_of(Path("village layover-shadow.tif"))[1] == "layover-shadow"
    assert format_of(Path("a.tif"))[1] == "dsm"
    assert format_of(Path("gamma0.tif"), "dsm")[1] == "dsm"
    cases: list[tuple[str, dict[str, Any], str]] = [
        ("layover-shadow.tif", {}, "where the radar is; give one direction"),
        ("dsm.tif", {"view": View(0, 30)}, "does not depend on the direction"),
        ("dsm.tif", {"pixel_m": -1.0}, "positive number of metres"),
        ("a.ply", {"pixel_m": 1.0}, "has no pixels"),
        ("dsm.tif", {"crs": "EPSG:32633"}, "has no georeference"),
        ("layover-shadow.tif", {"view": View(0, 30, tilt_deg=9)}, "need a level view"),
        ("layover-shadow.tif", {"view": View(0, 30, aloft=True)}, "aloft"),
        ("layover-shadow.tif", {"view": View(0, 89.999)}, r"takes about .* GiB .*; give a larger `pixel_m`"),
    ]
    for name, given, sentence in cases:
        with pytest.raises(SarsplatError, match=sentence):
            export(block, tmp_path / name, **given)
    aloft = Run.from_gaussians(block.gaussians, views=[View(0.0, 40.0, aloft=True)])
    flying = with_points(aloft, block.points, block.normals, block.points_gamma0)
    with pytest.raises(SarsplatError, match="shows a target aloft"):
        export(flying, tmp_path / "layover-shadow.tif", view=View(0, 30))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("what", "place"), [("dsm", None), ("gamma0", Place(45.0, 7.0, 3.0)), ("layover-shadow", None)]
)
def test_maps_that_do_not_fit_into_memory(
    block: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: Any, place: Place | None
) -> None:
    """What they need is known before, and not much more than what they take."""
    points = np.concatenate([block.points[:500], block.points[:500] + np.array([500, 600, 0], np.float32)])
    run = with_points(block, points, block.normals[:1000], block.points_gamma0[:1000], place=place)
    view = View(45.0, 40.0) if what == "layover-shadow" else None
    needed: list[float] = []
    monkeypatch.setattr("sarsplat.exports.maps.required", lambda _, most, __: needed.append(most))
    tracemalloc.start()
    export(run, tmp_path / "a.tif", what, pixel_m=1.0, view=view)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < max(needed) < 1.6 * peak + 3e8  # of layover and shadow, some hundred places of each line at a time
    monkeypatch.undo()
    (tmp_path / "a.tif").unlink()
    for module in ("sarsplat.memory", "sarsplat.exports.maps"):
        monkeypatch.setattr(f"{module}.free_bytes", lambda: 1e7)
    sentence = r"a map of \d+ × \d+ pixels of 1 m takes about 0.* GiB of memory, and 0.* GiB are free; give a larger"
    with pytest.raises(SarsplatError, match=sentence) as refused:
        export(run, tmp_path / "a.tif", what, pixel_m=1.0, view=view)
    assert list(tmp_path.iterdir()) == []
    if view is None:
        larger = float(str(refused.value).rpartition(" ")[2])
        export(run, tmp_path / "a.tif", what, pixel_m=larger)
