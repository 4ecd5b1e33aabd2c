"""Remedies of sentences that name an argument are followed, and end in a dataset."""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

pytest.importorskip("h5py")
pytest.importorskip("sarkit")

from chip_files import ROWS, write_chips, write_originals
from cphds import Collection, arc, write_cphd
from geocoded import on_map, write_maps
from made import lorry, write_geotiff
from made_imports import (
    AZIMUTHS,
    NOISY,
    PHASE,
    POWER,
    THREE,
    import_chips,
    import_pictures,
    write_passes,
    write_pictures,
)
from programs import ROOT
from pulses import circle, record, write
from rslcs import IMAGES, SWATHS, write_rslc
from sarsplat import ScatteringLaw, add_speckle, simulate_raycast
from sarsplat.data import read_terrain
from sarsplat.errors import SarsplatError
from sarsplat.exports import MapSystem, export
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, Place, Terrain, View
from sarsplat.importers import import_phase_history, import_rslc, import_sicd, import_stack
from sarsplat.runs import Run
from sicds import SPOT, Recording, Track, write_sicd

NOT_RUN = {
    "which way the table counts azimuths decides": "a note, which names no remedy",
}
"""Words of sentences with an argument whose remedy is not followed here, and why."""
_ARGUMENT = re.compile(r"`[a-z_]+(=[^`]*)?`|`[a-z_]+=|\w=(True|False|None|'\w+')")

Case = tuple[str, str, list[Any], dict[str, Any], dict[str, Any]]
"""Words of the sentence, names of columns, cells of a row after file and azimuth, options, and those of the remedy."""
NEW = "file,azimuth,grazing"
FOLDERS: list[Case] = [
    (
        "names both",
        NEW + ",inc",
        [30, 60],
        {"columns": {"grazing": "grazing", "inc": "inc"}},
        {"columns": {"inc": "inc"}},
    ),
    ("replaces the table", NEW, [30], {"names": "{azimuth}.npy"}, {"names": None}),
    ("columns in braces, each once", NEW, [30], {"names": "{az}_{az}.npy"}, {"names": None}),
    ("several columns that may be the azimuth", "file,azim,grazing,az", [30, 0], {}, {"columns": {"az": "azim"}}),
    ("like the grazing", "file,azimuth,x", [30], {}, {"grazing_deg": 30.0}),
    ("like the grazing", "file,azimuth,x", [30], {}, {"columns": {"incidence": "x"}}),
    ("like the spacing", NEW, [30], {"spacing_m": None}, {"spacing_m": (0.1, 0.3)}),
    (
        "direction of flight",
        "file,track,grazing",
        [30],
        {"columns": {"az": "track"}},
        {"columns": {"heading": "track"}, "look": "left"},
    ),
    ("north by its name", "file,north,grazing", [30], {"columns": {"az": "north"}}, {"azimuth_offset_deg": 0.0}),
    ("side to which the radar looks", "file,heading,grazing", [30], {}, {"look": "right"}),
    ("to which side", "file,heading,grazing,look", [30, ""], {}, {"look": "right"}),
    (
        "which run clockwise",
        "file,heading,grazing",
        [30],
        {"look": "left", "counter_clockwise": True},
        {"counter_clockwise": False},
    ),
    ("in the direction", NEW + ",heading,look", [30, 45, "left"], {}, {"columns": {"azimuth": "azimuth"}}),
    ("in the direction", NEW + ",heading,look", [30, 45, "left"], {}, {"columns": {"heading": "heading"}}),
    ("near range of", NEW + ",near_side", [30, "left"], {"near": "top"}, {"near": None}),
    ("scales pictures by", NEW + ",scale_factor", [30, 2], {}, {"quantity": "amplitude"}),
    ("scales pictures by", NEW + ",scale_factor", [30, 2], {}, {"columns": {"scale": "scale_factor"}}),
    ("which is not used; if", NEW + ",gain", [30, 2], {}, {"columns": {"scale": "gain"}}),
    ("which is not used; if", NEW + ",gain", [30, 2], {}, {"columns": {"calibration-factor": "gain"}}),
    ("a column of factors; leave out", NEW + ",calibration_factor", [30, 2], {"scale": 1.0}, {"scale": None}),
    ("but the quantity is", NEW, [30], {"quantity": "complex"}, {"quantity": "power"}),
    ("of unknown meaning", NEW, [30], {"quantity": None}, {"quantity": "power"}),
    ("holds real numbers", NEW, [30], {"quantity": "complex"}, {"quantity": "power"}),
    ("of 4 classes|of 2 classes", NEW + ",class", [30, "{k}"], {}, {"target_class": "1"}),
    ("no column of classes", NEW + ",kind", [30, "a"], {"target_class": "a"}, {"columns": {"class": "kind"}}),
    ("do not add to 90", NEW + ",incidence", [30, 50], {}, {"columns": {"incidence": "incidence"}}),
    ("geocoded_height_m", NEW, [30], {"geocoded_height_m": 0.5}, {"geocoded": "level"}),
    ("state the resolution", NEW, [30], {"geocoded": "level", "resolution_m": None}, {"resolution_m": (0.2, 0.4)}),
    ("needs the heights", NEW, [30], {"geocoded": "terrain"}, {"terrain": Terrain(np.zeros((9, 9)), (5.0, 5.0))}),
    ("`near` is for pictures", NEW, [30], {"geocoded": "level", "near": "top"}, {"near": None}),
    ("state the spacing", NEW + ",spacing", [30, ""], {"spacing_m": None}, {"spacing_m": (0.1, 0.3)}),
    ("state the grazing angle", NEW, [""], {}, {"grazing_deg": 30.0}),
    ("already exists", NEW, [30], {"overwrite": False}, {"overwrite": True}),
]

