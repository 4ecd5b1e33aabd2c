"""What `sarsplat simulate` makes of its options."""

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from made import FEW_POINTS, terrain, write_geotiff
from sarsplat import Run, SarsplatError, View, paper_views, preset, reconstruct
from sarsplat.cli import main
from sarsplat.cli.arguments import angles, views_from
from sarsplat.cli.simulation_options import TestViews, Views
from sarsplat.data import Dataset, read_dataset, read_masks
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR

PAPER_TEST = [(view, split) for view, split in paper_views() if split == "test"]


def chosen(seed: int = 0, **options: Any) -> list[tuple[View, str]]:
    test = TestViews(**{name: options.pop(name) for name in [*options] if name.startswith("test_")})
    return Views(**options).splits(test, seed)


def of(views: list[tuple[View, str]], split: str) -> list[View]:
    return [view for view, name in views if name == split]


def test_random_training_views_lie_between_the_grazing_angles() -> None:
    views = of(chosen(random_views=400), "train")
    assert len(views) == len(set(views)) == 400
    grazings = np.array([view.grazing_deg for view in views])
    assert 15 <= grazings.min() < 16
    assert 73 < grazings.max() <= 75
    # evenly over the sky: half of the sine of the grazing angle halves the views
    middle = math.degrees(math.asin((math.sin(math.radians(15)) + math.sin(math.radians(75))) / 2))
    assert (grazings < middle).mean() == pytest.approx(0.5, abs=0.08)
    azimuths = np.radians([view.azimuth_deg for view in views])
    assert np.hypot(np.cos(azimuths).mean(), np.sin(azimuths).mean()) < 0.15
    assert chosen(1, random_views=12) == chosen(1, random_views=12) != chosen(2, random_views=12)
    narrow = of(chosen(grazing=("20", "40"), random_views=50), "train")
    assert all(20 <= view.grazing_deg <= 40 for view in narrow)
    assert all(view.grazing_deg == 30 for view in of(chosen(incidence=("60",), random_views=5), "train"))


def test_views_are_the_protocol_s_or_own_ones_tested_on_these() -> None:
    assert chosen() == paper_views()
    ring = chosen(azimuth=("0:360:45",), grazing=("45",), test_protocol=True)
    assert of(ring, "train") == [View(float(azimuth), 45.0) for azimuth in range(0, 360, 45)]
    assert ring[8:] == PAPER_TEST
    assert chosen(random_views=12, test_protocol=True)[12:] == PAPER_TEST
    overlapping = chosen(azimuth=("15", "-330"), grazing=("45",), test_protocol=True)
    assert len(of(overlapping, "test")) == 46  # what was trained on is no test


@pytest.mark.parametrize(
    ("words", "degrees"),
    [
        (["30"], [30]),
        (["-7.5", "10"], [-7.5, 10]),
        (["0:360:90"], [0, 90, 180, 270]),
        (["10:0:-5", "3"], [10, 5, 3]),
        (["0:0.3:0.1"], [0, 0.1, 0.2]),  # rounding adds no angle at the stop
        (["0:1:0.4"], [0, 0.4, 0.8]),
    ],
)
def test_angles(words: list[str], degrees: list[float]) -> None:
    assert angles(words, "azimuth") == pytest.approx(degrees)


@pytest.mark.parametrize("word", ["east", "1:2", "0:10:0", "0:10:-1", "0:inf:1", "0:1:1e-9", "", "1:2:3:4"])
def test_what_is_no_angle_is_named(word: str) -> None:
    with pytest.raises(SarsplatError, match="--azimuth"):
        angles([word], "azimuth")


