"""Images that contradict what a dataset says of them are found; those that do not, pass."""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made import dataset_of, lorry
from sarsplat import Dataset, ImageGrid, View, add_speckle, examine, simulate_images, write_dataset
from sarsplat.cli import main
from sarsplat.data.orientation import SIDES, Layout, oriented
from sarsplat.examination.significance import Evidence
from sarsplat.examination.units import clutter, contrast_of
from sarsplat.regions.outlines import levels_db, outline

trimesh = pytest.importorskip("trimesh")

GRID = ImageGrid(40, 36, (0.4, 0.35), (0.5, 0.45))


def ring(azimuths: range = range(0, 360, 30), grazing_deg: float = 30.0, *others: Any) -> tuple[View, ...]:
    return tuple(View(float(azimuth), grazing_deg, *others) for azimuth in azimuths)


@cache
def simulated(
    ground: float | None, views: tuple[View, ...] = ring(), grid: ImageGrid = GRID, target: Callable[[], Any] = lorry
) -> Dataset:
    images = simulate_images(target(), views, grid, ground_gamma0=ground, ray_spacing=min(grid.spacing_m) / 4)
    return dataset_of(grid, [(view, "train") for view in views], images, ground=ground is not None)


def speckled(dataset: Dataset, looks: float, seed: int) -> Dataset:
    return replace(dataset, power=add_speckle(dataset.power, looks, np.random.default_rng(seed)), looks=looks)


@pytest.fixture(scope="module")
def bare() -> Dataset:
    return simulated(None)


@pytest.fixture(scope="module")
def grounded() -> Dataset:
    return simulated(0.05)


def with_power(dataset: Dataset, power: np.ndarray, **fields: Any) -> Dataset:
    return replace(dataset, power=np.ascontiguousarray(power, dtype=np.float32), **fields)


def with_azimuths(dataset: Dataset, change: Callable[[float], float]) -> Dataset:
    return with_views(dataset, [replace(view, azimuth_deg=change(view.azimuth_deg)) for view in dataset.views])


def with_views(dataset: Dataset, views: Iterable[View]) -> Dataset:
    entries = (replace(entry, view=view) for entry, view in zip(dataset.entries, views, strict=True))
    return replace(dataset, entries=tuple(entries))


def with_resolution(dataset: Dataset, factor: float) -> Dataset:
    resolution_m = tuple(factor * width for width in dataset.grid.resolution_m)
    return replace(dataset, grid=replace(dataset.grid, resolution_m=resolution_m))


def only(dataset: Dataset) -> str:
    (text,) = examine(dataset).contradictions
    return text


@pytest.mark.parametrize("looks", [1, 4, None])
def test_what_is_right_passes(bare: Dataset, grounded: Dataset, looks: float | None) -> None:
    for dataset in (bare, grounded):
        found = examine(dataset if looks is None else speckled(dataset, looks, 0))
        assert found.contradictions == []
        assert "as given" in found.checks["azimuths"]


def imported(dataset: Dataset, layout: Layout, seen: Layout) -> Dataset:
    """The dataset that `import folder` makes of pictures that lie as in `seen`, told that they lie as in `layout`."""
    pictures = dataset.power[..., ::-1] if seen.mirrored else dataset.power
    pictures = np.rot90(pictures, -SIDES.index(seen.near), axes=(1, 2))
    power = oriented(pictures, layout.near, layout.mirrored)
    sign = 1 if layout.counter_clockwise == seen.counter_clockwise else -1
    turned = with_azimuths(dataset, lambda azimuth: (sign * azimuth + 20) % 360)
    grid = replace(dataset.grid, rows=power.shape[1], columns=power.shape[2])
    return replace(turned, power=power, grid=grid, source={"kind": "folder", "layout": asdict(layout)})


LAYOUTS = [Layout(*options) for options in itertools.product(SIDES, (False, True), (False, True))]
HALF = [LAYOUTS[4 * side + (side + k) % 4] for side in range(4) for k in (0, 1)]
"""Two of each side, and each combination of the others twice."""


@pytest.mark.parametrize("seen", HALF, ids=str)
def test_every_orientation_is_recovered(bare: Dataset, grounded: Dataset, seen: Layout) -> None:
    """Images, azimuths or both lie otherwise than an import was told: it names the options that were right."""
    right = Layout(seen.near, False, seen.counter_clockwise ^ seen.mirrored)  # the same, but for a mirrored target
    told = (Layout(), Layout("left", True), Layout("bottom", False, True))
    first = HALF.index(seen) % 3
    for dataset, layouts in ((speckled(grounded, 1, 0), (told + told)[first : first + 2]), (bare, told[1:2])):
        for layout in layouts:
            if layout in (right, right.twin):
                assert examine(imported(dataset, layout, seen)).contradictions == []
                continue
            said = only(imported(dataset, layout, seen))
            if right.counter_clockwise != (layout.counter_clockwise ^ layout.mirrored):
                orders = ((right, right.twin), (right.twin, right))
                assert any(f"import with {one}, or with {other} if the table" in said for one, other in orders)
            else:
                assert f"import with {right}" in said