TIFFS = [[f"{n}.tif", azimuth, 30] for n, azimuth in enumerate(AZIMUTHS)]
HARMONICS = Harmonics(torch.zeros(9, 1), 0.1)
GROUND = np.full((6, 64, 64), 0.1)
GROUND[:, 28:36, 28:36] = 20.0
SPECKLED = GROUND * np.random.default_rng(0).exponential(size=GROUND.shape) + 1e-6
FOUR = GROUND * np.random.default_rng(0).gamma(4, 0.25, size=GROUND.shape)
BYTES = np.clip(np.round(20 * np.sqrt(SPECKLED)), 1, 255)
NOISE = np.random.default_rng(0).normal(size=(2, *GROUND.shape))
BLURRED = GROUND * (gaussian_filter(NOISE, (0, 0, 1, 1)) ** 2).sum(0)
UNITS: list[tuple[str, np.ndarray, dict[str, Any], dict[str, Any]]] = [
    ("square the values", np.sqrt(SPECKLED), {}, {"quantity": "amplitude"}),
    ("take the root of the values", SPECKLED, {"quantity": "amplitude"}, {"quantity": "power"}),
    ("double the decibels", 5 * np.log10(SPECKLED), {"quantity": "db"}, {"scale": 2.0}),
    ("halve the decibels", 20 * np.log10(SPECKLED), {"quantity": "db"}, {"scale": 0.5}),
    ("another number of `looks`", FOUR, {}, {"looks": 4.0}),
    ("give the number of `looks`", SPECKLED, {"looks": None}, {"looks": 1.0}),
    ("or looks=None", GROUND * np.random.default_rng(0).gamma(40, 1 / 40, GROUND.shape), {}, {"looks": None}),
    ("more than any radar image has", BYTES, {"quantity": "db"}, {"quantity": "amplitude"}),
    ("decibels in 8 bits", 2.5 * np.log10(SPECKLED) + 15, {"quantity": "db"}, {"scale": 4.0, "offset": -60.0}),
    ("`resolution_m`", BLURRED, {"resolution_m": (2.0, 2.0)}, {"resolution_m": (0.5, 0.5)}),
    (
        "on one scale",
        SPECKLED * (1000.0 ** (np.arange(6) % 2))[:, None, None],
        {},
        {"columns": {"scale": "x"}},
    ),
]
"""Words of a contradiction, numbers of six pictures, options, and those of the remedy."""


