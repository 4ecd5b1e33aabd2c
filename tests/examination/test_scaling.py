"""Cut-off, stretched, repeated and geocoded pictures are recognised; others are not taken for such."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_contradictions import simulated, speckled, with_views

from geocoded import on_map
from made import dataset_of, lorry
from sarsplat import examine, import_mstar
from sarsplat.cli import main
from sarsplat.cli.from_signature import CONTRADICTED
from sarsplat.data import Dataset, DatasetEntry, read_dataset, write_dataset
from sarsplat.examination.outcome import Examination
from sarsplat.examination.plausible import repeated_images
from sarsplat.examination.scaling import examine_cut_off, examine_scaling, share_at_top
from sarsplat.geometry import ImageGrid, View

COUNT = 12
GRID = ImageGrid(40, 48, (0.2, 0.2), (0.3, 0.3))


def pictures(seed: int = 0, step_deg: float = 30.0, **fields) -> Dataset:
    """Amplitude of a few thousand, squared: a bright square on ground, with speckle."""
    mean = np.full((40, 48), 0.1)
    mean[16:24, 20:28] = 20.0
    power = np.random.default_rng(seed).exponential(size=(COUNT, 40, 48)) * mean
    views = [(View(step_deg * k, 30.0), "train") for k in range(COUNT)]
    fields = {"looks": 1.0, "ground": True, "calibration": "relative", "source": {"kind": "folder"}, **fields}
    return dataset_of(GRID, views, power.astype(np.float32), **fields)


def stored(dataset: Dataset, factor: float | np.ndarray, largest: int = 255) -> Dataset:
    """As pictures of whole numbers."""
    amplitude = np.clip(np.round(np.sqrt(dataset.power) * factor), 1, largest)
    return replace(dataset, power=np.square(amplitude, dtype=np.float32))


def scaled(dataset: Dataset) -> list[str]:
    examined = Examination()
    cut_off = examine_cut_off(dataset, examined)
    examine_scaling(dataset, examined, True, cut_off)
    return examined.contradictions


@pytest.mark.parametrize("seed", range(5))
def test_pictures_of_one_scale_pass(seed):
    dataset = pictures(seed)
    for one in (dataset, stored(dataset, 25), stored(dataset, 35), stored(dataset, 200, 4095)):
        assert scaled(one) == []


@pytest.mark.parametrize("largest", [255, 4095, 65535])
def test_pixels_at_the_largest_value_were_cut_off(largest):
    (said,) = scaled(stored(pictures(), largest / 1.0, largest))
    assert "hold its largest value, and at least 1% in 12 of 12 images" in said


def test_a_few_are_only_said_and_a_largest_value_of_few_levels_is_not_cut_off():
    examined = Examination()
    assert 0 < examine_cut_off(stored(pictures(), 35), examined) < 0.01
    assert "were cut off" in examined.checks["largest values"]
    assert examined.contradictions == []
    levels = np.random.default_rng(0).choice(4, size=(64, 64), p=(0.6, 0.25, 0.1, 0.05)).astype(np.float32)
    assert share_at_top(levels) == 0


def test_parts_of_complex_amplitudes_that_were_cut_off():
    rng = np.random.default_rng(0)
    signal = (rng.normal(size=(3, 40, 48, 2)) @ [1, 1j]).astype(np.complex64)
    signal = np.clip(signal.real, -1.5, 1.5) + 1j * np.clip(signal.imag, -1.5, 1.5)
    views = [(View(120.0 * k, 30.0), "train") for k in range(3)]
    examined = Examination()
    assert examine_cut_off(dataset_of(GRID, views, signal.astype(np.complex64), ground=True), examined) > 0.1
    assert len(examined.contradictions) == 1


@pytest.mark.parametrize("by", ["brightest", "share", "mean"])
def test_pictures_that_are_stretched_one_by_one(by):
    dataset = pictures()
    amplitude = np.sqrt(dataset.power * np.linspace(0.2, 3.0, COUNT)[:, None, None])
    own = {
        "brightest": amplitude.max(axis=(1, 2)) / 255,
        "share": np.quantile(amplitude, 0.996, axis=(1, 2)) / 255,
        "mean": np.sqrt(np.square(amplitude).mean(axis=(1, 2))),
    }[by][:, None, None]
    power = np.square(amplitude / own if by == "mean" else np.clip(np.round(amplitude / own), 1, 255))
    (said,) = scaled(replace(dataset, power=power.astype(np.float32)))
    assert said.startswith("the images seem to be stretched one by one")


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize(("others", "alone", "within_db"), [((30.0, 30.0), 30.0, 0.1), ((20.0, 40.0), 60.0, 1.7)])
def test_one_picture_of_another_scale_is_named(factor, others, alone, within_db):
    """The law of the ground between the other grazing angles holds for one that no other picture has."""
    views = [View(30.0 * k, alone if k == 7 else others[k % 2]) for k in range(COUNT)]
    dataset = with_views(pictures(), views)
    assert scaled(dataset) == []
    (said,) = scaled(with_copy(dataset, factor * dataset.power[7]))
    found = re.match(f"the ground of 007 is (.*) dB {'darker' if factor < 1 else 'brighter'}", said)
    assert found and float(found[1]) == pytest.approx(10, abs=1.001 * within_db)


@pytest.mark.parametrize(
    ("grazings", "power"), [((30,), 4), ((20, 40, 60), -1), ((20, 40, 60), 0), ((20, 30, 40, 50, 60), 4)]
)
def test_levels_that_follow_the_grazing_angle(tmp_path, grazings, power):
    """A law of the ground passes; a scale beyond any law is told, and levelled to this law by the command it names."""
    angles = [grazings[k % len(grazings)] for k in range(COUNT)]
    sines = np.sin(np.radians(angles))
    law = (sines**power * sines / np.sqrt(1 - sines**2))[:, None, None].astype(np.float32)
    entries = tuple(DatasetEntry(View(30.0 * k, float(angle)), "train", str(k)) for k, angle in enumerate(angles))
    real = replace(pictures(), entries=entries, power=pictures().power * law)
    assert scaled(real) == []
    rng = np.random.default_rng(0)
    wrongs_db = [30 * (np.arange(COUNT) % 2), 10 * rng.normal(size=COUNT)]
    for wrong_db in wrongs_db + [-96 * np.log10(sines / sines.min())] * (len(grazings) > 1):
        wrong = (10 ** (wrong_db / 10)).astype(np.float32)[:, None, None]
        write_dataset(tmp_path / "in", replace(real, power=real.power * wrong), overwrite=True)
        (said,) = scaled(read_dataset(tmp_path / "in"))
        (options,) = re.findall(r"`sarsplat check DATASET (--levelled) OUT`", said)
        assert main(["check", str(tmp_path / "in"), options, str(tmp_path / "out"), "--overwrite"]) == CONTRADICTED
        copy = read_dataset(tmp_path / "out")
        assert scaled(copy) == []
        left_db = 10 * np.log10(np.median(copy.power / real.power, axis=(1, 2)))
        slope = np.polyfit(np.log10(sines), left_db, 1)[0] if np.ptp(sines) else 0.0
        assert np.std(left_db - slope * np.log10(sines)) < 0.3


def with_copy(dataset: Dataset, copy: np.ndarray) -> Dataset:
    power = dataset.power.copy()
    power[7] = copy
    return replace(dataset, power=power)


def test_one_picture_under_two_directions_or_twice_under_one_is_named():
    assert repeated_images(pictures()) == []
    dataset = with_copy(pictures(), pictures().power[2])
    (said,) = repeated_images(dataset)
    assert said.startswith("002 (azimuth 60°, grazing 30°) and 007 (azimuth 210°, grazing 30°) are one")
    views = [*dataset.views]
    views[7] = views[2]
    (said,) = repeated_images(with_views(dataset, views))
    assert said.startswith("002 and 007 are one and the same picture from one direction")


def test_targets_without_speckle_may_be_symmetric():
    half = pictures().power[:6]
    symmetric = replace(pictures(looks=None), power=np.concatenate([half, half]))
    assert repeated_images(symmetric) == []
    rounded = with_copy(symmetric, half[1] + 1e-3 * half[1].max())
    assert repeated_images(rounded) == []
    assert len(repeated_images(with_copy(symmetric, half[2]))) == 1
    assert repeated_images(symmetric.take([0, 6])) == []  # left and right


def large(seed: int) -> Dataset:
    """Four times as large, so that the speckle of a single image can be measured."""
    parts = [pictures(4 * seed + k).power for k in range(4)]
    power = np.concatenate([np.concatenate(parts[:2], axis=1), np.concatenate(parts[2:], axis=1)], axis=2)
    dataset = pictures(seed)
    return replace(dataset, power=power, grid=replace(dataset.grid, rows=80, columns=96))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("change", "said"),
    [(np.sqrt, "amplitude or smoothed"), (np.square, "squared, or all others amplitude")],
    ids=["root", "square"],
)
def test_one_image_in_another_unit_is_found_by_its_speckle(change, said, seed):
    dataset = large(seed)
    power = dataset.power.copy()
    power[5] = change(power[5]) * np.median(power) / np.median(change(power[5]))  # as bright as the others
    assert scaled(dataset) == []
    (text,) = scaled(replace(dataset, power=power))
    assert "ground of 005 is" in text
    assert f"as if it were {said}" in text


def test_clean_test_images_among_speckled_ones_pass():
    dataset = large(0)
    power = dataset.power.copy()
    power[8:] = power[:8].mean(axis=0) * np.random.default_rng(0).gamma(20, 1 / 20, power[8:].shape)
    entries = tuple(replace(entry, split="test" if k >= 8 else "train") for k, entry in enumerate(dataset.entries))
    clean = replace(dataset, power=power, entries=entries, clean_tests=True)
    assert scaled(clean) == []
    assert "as if it were amplitude or smoothed" in scaled(replace(clean, clean_tests=False))[0]


# ---- geocoded images without tags ------------------------------------------------------------------------------------
SQUARE = ImageGrid(64, 60, (0.3, 0.25), (0.4, 0.35))
CHIPS = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
ROUND = tuple(range(0, 360, 30))
TWO_SIDES = (74, 77, 80, 83, 86, 89, 92, 270, 273, 276, 279, 282, 285)


def cylinder():
    """The same from all sides."""
    trimesh = pytest.importorskip("trimesh")
    return trimesh.creation.cylinder(1.2, 2.5, sections=180).apply_translation([0, 0, 1.25])


def seen(target, azimuths: tuple[int, ...], looks: float | None, grazings: tuple[float, ...] = (35.0,)) -> Dataset:
    views = tuple(View(float(azimuth), grazing) for azimuth in azimuths for grazing in grazings)
    clean = simulated(0.05, views, SQUARE, target)
    return clean if looks is None else speckled(clean, looks, 0)


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


@pytest.mark.parametrize(
    ("target", "azimuths", "grazings", "looks"),
    [
        (lorry, ROUND, (35.0,), 1.0),
        (lorry, ROUND, (20.0, 50.0), 1.0),
        (lorry, tuple(range(0, 360, 15)), (35.0,), None),
        (lorry, tuple(range(0, 360, 45)), (35.0,), 1.0),
        (lorry, TWO_SIDES, (35.0,), 1.0),
        (cylinder, ROUND, (35.0,), 1.0),
    ],
)
def test_by_what_stays_and_what_turns(target, azimuths, grazings, looks) -> None:
    radar = seen(target, azimuths, looks, grazings)
    assert not called_geocoded(radar)
    assert called_geocoded(geocoded(radar))


def test_azimuths_from_elsewhere_or_the_other_way() -> None:
    radar = seen(lorry, ROUND, 1.0)
    for sign, offset in ((1, 40.0), (-1, 0.0)):
        for dataset, expected in ((radar, False), (geocoded(radar), True)):
            views = [replace(view, azimuth_deg=sign * view.azimuth_deg + offset) for view in dataset.views]
            assert called_geocoded(with_views(dataset, views)) == expected


@pytest.mark.skipif(not CHIPS.is_dir(), reason="no measured chips")
@pytest.mark.filterwarnings("ignore:.* hold the largest value of their image")
def test_measured_chips(tmp_path: Path) -> None:
    chips = import_mstar(
        CHIPS, tmp_path / "out", labels=CHIPS / "labels.csv", target_class="T72", train_views=18, test=False
    )
    assert not called_geocoded(chips)
    assert called_geocoded(geocoded(chips))