def test_every_azimuth_at_every_elevation_once() -> None:
    views = views_from(["0", "90", "0:180:90"], [], ["15", "75"])
    assert [(view.azimuth_deg, view.grazing_deg) for view in views] == [(0, 75), (90, 75), (0, 15), (90, 15)]


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A box of 2.4 km × 1.2 km × 1 km, or of metres if it is told that these are millimetres; in two parts."""
    halves = [trimesh.creation.box((1200, 1200, 1000)).apply_translation((x, 0, 500)) for x in (-700, 700)]
    trimesh.util.concatenate(halves).export(tmp_path / "box.obj")
    return tmp_path / "box.obj"


def simulated(box: Path, words: str) -> Dataset:
    views = "--azimuth 0:360:90 --grazing 30 --pixels 32"
    out = box.parent / "made"
    assert main(["simulate", "--mesh", str(box), *views.split(), "--overwrite", *words.split(), "--out", str(out)]) == 0
    return read_dataset(out)


def test_a_mesh_is_scaled_and_its_rays_are_recorded(box: Path) -> None:
    dataset = simulated(box, "--scale 0.001")
    assert dataset.source["scale"] == 0.001
    assert dataset.source["ray_spacing_m"] == 0.02
    assert 0 < dataset.source["ray_error_db"] < 0.1
    assert trimesh.load_mesh(dataset.truth_mesh).extents == pytest.approx((2.6, 1.2, 1.0))
    coarse = simulated(box, "--scale 0.001 --ray-spacing 0.1")
    assert coarse.source["ray_spacing_m"] == 0.1
    assert 0 < np.abs(coarse.power - dataset.power).max() < 0.1 * dataset.power.max()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--scale 0.01", "the target is 26 m long, but the images are 9.6 m wide"),
        ("--scale 0.001 --ray-spacing 0.2", "rays 0.2 m apart miss what pixels of 0.3 m show"),
    ],
)
def test_warnings_of_what_images_cannot_show(box: Path, words: str, told: str, capsys) -> None:
    simulated(box, words)
    assert told in capsys.readouterr().err


def test_a_response_with_side_lobes(box: Path) -> None:
    words = "--scale 0.001 --test-azimuth 45 --resolution 0.45"
    plain, lobed = simulated(box, words), simulated(box, f"{words} --response taylor")
    assert (plain.grid.response, lobed.grid.response) == (GAUSSIAN, TAYLOR)
    assert lobed.power.sum() == pytest.approx(plain.power.sum(), rel=0.02)
    edge = np.s_[:, :, :4]  # beyond the target, where only side lobes reach
    assert lobed.power[edge].mean() > 1e-4 * lobed.power.mean() > 100 * plain.power[edge].mean()


def test_laws_and_the_reflectivity_of_parts_are_recorded_and_shown(box: Path) -> None:
    plain = simulated(box, "--scale 0.001 --law 0 1 1")
    assert plain.source["law"] == {"floor": 0.0, "lobe": 1.0, "exponent": 1.0}
    varied = simulated(box, "--scale 0.001 --law 0 1 1 --reflectivity 6 --seed 3")
    assert varied.source["reflectivity_db"] == 6.0
    side = plain.grid.columns // 2  # seen from ±y, one part is left of the middle and the other right of it
    ratios = [varied.power[1][:, half].sum() / plain.power[1][:, half].sum() for half in (slice(side), slice(side, 64))]
    assert abs(10 * math.log10(ratios[0] / ratios[1])) > 0.5


def test_second_bounces_are_recorded_and_told(box: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "--scale 0.001 --ground 0.05"
    once, twice = simulated(box, words), simulated(box, f"{words} --bounces 2 --ground-reflectivity 0.5")
    assert "by way of the ground" in capsys.readouterr().out
    assert "bounces" not in once.source
    assert (twice.source["bounces"], twice.source["ground_reflectivity"]) == (2, 0.5)
    shares = twice.source["power_by_echo"]
    added = 1 - once.power.sum() / twice.power.sum()
    assert shares["by way of the ground"] + shares["between facets"] == pytest.approx(added, rel=1e-3)
    assert main(["info", str(twice.path)]) == 0
    assert "by way of the ground" in capsys.readouterr().out


def test_a_protocol_is_named_only_if_views_and_pixels_are_its_own(tmp_path: Path, monkeypatch) -> None:
    def images(_mesh: object, views: list[View], grid: Any, **_: object) -> np.ndarray:
        return np.zeros((len(views), grid.rows, grid.columns), np.float32)

    monkeypatch.setattr("sarsplat.scenes.simulate.simulate_images", images)
    monkeypatch.setattr("sarsplat.scenes.raycast.ray_error_db", lambda *_, **__: 0.0)
    monkeypatch.setattr("sarsplat.examination.plausible.suspicions", lambda _: [])
    named = {"": "paper", "--protocol mstar": "mstar", "--spacing 0.2": None, "--random-views 3": None}
    for words, protocol in named.items():
        out = str(tmp_path / (words.replace(" ", "") or "plain"))
        assert main(["simulate", "--target", "building-b", *words.split(), "--out", out]) == 0
        assert read_dataset(out).protocol == protocol


def test_test_images_are_clean_if_asked_for(box: Path) -> None:
    words = "--scale 0.001 --test-azimuth 45"
    clean, speckled = simulated(box, words), simulated(box, f"{words} --looks 1 --clean-tests --seed 2")
    assert speckled.select("train").looks == 1
    assert speckled.select("test").looks is None
    np.testing.assert_array_equal(speckled.images("test"), clean.images("test"))
    assert (speckled.images("train") != clean.images("train")).any()


@pytest.mark.parametrize("words", ["", "--source splat --ground 0.2"])
def test_masks_are_written_for_every_image(box: Path, words: str) -> None:
    pytest.importorskip("PIL")
    dataset = simulated(box, f"--scale 0.001 --test-azimuth 45 --masks {words}")
    masks = read_masks(dataset.path / "masks", dataset, ["train", "test"])
    assert list(masks) == list(range(5))
    for index, mask in masks.items():
        assert (mask == 2).sum() > 10
        power = dataset.power[index]
        assert power[mask == 1].mean() > 5 * power[mask == 2].mean()
    if not words:
        lit = np.stack(list(masks.values())) == 1
        assert dataset.power[lit].sum() > 0.65 * dataset.power.sum()  # the response spreads the rest
    plain = simulated(box, f"--scale 0.001 --test-azimuth 45 {words}")  # replaces it, masks and all
    assert plain.fingerprint() == dataset.fingerprint()
    assert not (plain.path / "masks").exists()


def test_masks_without_pillow_are_refused_before_any_work(tmp_path: Path, monkeypatch, refused) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr("sarsplat.scenes.simulate.simulate_images", None)
    told = refused(f"simulate --target t72 --masks --out {tmp_path}/new")
    assert "a mask needs pillow, which is not installed; install it with" in told


def test_images_need_not_be_square(box: Path) -> None:
    dataset = simulated(box, "--scale 0.001 --pixels 24 40 --spacing 0.2 0.25 --resolution 0.3 0.35")
    assert (dataset.grid.rows, dataset.grid.columns) == (24, 40)
    assert (dataset.grid.spacing_m, dataset.grid.resolution_m) == ((0.2, 0.25), (0.3, 0.35))
    assert simulated(box, "--scale 0.001 --spacing 0.2").grid.spacing_m == (0.2, 0.2)


def test_a_mesh_in_another_unit_is_refused_unless_the_images_are_chosen(box: Path, refused) -> None:
    told = refused(f"simulate --mesh {box} --azimuth 0 --grazing 30 --out {box.parent}/new")
    assert "the target is 2.6e+03 m long, but the images are 38.4 m wide" in told


STACK = "simulate --target slicy --azimuth 0 --grazing 45 --pixels 24 --spacing 0.5 --ground 0.5 --noise 0.1"


def test_stacks(tmp_path: Path, said, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "stacks"
    told = said(f"{STACK} --passes 3 --baseline 0.004 --wavelength 0.05 --out {out}")
    assert "1 3-channel stack of slicy" in told
    made = read_dataset(out)
    (stack,) = made.stacks
    assert (stack.wavelength_m, stack.noise) == (0.05, (0.1, 0.1, 0.1))
    assert stack.offsets_rad == pytest.approx((-0.002, 0.0, 0.002))
    assert made.signal is not None
    assert made.signal.shape == (1, 3, 24, 24)
    assert made.looks == 1
    told = " ".join(said(f"info {out}").split())
    assert "passes 3, wavelength 0.05 m, each transmits elevation resolution 6.25 m, ambiguous by 12.5 m" in told
    assert main(["check", str(out)]) == 0
    assert "cannot determine" not in capsys.readouterr().err  # phases tell heights


@pytest.mark.parametrize(
    ("more", "count", "offsets", "told"),
    [
        ("", 1, (0.0,) * 3, "polarisations HH, HV, VV noise 0.1, 0.1, 0.1 (β⁰ of each channel)"),
        ("--passes 2 --baseline 0.004", 2, (-0.002,) * 3 + (0.002,) * 3, "polarisations HH, HV, VV, HH, HV, VV"),
    ],
)
def test_polarisations(tmp_path: Path, said, more: str, count: int, offsets: tuple[float, ...], told: str) -> None:
    """Alone, and of each of several passes."""
    said(f"{STACK} --polarimetric {more} --out {tmp_path}/made")
    (stack,) = read_dataset(tmp_path / "made").stacks
    assert stack.polarisations == ("HH", "HV", "VV") * count
    assert stack.offsets_rad == pytest.approx(offsets)
    shown = " ".join(said(f"info {tmp_path}/made").split())
    assert "made: a dataset of 1 stack" in shown
    assert f"passes {count}, wavelength 0.031 m{', each transmits' * (count > 1)} {told}" in shown


def test_terrain_goes_from_its_heights_to_a_reconstruction(tmp_path: Path, said) -> None:
    """An oblong slope with a bump, on a hill of 400 m."""
    relief = terrain(lambda x, y: 400 + 0.15 * x + np.exp(-((x - 3) ** 2) - y**2), (12.0, 9.0), (0.75, 0.5))
    geotiff = write_geotiff(tmp_path / "dem.tif", relief.heights_m[::-1].astype(np.float32), scale=(0.75, 0.5, 0.0))
    data, views = tmp_path / "data", "--azimuth 0:360:90 --grazing 40 60 --ground 0.04 --terrain"
    pixels = "--pixels 32 --spacing 0.3 --ray-spacing 0.15"
    said(f"simulate --target slicy {pixels} {views} {geotiff} --out {data}")
    dataset = read_dataset(data)
    assert dataset.terrain is not None
    assert dataset.terrain.heights_m.shape == (37, 33)
    assert dataset.terrain.height_m(np.zeros(1), np.zeros(1)) == pytest.approx(0.0, abs=1e-6)
    assert "24 × 18 m (x × y)" in said(f"info {data}")
    few = "--preset quick --iterations 20 --points.voxel 0.3 --points.rays-per-pixel 2"
    said(f"reconstruct {data} {few} --out {tmp_path}/run")
    loaded: Any = Run.load(tmp_path / "run")
    kept = loaded.model.ground().height_m
    assert np.array_equal(kept.heights_m, dataset.terrain.heights_m)
    x, y, z = loaded.gaussians.means.numpy().T
    assert (z >= kept.height_m(x, y) - 1e-5).all()
    assert np.abs(loaded.render(dataset.views) - dataset.power).mean() < 0.5 * dataset.power.mean()


def test_a_village_is_as_wide_as_the_images_allow(tmp_path: Path) -> None:
    words = f"simulate --target village --azimuth 0 --grazing 45 --ray-spacing 0.1 --out {tmp_path}"
    houses = []
    for seed in (0, 1):
        assert main(f"{words}/{seed} --pixels 96 --seed {seed}".split()) == 0
        houses.append(trimesh.load(read_dataset(tmp_path / str(seed)).truth_mesh))
    assert 0.5 < houses[0].extents.max() / (0.64 * 96 * 0.3) <= 1  # of a width that whole plots fill
    assert not np.array_equal(houses[0].extents, houses[1].extents)


def test_views_may_be_tilted_and_look_left(tmp_path: Path) -> None:
    words = "simulate --target slicy --azimuth 0 --grazing 30 --pixels 24 --spacing 0.6 --tilt 15 --side left"
    assert main([*words.split(), "--out", str(tmp_path / "set")]) == 0
    assert {(view.tilt_deg, view.side) for view in read_dataset(tmp_path / "set").views} == {(15.0, "left")}


def test_inverse_sar_of_what_flies(tmp_path: Path) -> None:
    """Frames all around each axis, from below as well; and a reconstruction that has no ground to stand on."""
    words = "simulate --target satellite --isar 0 0 1 0 1 0 --frames 12 --line-of-sight 1 1 1 --pixels 40 --spacing 0.6"
    assert main([*words.split(), "--out", str(tmp_path / "set")]) == 0
    dataset = read_dataset(tmp_path / "set")
    assert len(dataset.select("train")) == len(dataset.select("test")) == 12
    assert all(view.aloft for view in dataset.views)
    assert min(view.grazing_deg for view in dataset.views) < -30
    run = reconstruct(dataset, replace(preset("quick"), iterations=40, points=FEW_POINTS))
    low, high = run.points.min(axis=0), run.points.max(axis=0)
    assert low[2] < -0.8 and high[2] > 0.8
    assert high[1] - low[1] > 9  # its wings
