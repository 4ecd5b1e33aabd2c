"""Images that contradict what a dataset says of them are found; those that do not, pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets import dataset_of
from sarsplat import ScatteringLaw, add_speckle, simulate_raycast
from sarsplat.cli import main
from sarsplat.data import Dataset, write_dataset
from sarsplat.geometry import ImageGrid, View
from sarsplat.reconstruction.clutter import contrast_of
from sarsplat.reconstruction.contradictions import examine

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

GRID = ImageGrid(56, 48, (0.4, 0.35), (0.5, 0.45))


def simulated(ground: float | None, grid: ImageGrid = GRID, scale: float = 1.0, step: int = 30) -> Dataset:
    """A long box with a cabin at one end and a mast: like a lorry, of no symmetry."""
    parts = []
    for size, place in (((6, 2, 1), (0, 0, 0.5)), ((1.5, 1.8, 1.2), (2.2, 0, 1.6)), ((0.8, 0.8, 1), (-2, 0.6, 1.5))):
        part = trimesh.creation.box(np.multiply(size, scale))
        part.apply_translation(np.multiply(place, scale))
        parts.append(part)
    mesh = trimesh.util.concatenate(parts)
    views = [View(float(azimuth), grazing) for azimuth in range(0, 360, step) for grazing in (30.0,)]
    images = [
        simulate_raycast(mesh, view, grid, ScatteringLaw(), ground_gamma0=ground, ray_spacing=min(grid.spacing_m) / 5)
        for view in views
    ]
    return dataset_of(grid, [(view, "train") for view in views], np.stack(images), ground=ground is not None)


def speckled(dataset: Dataset, looks: float, seed: int) -> Dataset:
    return replace(dataset, power=add_speckle(dataset.power, looks, np.random.default_rng(seed)), looks=looks)


@pytest.fixture(scope="module")
def bare() -> Dataset:
    return simulated(None)


@pytest.fixture(scope="module")
def grounded() -> Dataset:
    return simulated(0.05)


def with_power(dataset: Dataset, power: np.ndarray) -> Dataset:
    return replace(dataset, power=np.ascontiguousarray(power))


def with_azimuths(dataset: Dataset, change: Callable[[float], float]) -> Dataset:
    entries = [
        replace(entry, view=View(change(entry.view.azimuth_deg), entry.view.grazing_deg)) for entry in dataset.entries
    ]
    return replace(dataset, entries=tuple(entries))


def with_resolution(dataset: Dataset, factor: float) -> Dataset:
    return replace(
        dataset, grid=replace(dataset.grid, resolution_m=tuple(factor * r for r in dataset.grid.resolution_m))
    )


def only(dataset: Dataset) -> str:
    (text,) = examine(dataset).contradictions
    return text


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("looks", [1, 4, None])
def test_what_is_right_passes(bare: Dataset, grounded: Dataset, looks: float | None, seed: int) -> None:
    for dataset in (bare, grounded):
        if looks is not None:
            dataset = speckled(dataset, looks, seed)
        found = examine(dataset)
        assert found.contradictions == []
        assert "as given" in found.checks["azimuths"]


def test_another_size_and_spacing_pass() -> None:
    ship = simulated(0.1, ImageGrid(40, 64, (8.0, 10.0), (12.0, 10.0)), scale=20, step=24)
    assert examine(speckled(ship, 1, 0)).contradictions == []
    assert "flip the rows" in only(with_power(ship, ship.power[:, ::-1]))


def test_rows_that_are_flipped(bare: Dataset, grounded: Dataset) -> None:
    flipped = only(with_power(grounded, grounded.power[:, ::-1]))
    assert flipped.startswith("shadows lie on the near side of the target")
    assert flipped.endswith("flip the rows (power[:, ::-1])")
    assert only(with_power(bare, bare.power[:, ::-1])).startswith("what is bright leans away from the radar")
    for dataset in (bare, grounded, speckled(grounded, 1, 0)):
        assert "turn the images by 180°" in only(with_power(dataset, dataset.power[:, ::-1, ::-1]))


def test_azimuths_that_run_the_other_way(bare: Dataset, grounded: Dataset) -> None:
    for dataset in (bare, grounded, speckled(grounded, 1, 0), speckled(bare, 1, 0)):
        wrong = only(with_azimuths(dataset, lambda azimuth: -azimuth))
        assert "match better if azimuths run the other way" in wrong
        assert "negate the azimuths" in wrong
        assert only(with_power(dataset, dataset.power[:, :, ::-1]))[:60] == wrong[:60]
        assert examine(with_azimuths(dataset, lambda azimuth: azimuth + 90)).contradictions == []  # unclear


@pytest.mark.parametrize("looks", [1.0, 4.0])
def test_values_that_are_not_power(grounded: Dataset, looks: float) -> None:
    dataset = speckled(grounded, looks, 1)
    assert "square the values" in only(with_power(dataset, np.sqrt(dataset.power)))
    assert "take the root" in only(with_power(dataset, dataset.power**2))


def test_speckle_that_is_not_as_stated(grounded: Dataset) -> None:
    assert "states no speckle; give the number of looks" in only(replace(speckled(grounded, 1, 2), looks=None))
    assert "smoother than stated" in only(replace(grounded, looks=1.0))


def test_contrast_of_amplitude_is_that_of_rayleigh() -> None:
    power, amplitude = contrast_of(1.0)
    assert power == 1
    assert amplitude == pytest.approx(np.sqrt(4 / np.pi - 1))
    drawn = np.sqrt(np.random.default_rng(0).gamma(4, 0.25, 200_000))
    assert contrast_of(4.0)[1] == pytest.approx(drawn.std() / drawn.mean(), rel=0.01)


def test_a_resolution_that_images_do_not_have(grounded: Dataset) -> None:
    coarse = examine(with_resolution(grounded, 2.5)).contradictions
    assert [text[:26] for text in coarse] == ["the sharpest structure is "] * 2
    fine = examine(with_resolution(grounded, 0.3)).contradictions
    assert all("less than half a pixel" in text for text in fine)
    assert len(fine) == 2


def test_speckle_that_correlates_tells_the_resolution(grounded: Dataset) -> None:
    """Speckle as a coherent sensor has it: white noise seen through the response of the amplitude."""
    from scipy.ndimage import gaussian_filter

    rng, grid = np.random.default_rng(0), ImageGrid(56, 48, (0.4, 0.35), (0.8, 0.7))
    sigma = (0.0, *(np.sqrt(2) * width / 2.3548 / pixel for width, pixel in ((0.7, 0.35), (0.8, 0.4))))
    noise = [gaussian_filter(rng.normal(size=grounded.power.shape), sigma) for _ in range(2)]
    field = noise[0] ** 2 + noise[1] ** 2
    power = (grounded.power * field / field.mean()).astype(np.float32)
    right = replace(grounded, grid=grid, power=power, looks=1.0)
    found = examine(right)
    assert found.contradictions == []
    assert "pixels of speckle correlate as of" in found.checks["resolution"]
    for factor in (0.4, 2.5):
        texts = examine(with_resolution(right, factor)).contradictions
        assert len(texts) == 2, factor
        assert all("correct the resolution or the pixel spacing" in text for text in texts)


def test_images_that_are_the_same_or_constant(grounded: Dataset) -> None:
    same = examine(with_power(grounded, np.repeat(grounded.power[:1], len(grounded), axis=0))).contradictions
    assert any("pixel by pixel" in text for text in same)
    assert "are constant" in only(with_power(grounded, np.ones_like(grounded.power)))


def test_of_few_images_nothing_is_said(grounded: Dataset) -> None:
    few = replace(grounded, entries=grounded.entries[::6], power=grounded.power[::6])
    wrong = with_power(few, few.power[:, ::-1])
    assert examine(wrong).contradictions == []
    assert all("cannot be determined" in examine(wrong).checks[name] for name in ("near range", "azimuths"))


def test_the_command(grounded: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    write_dataset(tmp_path / "right", grounded)
    write_dataset(tmp_path / "wrong", with_power(grounded, grounded.power[:, ::-1]))
    sheet = tmp_path / "sheet.png"
    assert main(["check", str(tmp_path / "right"), "--out", str(sheet)]) == 0
    assert "no contradictions" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "wrong")]) == 1
    shown = capsys.readouterr()
    assert "flip the rows" in " ".join(shown.err.split())
    assert "1 contradiction found" in shown.out
    assert main(["check", str(tmp_path / "right"), "--out", str(sheet)]) == 2  # it is there
    assert main(["check", str(tmp_path / "right"), "--out", str(tmp_path / "sheet.gif")]) == 2
    assert main(["check", str(tmp_path / "nowhere")]) == 2
    pixels = np.asarray(image.open(sheet).convert("RGB")).astype(int)
    orange, blue = ((abs(pixels - colour).sum(axis=2) < 60).sum() for colour in ((255, 180, 84), (92, 200, 255)))
    assert min(orange, blue) > 300  # outlines of targets and shadows


def test_one_image_is_not_called_all(bare: Dataset) -> None:
    assert examine(bare.take([0])).checks["images"] == "the only one is not constant"
    assert examine(bare.take([0, 1])).checks["images"] == "all 2 differ, none is constant"