LORRY = ImageGrid(40, 36, (0.4, 0.35), (0.5, 0.45))
VIEWS = [View(float(azimuth), 30.0) for azimuth in range(0, 360, 30)]
ANGLES: list[tuple[str, bool, str, float, list[float], dict[str, Any], dict[str, Any]]] = [
    (
        "columns={'incidence'",
        False,
        "azimuth,x",
        0,
        [60],
        {"columns": {"grazing": "x"}},
        {"columns": {"incidence": "x"}},
    ),
    ("columns={'grazing'", False, "azimuth,x", 0, [30], {"columns": {"incidence": "x"}}, {"columns": {"grazing": "x"}}),
    ("`grazing_deg=30`", False, "azimuth", 0, [], {"grazing_deg": 60.0}, {"grazing_deg": 30.0}),
    ("without ground=False", False, "azimuth,grazing", 0, [30], {"ground": False}, {"ground": True}),
    ("seem to be geocoded", True, "azimuth,grazing", 90, [30], {}, {"geocoded": "level"}),
    ("interpolated to the map", True, "azimuth,grazing", 90, [30], {"geocoded": "level", "looks": 0.5}, {"looks": 1.0}),
    *(
        (
            f"look='{look}'",
            True,
            "x,grazing",
            turn,
            [30],
            {"geocoded": "level", "columns": {"azimuth": "x"}, "looks": 2.0},
            {"columns": {"heading": "x"}, "look": look},
        )
        for look, turn in (("right", 180), ("left", 0))
    ),
]
"""Words; whether pictures of a lorry are on a map; columns; degrees from azimuths to those given; cells; options."""