def test_an_import_names_the_remedy(grounded: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a radar that looks to the left."""
    dataset = speckled(grounded, 1, 0)
    table = ["file,azimuth,grazing,look"]
    for entry, image in zip(dataset.entries, dataset.power, strict=True):
        picture = np.rot90(image[:, ::-1], -SIDES.index("left"))
        np.save(tmp_path / f"{entry.name}.npy", picture)
        table.append(f"{entry.name}.npy,{-entry.view.azimuth_deg:g},{entry.view.grazing_deg:g},left")
    (tmp_path / "table.csv").write_text("\n".join(table))
    lengths = ["--spacing", "0.4", "0.35", "--resolution", "0.5", "0.45", "--quantity", "power"]
    words = ["import", "folder", str(tmp_path), "--out", str(tmp_path / "made"), *lengths]
    assert main([*words, "--near", "bottom"]) == 1
    options = capsys.readouterr().err.split("import with ")[1].split(",")[0].split()
    assert options == ["--near", "left", "--mirrored"]  # as of a transposed array
    assert main([*words, "--overwrite", *options]) == 0


def test_another_size_and_spacing(bare: Dataset) -> None:
    power = np.random.default_rng(0).exponential(size=(1, 1, 600)).astype(np.float32)
    row = dataset_of(replace(GRID, rows=1, columns=600), [(View(0, 30), "train")], power, ground=True)
    assert examine(row).contradictions == []
    grid = ImageGrid(40, 64, (8.0, 10.0), (12.0, 10.0))
    ship = simulated(0.1, ring(range(0, 360, 24)), grid, partial(lorry, scale=20))
    assert examine(speckled(ship, 1, 0)).contradictions == []
    assert "--near bottom --mirrored, or with --near bottom --counter-clockwise if" in only(
        imported(ship, Layout(), Layout("bottom", True))
    )


def test_the_remedy_for_arrays(grounded: Dataset) -> None:
    assert only(with_power(grounded, grounded.power[:, ::-1, ::-1])).endswith("(np.rot90(power, 2, axes=(1, 2)))")
    sense = only(with_power(grounded, grounded.power[:, :, ::-1]))
    assert "; negate the azimuths, or flip the columns (power[:, :, ::-1]) if azimuths do run clockwise" in sense


def test_the_table_of_orientations(grounded: Dataset) -> None:
    head, *rows = examine(imported(grounded, Layout(), Layout("right", False, True))).orientations
    assert [row[0] for row in rows] == [str(Layout(near, False, ccw)) for near in SIDES for ccw in (False, True)]
    assert [row[-1] for row in rows] == ["as it is", "", "", "best", "", "", "", ""]
    darkest = max(rows, key=lambda row: float(row[head.index("shadow beyond")].split()[0]))
    assert darkest[0].startswith("--near right")


def test_a_target_of_no_azimuth_is_undecided() -> None:
    """A cone looks the same from everywhere: no sense of the azimuths is right."""
    cone = partial(trimesh.creation.cone, 2.0, 3.0, sections=720)
    dataset = speckled(simulated(0.05, ring(grazing_deg=40.0), target=cone), 1, 3)
    for changed in (dataset, with_azimuths(dataset, lambda azimuth: -azimuth)):
        examined = examine(changed)
        assert examined.contradictions == []
        assert "cannot be determined" in examined.checks["azimuths"]
        assert examined.checks["near range"].startswith("at the top")


def test_incidence_angles_for_grazing_angles() -> None:
    for ground, columns, remedy in (
        (0.05, {"grazing": "elev"}, "import with `columns={'incidence': 'elev'}`"),
        (None, {"incidence": "inc"}, "import with `columns={'grazing': 'inc'}`"),
        (0.05, {}, "(`grazing_deg=30`)"),
    ):
        dataset = speckled(simulated(ground), 1, 0)
        dataset = replace(dataset, source={"kind": "folder", "columns": columns})
        assert "than if they were incidence angles" in examine(dataset).checks["grazing angles"]
        swapped = with_views(dataset, [replace(view, grazing_deg=60.0) for view in dataset.views])
        (wrong,) = [text for text in examine(swapped).contradictions if "incidence" in text]
        assert remedy in wrong


def test_ground_that_is_said_not_to_be_there(bare: Dataset, grounded: Dataset) -> None:
    for dataset in (grounded, speckled(grounded, 1, 0)):
        assert "import them without ground=False" in only(replace(dataset, ground=False))
    noise = np.random.default_rng(0).exponential(np.quantile(bare.power, 0.999) / 300, bare.power.shape)
    assert examine(with_power(bare, bare.power + noise)).contradictions == []  # a noise floor, not ground


@pytest.mark.parametrize("looks", [1.0, 4.0])
def test_values_that_are_not_power(grounded: Dataset, looks: float) -> None:
    dataset = speckled(grounded, looks, 1)
    assert "square the values (quantity='amplitude')" in only(with_power(dataset, np.sqrt(dataset.power)))
    db = only(with_power(dataset, np.sqrt(dataset.power), source={"kind": "folder", "quantity": "db"}))
    assert "; give another number of `looks`, or double the decibels (`scale=2`)" in db
    assert "take the root" in only(with_power(dataset, dataset.power**2))
    for kind, remedy in (("sicd", "; give another number of `looks`"), ("mstar", "; correct the files")):
        told = only(with_power(dataset, dataset.power**2, source={"kind": kind}))
        assert remedy in told and "quantity" not in told


@pytest.mark.parametrize("looks", [1.0, 4.0])
def test_pictures_in_eight_bits(grounded: Dataset, looks: float) -> None:
    dataset = speckled(grounded, looks, 1)
    bright = np.quantile(dataset.power, 0.999)
    amplitude = np.clip(np.round(255 * np.sqrt(dataset.power / bright)), 1, 255)
    decibels = np.clip(np.round(255 * (10 * np.log10(np.maximum(dataset.power / bright, 1e-9)) + 60) / 60), 1, 255)
    assert examine(with_power(dataset, amplitude**2)).contradictions == []
    as_decibels = only(with_power(dataset, 10 ** (amplitude / 10) / 1e12))
    assert "more than any radar image has" in as_decibels and "quantity='amplitude'" in as_decibels
    for power in (decibels, decibels**2):
        said = only(with_power(dataset, power))
        assert "as in decibels" in said and "quantity='db', with `scale` and `offset`" in said


def test_ground_of_few_values_tells_no_unit(grounded: Dataset) -> None:
    """Coarse steps, as of pictures that a glint has darkened, look like speckle of another unit."""
    dataset = speckled(grounded, 1, 1)
    step = np.sqrt(np.median(dataset.power))
    coarse = np.maximum(np.round(np.sqrt(dataset.power) / step), 1) ** 2
    examined = examine(with_power(dataset, coarse))
    assert examined.contradictions == []
    assert "so coarsely are pixels quantised" in examined.checks["unit"]


def test_speckle_that_is_not_as_stated(grounded: Dataset) -> None:
    for looks in (None, 1e8, 1e18):
        assert "states no speckle; give the number of `looks`" in only(replace(speckled(grounded, 1, 2), looks=looks))
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
    assert ["less than half a pixel" in text for text in fine] == [True, True]


def test_speckle_that_correlates_tells_the_resolution() -> None:
    """Speckle as a coherent sensor has it: white noise seen through the response of the amplitude."""
    from scipy.ndimage import gaussian_filter

    rng, grid = np.random.default_rng(0), ImageGrid(56, 48, (0.4, 0.35), (0.8, 0.7))
    grounded = simulated(0.05, grid=replace(grid, resolution_m=GRID.resolution_m))
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
        assert ["correct the resolution or the pixel spacing" in text for text in texts] == [True, True], factor


def test_of_few_images_nothing_is_said_but_that_all_are_constant(grounded: Dataset) -> None:
    few = replace(grounded, entries=grounded.entries[::6], power=grounded.power[::6])
    examined = examine(with_power(few, few.power[:, ::-1]))
    assert examined.contradictions == []
    assert all("cannot be determined" in examined.checks[name] for name in ("near range", "azimuths"))
    assert examine(grounded.take([0])).checks["images"] == "the only one is not constant"
    assert "are constant" in only(with_power(grounded, np.ones_like(grounded.power)))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    few = simulated(0.05, ring(range(0, 360, 45)))
    write_dataset(tmp_path / "right", few)
    write_dataset(tmp_path / "wrong", with_power(few, few.power[:, ::-1]))
    sheet = tmp_path / "sheet.png"
    assert main(["check", str(tmp_path / "right"), "--out", str(sheet)]) == 0
    assert "no contradictions" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "wrong")]) == 1
    assert "--near bottom --counter-clockwise" not in capsys.readouterr().out
    assert main(["check", str(tmp_path / "wrong"), "--verbose"]) == 1
    assert "--near bottom --counter-clockwise" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "right"), "--out", str(sheet)]) == 2  # it exists
    assert main(["check", str(tmp_path / "right"), "--out", str(tmp_path / "sheet.gif")]) == 2
    pixels = np.asarray(image.open(sheet).convert("RGB")).astype(int)
    orange, blue = ((abs(pixels - colour).sum(axis=2) < 60).sum() for colour in ((255, 180, 84), (92, 200, 255)))
    assert min(orange, blue) > 300  # outlines of targets and shadows


@pytest.mark.parametrize(("first", "ground"), [(0, None), (1, 0.05), (70, 0.05)])
def test_azimuths_that_do_count_degrees_pass(ground: float | None, first: int) -> None:
    """A sector in steps of a degree, from the nose or from the side."""
    sector = simulated(ground, ring(range(first, first + 36)), replace(GRID, columns=40))
    dataset = replace(speckled(sector, 1, 0), source={"layout": asdict(Layout())})
    assert examine(dataset).contradictions == []


@pytest.mark.parametrize("width", [(2.0, 2.0), (30.0, 1.6), (16.0, 16.0)])
def test_speckle_is_measured_where_few_cells_fit_into_an_image(width: tuple[float, float]) -> None:
    """Blocks of ground are then as large as a cell, and their mean takes most of what varies."""
    rng, sigmas = np.random.default_rng(0), [one / (2 * math.sqrt(math.log(2))) for one in reversed(width)]
    along, across = (np.exp(-2 * np.pi**2 * (np.fft.fftfreq(128) * sigma) ** 2) for sigma in sigmas)
    drawn = rng.normal(size=(20, 128, 128)) + 1j * rng.normal(size=(20, 128, 128))
    power = (abs(np.fft.ifft2(np.fft.fft2(drawn) * np.outer(along, across))) ** 2)[:, :64, :64]
    grid = ImageGrid(64, 64, (1.0, 1.0), width)
    levels = levels_db(power, grid, ground=True)
    found = clutter(power, levels, [outline(level) for level in levels], grid)
    assert found is not None
    assert 0.75 < found.contrast_of_many < 1.1
    for measured, stated in zip(found.width_m, width, strict=True):
        assert measured is None or measured / stated > 0.6


def test_what_is_dark_on_one_side_from_one_direction_may_lie_there() -> None:
    """A road beyond a car turns with the scene; a shadow does not."""
    rng = np.random.default_rng(0)
    for span, shaded, told in ((4, 0.0, False), (4, 1.0, False), (180, 0.0, False), (180, 1.0, True), (360, 1.0, True)):
        azimuths = np.radians(np.arange(20) * span / 20)
        darker = shaded + 0.8 * np.cos(azimuths) + rng.normal(0, 0.1, 20)
        assert Evidence(darker, np.column_stack([np.cos(azimuths), np.sin(azimuths)])).supports(0.2) is told


# ---- tilted and left-looking radars ----------------------------------------------------------------------------------
TILTED, LEFT = ring(range(0, 360, 30), 30.0, 25.0), ring(range(0, 360, 30), 30.0, -20.0, "left")


@pytest.mark.parametrize("ground", [None, 0.05])
@pytest.mark.parametrize("views", [TILTED, LEFT], ids=["tilted", "left and tilted"])
def test_what_is_right_passes_of_unusual_views(views: tuple[View, ...], ground: float | None) -> None:
    found = examine(simulated(ground, views))
    assert found.contradictions == []
    assert "as given" in found.checks["azimuths"]
    assert found.checks["near range"].startswith("at the top")


@pytest.mark.parametrize("views", [TILTED, LEFT], ids=["tilted", "left and tilted"])
def test_azimuths_in_the_other_sense_are_found_and_both_twins_are_right(views: tuple[View, ...]) -> None:
    seen = simulated(0.05, views)
    wrong = with_views(seen, [replace(view, azimuth_deg=-view.azimuth_deg) for view in seen.views])
    assert "flip the columns (power[:, :, ::-1]) and negate the tilts if azimuths do run clockwise" in only(wrong)
    # the second remedy shows a mirrored target
    flipped = with_power(wrong, wrong.power[:, :, ::-1])
    mended = with_views(flipped, [replace(view, tilt_deg=-view.tilt_deg) for view in wrong.views])
    assert examine(mended).contradictions == []
    mirror = np.diag([1.0, -1.0, 1.0])
    for right, twin in zip(seen.views, mended.views, strict=True):
        np.testing.assert_allclose(twin.look.gradients @ mirror, right.look.gradients * [[-1], [1]], atol=1e-9)


def test_turned_images_are_found_and_shadows_beside_the_target_are_not_taken_for_such() -> None:
    seen = simulated(0.05, TILTED)
    assert "near range is at the bottom" in only(with_power(seen, seen.power[:, ::-1, ::-1]))
    examined = examine(with_views(seen, [View(one.azimuth_deg, 50.0, 75.0) for one in seen.views]))
    assert "the azimuth axes are tilted too much" in examined.checks["orientation"]