def _templates() -> Iterator[re.Pattern[str]]:
    """Sentences of these rooms that name an argument, as patterns."""
    for room in ("importers", "data", "exports", "examination", "gaussians"):
        for path in (ROOT / "src" / "sarsplat" / room).rglob("*.py"):
            tree = ast.parse(path.read_text())
            parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
            docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                match node:
                    case ast.JoinedStr(values):
                        text = "".join(str(v.value) if isinstance(v, ast.Constant) else "\0" for v in values)
                    case ast.Constant(str(text)) if id(node) not in parts | docs:
                        pass
                    case _:
                        continue
                if _ARGUMENT.search(text):
                    yield re.compile(re.escape(text).replace("\0", ".*"), re.DOTALL)


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _sentences(do: Callable[..., object], options: dict[str, Any]) -> list[str | SarsplatError]:
    """Warnings and assumptions, or the error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            source = getattr(do(**options), "source", {})
        except SarsplatError as error:
            return [error]
    return [*(str(one.message) for one in caught), *source.get("assumptions", ())]


@pytest.mark.usefixtures("undrawn")
def test_remedies_work_when_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sarsplat.examination.neighbouring_views._SAMPLES", 48)  # quicker
    said: list[str] = []
    failed: list[tuple[str, list[str], list[str | SarsplatError]]] = []

    def follow(words: str, do: Callable[..., object], options: dict[str, Any], remedy: dict[str, Any]) -> None:
        told = [*map(str, _sentences(do, options))]
        found = next((text for text in told if re.search(words, text)), "")
        said.append(found)
        left = _sentences(do, {**options, **remedy})
        named = any(f"`{name}" in found or f"{name}=" in found for name in remedy)
        if not named or any(isinstance(one, SarsplatError) or re.search(words, str(one)) for one in left):
            failed.append((words, told, left))

    for k, (words, names, cells, options, remedy) in enumerate(FOLDERS):
        rows = [[f"{n}.npy", a, *(n if cell == "{k}" else cell for cell in cells)] for n, a in enumerate(AZIMUTHS)]
        folder = write_pictures(_made(tmp_path / str(k)) / "in", POWER, rows, names)
        if words == "already exists":
            import_pictures(folder)
        follow(words, lambda folder=folder, **given: import_pictures(folder, **given), options, remedy)
    for pixels, wrong, right in ((10 * np.log10(POWER), "power", "db"), (POWER * 1e4, "db", "power")):
        folder = write_pictures(_made(tmp_path / wrong) / "in", pixels)
        follow(
            "as (power|db);",
            lambda folder=folder, **given: import_pictures(folder, **given),
            {"quantity": wrong},
            {"quantity": right},
        )
    signals = write_pictures(_made(tmp_path / "signals") / "in", POWER * np.exp(1j * PHASE))
    for k, (words, pixels, options, remedy) in enumerate(UNITS):
        rows = [[f"{n}.npy", 60 * n, 1000.0 ** -(n % 2)] for n in range(len(pixels))]
        folder = write_pictures(_made(tmp_path / f"unit{k}") / "in", pixels.astype(np.float32), rows, "file,azimuth,x")
        given = {"grazing_deg": 30.0, "calibration": "relative", "resolution_m": None, "spacing_m": (0.3, 0.3)}
        follow(words, partial(import_pictures, folder, **given), options, remedy)
    radar = add_speckle(
        np.stack(
            [
                simulate_raycast(lorry(), view, LORRY, ScatteringLaw(), ground_gamma0=0.05, ray_spacing=0.07)
                for view in VIEWS
            ]
        ),
        1.0,
        np.random.default_rng(0),
    )
    maps = [on_map(image, view, LORRY, 48, 0.3) for image, view in zip(radar, VIEWS, strict=True)]
    for k, (words, mapped, names, turn, cells, options, remedy) in enumerate(ANGLES):
        rows = [[f"{n}.npy", (view.azimuth_deg + turn) % 360, *cells] for n, view in enumerate(VIEWS)]
        folder = write_pictures(
            _made(tmp_path / f"angle{k}") / "in", np.array(maps) if mapped else radar, rows, f"file,{names}"
        )
        lengths = ((0.3, 0.3), (0.5, 0.45)) if mapped else (LORRY.spacing_m, LORRY.resolution_m)
        given = {"calibration": "relative", "spacing_m": lengths[0], "resolution_m": lengths[1]}
        follow(words, partial(import_pictures, folder, **given), options, remedy)
    stated = write_pictures(_made(tmp_path / "stated") / "in", POWER, ending="tif", rows=TIFFS)
    for n in range(4):
        (stated / f"{n}.json").write_text('{"scale_factor": 0.1, "radiometry": "sigma_nought"}')
    two = write_pictures(_made(tmp_path / "two") / "in", POWER)
    (two / "more.csv").write_text("file,azimuth")
    world = write_pictures(_made(tmp_path / "world") / "in", POWER, ending="tif", rows=TIFFS)
    (world / "0.tfw").touch()
    middle = np.pad(POWER[:, 6:-6, 8:-8], [(0, 0), (6, 6), (8, 8)])
    corners = write_pictures(_made(tmp_path / "corners") / "in", middle)
    pulses = write(tmp_path / "a.mat", record(circle(np.linspace(10, 14, 80)), [(0.5, 0.5, 0.0)]))
    chips = _made(tmp_path / "chips")
    write_chips(chips, ROWS)
    place = Place(48.0, 11.0, 500.0)
    some = Run.from_gaussians(Gaussians(torch.rand(9, 3), torch.ones(9, 4), torch.ones(9, 3), torch.ones(9), HARMONICS))
    radar = write_rslc(tmp_path / "a.h5", {"HH": np.ones((40, 30), np.complex64)})
    sicd = write_sicd(tmp_path / "a.nitf", Track(), [(0.0, 0.0, 0.0)], Recording())
    passes = write_passes(tmp_path / "passes", NOISY, THREE)
    table = passes / "passes.csv"
    table.write_text(table.read_text().replace("view", "shot"))
    safe = _made(tmp_path / "a.SAFE")
    (safe / "manifest.safe").touch()
    views = [View(azimuth, 40.0) for azimuth in AZIMUTHS]
    maps = write_maps(tmp_path / "maps", POWER, views, ImageGrid(20, 26, (0.5, 0.5), (0.5, 0.5)), 16, 0.5)
    out: dict[str, Any] = {"out": tmp_path / "out", "overwrite": True}
    antenna = circle(np.linspace(10, 14, 80))
    antenna[:, 2] += np.linspace(0, 60, 80)
    climbing = write(tmp_path / "climbing.mat", record(antenna, [(0.5, 0.5, 0.0)]))
    flown = partial(import_phase_history, [pulses], size_m=2.0, **out)
    echo, arc_m = [((0.0, 0.0, 0.0), 1.0)], arc(200.0, 4.0, 80)
    cphd = write_cphd(tmp_path / "a.cphd", Collection(arc_m), echo)
    strip = write_cphd(
        tmp_path / "strip.cphd", Collection(arc_m, dwell=(0.04, 5e-4, 0.04), swath=90.0, samples=400), echo
    )
    two_channels = write_cphd(tmp_path / "two.cphd", Collection(arc_m, channels=("a", "b")), echo)
    both = write_originals(_made(tmp_path / "both"))
    write_chips(both, ROWS)
    more = _made(tmp_path / "more")
    write_chips(more, [*ROWS, *(("T72", "132", 15, azimuth) for azimuth in (50, 140, 190, 240, 290, 340))])
    b = write_rslc(tmp_path / "b.h5", {"HH": np.ones((40, 30), np.complex64)})
    with h5py.File(b, "a") as file:
        file.copy(IMAGES, f"{SWATHS}/frequencyB")
    ahead = write_sicd(tmp_path / "ahead.nitf", Track(squint=12), [(0.0, 0.0, 0.0)], Recording())
    hills = read_terrain(
        write_geotiff(
            tmp_path / "hills.tif", np.zeros((60, 40), np.float32), (1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32633)
        )
    )
    points = {"points": np.random.default_rng(0).uniform(-5, 5, (500, 3)).astype(np.float32)}
    points |= {"normals": np.tile([[0, 0, 1]], (500, 1)).astype(np.float32), "points_gamma0": np.ones(500, np.float32)}

    def exported(name: str, place: Place | None = None, terrain: Terrain | None = None, **options: Any) -> None:
        if terrain is not None:
            place = import_pictures(signals, quantity="complex", terrain=terrain).place
        run = replace(some, place=place)
        vars(run).update(points)
        export(run, tmp_path / name, **options)

    for do, words, options, remedy in (
        (
            partial(import_pictures, resolution_m=(0.5, 0.4), spacing_m=None),
            "SAFE",
            {"folder": safe},
            {"folder": maps, "geocoded": "terrain", "terrain": Terrain(np.zeros((9, 9)), (5.0, 5.0))},
        ),
        (partial(import_pictures, maps, spacing_m=None), "is geocoded", {}, {"geocoded": "level"}),
        (import_pictures, "world file", {"folder": world}, {"folder": maps, "geocoded": "level", "spacing_m": None}),
        (partial(import_pictures, stated), "do not belong together", {}, {"scale": 1.0}),
        (
            partial(import_pictures, stated, scale=1.0),
            "says that it holds",
            {"backscatter": "gamma0"},
            {"backscatter": "beta0"},
        ),
        (partial(import_pictures, signals), "give `quantity='complex'`", {}, {"quantity": "complex"}),
        (partial(import_pictures, two), "has 2 tables", {}, {"table": two / "angles.csv"}),
        (partial(import_pictures, corners), "that reach from its corners", {}, {"ground": False}),
        (partial(import_phase_history, [climbing], size_m=2.0, **out), "is inclined", {}, {"tilted": True}),
        (flown, "leave out `place`", {"place": (48.0, 11.0)}, {"place": None}),
        (flown, "has no channels", {"channel": "a"}, {"channel": None}),
        (partial(import_phase_history, [two_channels], size_m=2.0, **out), "several channels", {}, {"channel": "b"}),
        (
            partial(import_phase_history, [cphd], **out),
            "which does not contain",
            {"size_m": 2.0, "around_m": (500.0, 0.0, 0.0)},
            {"around_m": (0.0, 0.0, 0.0)},
        ),
        (partial(import_phase_history, [cphd], **out), "its pulses are referred to", {"size_m": 90.0}, {"size_m": 2.0}),
        (partial(import_phase_history, [strip], **out), "no pulses saw all", {"size_m": 100.0}, {"size_m": 2.0}),
        (flown, "an aperture of", {"aperture_deg": 9.0}, {"aperture_deg": 3.0}),
        (flown, "holds . of 80 pulses", {"aperture_deg": 0.01}, {"aperture_deg": 3.0}),
        (flown, "must be metres", {"around_m": (1e9, 0.0, 0.0)}, {"around_m": (0.2, 0.2, 0.0)}),
        (flown, "is not above", {"around_m": (0.0, 0.0, 5e3)}, {"around_m": (0.0, 0.0, 0.0)}),
        (flown, "frequencies in steps of", {"around_m": (40.0, 0.0, 0.0)}, {"around_m": (0.0, 0.0, 0.0)}),
        (flown, "pulses so far apart show", {"size_m": 7.0}, {"size_m": 2.0}),
        (partial(import_chips, chips), "`train_views` is", {"train_views": 0}, {"train_views": 4}),
        (partial(import_chips, chips), "no chips at the", {"train_depression": 40}, {"train_depression": 17}),
        (partial(import_chips, more), "add 15 to", {"train_views": 9}, {"train_depression": (17, 15)}),
        (partial(import_chips, both), "also contains JPEG", {"labels": None}, {"labels": both / "labels.csv"}),
        (partial(import_chips, chips), "give the table", {"labels": None}, {"labels": chips / "labels.csv"}),
        (partial(export, some, tmp_path / "a.ply"), "will hold the scene's", {"crs": "EPSG:32632"}, {"crs": None}),
        (partial(exported, "a.las"), "no georeference", {"crs": "EPSG:32633"}, {"terrain": hills}),
        (partial(exported, "a.tif"), "finer than the points", {"pixel_m": 0.001}, {"pixel_m": 1.0}),
        (
            partial(exported, "layover-shadow.tif", view=View(0.0, 0.001)),
            "is too large",
            {"pixel_m": 1.0},
            {"pixel_m": 1e5},
        ),
        *(
            (partial(exported, "a.las", where), words, {"crs": crs}, {"crs": right})
            for where, words, crs, right in (
                (Place(10.0, 180.0, 5.0), "cut in two", "EPSG:3857", "EPSG:32601"),
                (Place(40.0, 10.0, 5.0), "another datum", "EPSG:26718", "EPSG:32632"),
            )
        ),
        (partial(export, some, tmp_path / "dsm-1.tif"), "is ambiguous", {}, {"content": "dsm"}),
        *(
            (partial(MapSystem.of, place), words, {"crs": crs}, {"crs": "EPSG:32632"})
            for words, crs in (
                ("not a known", "EPSG:1"),
                ("not in metres", "EPSG:4326"),
                ("which is for", "EPSG:3031"),
                ("cannot show", "+proj=gnom +lat_0=-90"),
            )
        ),
        (partial(import_rslc, radar, **out), "is outside", {"size_m": 50.0, "pixel": (99, 3)}, {"pixel": (20, 14)}),
        (partial(import_rslc, radar, **out), "are asked for", {"size_m": 300.0}, {"size_m": 50.0}),
        (partial(import_rslc, radar, **out), "makes", {"size_m": 1.0}, {"size_m": 50.0}),
        (partial(import_rslc, radar, **out), "grid of the file", {"size_m": 50.0, "height_m": 9e4}, {"height_m": 0.0}),
        (
            partial(import_rslc, radar, **out),
            "has no 'LSAR/frequencyB'",
            {"size_m": 50.0, "images": "LSAR/frequencyB"},
            {"images": "LSAR/frequencyA"},
        ),
        (partial(import_rslc, b, **out), "frequencyB .*is left out", {"size_m": 50.0}, {"images": "LSAR/frequencyB"}),
        (partial(import_sicd, [ahead], size_m=30.0, **out), "is tilted about", {}, {"tilted": True}),
        (
            partial(import_sicd, [sicd], **out),
            "both",
            {"size_m": 30.0, "around": SPOT, "pixel": (9, 9)},
            {"pixel": None},
        ),
        (partial(import_sicd, [sicd], **out), "are asked for", {"size_m": 900.0}, {"size_m": 30.0}),
        (partial(import_sicd, [sicd], **out), "is one file", {"size_m": 30.0, "stack": True}, {"stack": False}),
        (
            partial(import_stack, passes, wavelength_m=0.03, spacing_m=(0.5, 0.4), **out),
            "lacks a column of views",
            {"columns": None},
            {"columns": {"view": "shot"}},
        ),
    ):
        follow(words, do, options, remedy)
    assert not failed, "\n".join(map(str, failed))
    unmatched = [pattern.pattern for pattern in _templates() if not any(pattern.search(text) for text in said)]
    assert [text for text in unmatched if not any(re.escape(words) in text for words in NOT_RUN)] == []
