"""Remedies of sentences that name an argument are followed, and end in a dataset."""

from __future__ import annotations

import ast
import re
import tempfile
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
from sarsplat.examination import contradictions
from sarsplat.examination.outcome import Examination
from sarsplat.exports import MapSystem, export
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, Place, Terrain, View
from sarsplat.importers import import_phase_history, import_rslc, import_sicd, import_stack
from sarsplat.runs import Run
from sicds import SPOT, Recording, Track, write_sicd

NOT_RUN = {
    "which way the table counts azimuths decides": "a note, which names no remedy",
    "give a larger `pixel_m`, such as": "needs a lack of memory; followed in the tests of exports",
}
"""Words of sentences with an argument whose remedy is not followed here, and why."""
_ARGUMENT = re.compile(r"`[a-z_]+(=[^`]*)?`|`[a-z_]+=|\w=(True|False|None|'\w+')")

Case = tuple[str, str, list[Any], dict[str, Any], dict[str, Any]]
"""Words of the sentence, names of columns, cells of a row after file and azimuth, options, and those of the remedy."""
NEW, HEADING, TRACK = (f"file,{name},grazing" for name in ("azimuth", "heading", "track"))
LEFT = {"look": "left"}
FOLDERS: list[Case] = [
    ("replaces the table", NEW, [30], {"names": "{azimuth}.npy"}, {"names": None}),
    ("columns in braces, each once", NEW, [30], {"names": "{az}_{az}.npy"}, {"names": None}),
    ("several columns that may be the azimuth", "file,azim,grazing,az", [30, 0], {}, {"columns": {"az": "azim"}}),
    ("like the grazing", "file,azimuth,x", [30], {}, {"grazing_deg": 30.0}),
    ("like the grazing", "file,azimuth,x", [30], {}, {"columns": {"incidence": "x"}}),
    ("like the spacing", NEW, [30], {"spacing_m": None}, {"spacing_m": (0.1, 0.3)}),
    ("direction of flight", TRACK, [30], {"columns": {"az": "track"}}, {"columns": {"heading": "track"}, **LEFT}),
    ("north by its name", "file,north,grazing", [30], {"columns": {"az": "north"}}, {"azimuth_offset_deg": 0.0}),
    ("side to which the radar looks", HEADING, [30], {}, {"look": "right"}),
    ("to which side", HEADING + ",look", [30, ""], {}, {"look": "right"}),
    ("run clockwise", HEADING, [30], {**LEFT, "counter_clockwise": True}, {"counter_clockwise": False}),
    ("in the direction", NEW + ",heading,look", [30, 45, "left"], {}, {"columns": {"azimuth": "azimuth"}}),
    ("in the direction", NEW + ",heading,look", [30, 45, "left"], {}, {"columns": {"heading": "heading"}}),
    ("near range of", NEW + ",near_side", [30, "left"], {"near": "top"}, {"near": None}),
    ("scales pictures by", NEW + ",scale_factor", [30, 2], {}, {"quantity": "amplitude"}),
    ("scales pictures by", NEW + ",scale_factor", [30, 2], {}, {"columns": {"scale": "scale_factor"}}),
    ("not used; if it holds", NEW + ",gain", [30, 2], {}, {"columns": {"scale": "gain"}}),
    ("not used; if it holds", NEW + ",gain", [30, 2], {}, {"columns": {"calibration-factor": "gain"}}),
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
    ("on one scale", SPECKLED * (1e3 ** (np.arange(6) % 2))[:, None, None], {}, {"columns": {"scale": "x"}}),
]
"""Words of a contradiction, numbers of six pictures, options, and those of the remedy."""


SUGGESTED = {"pixel_m": 0.0}
"""The number that the sentence names, and a little more for its rounding."""
UTM = (1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32633)
LORRY = ImageGrid(40, 36, (0.4, 0.35), (0.5, 0.45))
VIEWS = [View(float(azimuth), 30.0) for azimuth in range(0, 360, 30)]
BY_INCIDENCE, BY_GRAZING = ({"columns": {name: "x"}} for name in ("incidence", "grazing"))
GEOCODED = {"geocoded": "level"}
BEARINGS = {**GEOCODED, "columns": {"azimuth": "x"}, "looks": 2.0}
ANGLES: list[tuple[str, bool, str, float, list[float], dict[str, Any], dict[str, Any]]] = [
    ("columns={'incidence'", False, "azimuth,x", 0, [60], BY_GRAZING, BY_INCIDENCE),
    ("columns={'grazing'", False, "azimuth,x", 0, [30], BY_INCIDENCE, BY_GRAZING),
    ("`grazing_deg=30`", False, "azimuth", 0, [], {"grazing_deg": 60.0}, {"grazing_deg": 30.0}),
    ("without ground=False", False, "azimuth,grazing", 0, [30], {"ground": False}, {"ground": True}),
    ("seem to be geocoded", True, "azimuth,grazing", 90, [30], {}, GEOCODED),
    ("interpolated to the map", True, "azimuth,grazing", 90, [30], {**GEOCODED, "looks": 0.5}, {"looks": 1.0}),
    ("look='right'", True, "x,grazing", 180, [30], BEARINGS, {"columns": {"heading": "x"}, "look": "right"}),
    ("look='left'", True, "x,grazing", 0, [30], BEARINGS, {"columns": {"heading": "x"}, "look": "left"}),
]
"""Words; whether pictures of a lorry are on a map; columns; degrees from azimuths to those given; cells; options."""


def _templates() -> Iterator[re.Pattern[str]]:
    """Sentences of these rooms that name an argument, as patterns."""
    for room in ("importers", "data", "exports", "examination", "gaussians"):
        for path in (ROOT / "src" / "sarsplat" / room).rglob("*.py"):
            nodes = [*ast.walk(ast.parse(path.read_text()))]
            parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
            docs = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
            for node in nodes:
                match node:
                    case ast.JoinedStr(values):
                        text = "".join(str(v.value) if isinstance(v, ast.Constant) else "\0" for v in values)
                    case ast.Constant(str(text)) if id(node) not in parts | docs:
                        pass
                    case _:
                        continue
                if _ARGUMENT.search(text):
                    yield re.compile(re.escape(text).replace("\0", ".*"), re.DOTALL)


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
        if remedy is SUGGESTED:
            remedy = {"pixel_m": 1.01 * float(re.findall(r"pixel_m(?:=|`, such as )([\d.e+]+)", found)[0])}
        left = _sentences(do, {**options, **remedy})
        named = any(f"`{name}" in found or f"{name}=" in found for name in remedy)
        if not named or any(isinstance(one, SarsplatError) or re.search(words, str(one)) for one in left):
            failed.append((words, told, left))

    def folder(pixels: Any = POWER, *table: Any, **more: Any) -> Path:
        return write_pictures(Path(tempfile.mkdtemp(dir=tmp_path)) / "in", np.asarray(pixels), *table, **more)

    examine = contradictions.examine
    monkeypatch.setattr(contradictions, "examine", lambda dataset: Examination())  # where no sentence is of it
    for words, names, cells, options, remedy in FOLDERS:
        rows = [[f"{n}.npy", a, *(n if cell == "{k}" else cell for cell in cells)] for n, a in enumerate(AZIMUTHS)]
        made = folder(POWER, rows, names)
        if words == "already exists":
            import_pictures(made)
        follow(words, partial(import_pictures, made), options, remedy)
    for pixels, wrong, right in ((10 * np.log10(POWER), "power", "db"), (POWER * 1e4, "db", "power")):
        follow("as (power|db);", partial(import_pictures, folder(pixels)), {"quantity": wrong}, {"quantity": right})
    monkeypatch.setattr(contradictions, "examine", examine)
    given: dict[str, Any] = {"calibration": "relative", "resolution_m": None, "spacing_m": (0.3, 0.3)}
    rows = [[f"{n}.npy", 60 * n, 1000.0 ** -(n % 2)] for n in range(6)]
    for words, pixels, options, remedy in UNITS:
        made = folder(pixels.astype(np.float32), rows, "file,azimuth,x")
        follow(words, partial(import_pictures, made, **given, grazing_deg=30.0), options, remedy)
    law, view_of = ScatteringLaw(), partial(simulate_raycast, lorry(), grid=LORRY, ground_gamma0=0.05, ray_spacing=0.07)
    lorries = add_speckle(np.stack([view_of(view, law=law) for view in VIEWS]), 1.0, np.random.default_rng(0))
    mapped = [on_map(image, view, LORRY, 48, 0.3) for image, view in zip(lorries, VIEWS, strict=True)]
    for words, on_maps, names, turn, cells, options, remedy in ANGLES:
        rows = [[f"{n}.npy", (view.azimuth_deg + turn) % 360, *cells] for n, view in enumerate(VIEWS)]
        made = folder(mapped if on_maps else lorries, rows, f"file,{names}")
        given["resolution_m"], given["spacing_m"] = LORRY.resolution_m, (0.3, 0.3) if on_maps else LORRY.spacing_m
        follow(words, partial(import_pictures, made, **given), options, remedy)
    monkeypatch.setattr(contradictions, "examine", lambda dataset: Examination())
    signals, two = folder(POWER * np.exp(1j * PHASE)), folder()
    stated, world = (folder(POWER, TIFFS, ending="tif") for _ in range(2))
    corners = folder(np.pad(POWER[:, 6:-6, 8:-8], [(0, 0), (6, 6), (8, 8)]))
    for n in range(3):
        (stated / f"{n}.json").write_text('{"scale_factor": 0.1, "radiometry": "sigma_nought"}')
    (two / "more.csv").write_text("file,azimuth")
    (world / "0.tfw").touch()
    (tmp_path / "a.SAFE").mkdir()
    (tmp_path / "a.SAFE/manifest.safe").touch()
    views = [View(azimuth, 40.0) for azimuth in AZIMUTHS]
    maps = write_maps(tmp_path / "maps", POWER, views, ImageGrid(20, 26, (0.5, 0.5), (0.5, 0.5)), 16, 0.5)
    level = Terrain(np.zeros((9, 9)), (5.0, 5.0))
    on_terrain = {"folder": maps, "geocoded": "terrain", "terrain": level, "resolution_m": (0.5, 0.4)}
    antenna, echo = circle(np.linspace(10, 14, 80)), [((0.5, 0.5, 0.0), 1.0)]
    climbing = antenna + np.linspace(0, 60, 80)[:, None] * [0, 0, 1]
    mats = [write(tmp_path / f"{k}.mat", record(flight, [echo[0][0]])) for k, flight in enumerate((antenna, climbing))]
    cphds = [
        write_cphd(tmp_path / f"{k}.cphd", Collection(arc(200.0, 4.0, 80), **options), echo)
        for k, options in enumerate(
            ({}, {"channels": ("a", "b")}, {"dwell": (0.04, 5e-4, 0.04), "swath": 90.0, "samples": 400})
        )
    ]
    chips, both, more = (tmp_path / name for name in ("chips", "both", "more"))
    write_originals(both)
    for one, rows in (
        (chips, ROWS),
        (both, ROWS),
        (more, [*ROWS, *(("T72", "132", 15, azimuth) for azimuth in (50, 140, 190, 240, 290, 340))]),
    ):
        one.mkdir(exist_ok=True)
        write_chips(one, rows)
    place = Place(48.0, 11.0, 500.0)
    some = Run.from_gaussians(Gaussians(torch.rand(9, 3), torch.ones(9, 4), torch.ones(9, 3), torch.ones(9), HARMONICS))
    radar, bands = (write_rslc(tmp_path / name, {"HH": np.ones((40, 30), np.complex64)}) for name in ("a.h5", "b.h5"))
    with h5py.File(bands, "a") as file:
        file.copy(IMAGES, f"{SWATHS}/frequencyB")
    sicd, ahead = (
        write_sicd(tmp_path / f"{squint}.nitf", Track(squint=squint), [(0.0, 0.0, 0.0)], Recording())
        for squint in (0.0, 12.0)
    )
    passes = write_passes(tmp_path / "passes", NOISY, THREE)
    table = passes / "passes.csv"
    table.write_text(table.read_text().replace("view", "shot"))
    hills = read_terrain(write_geotiff(tmp_path / "hills.tif", np.zeros((60, 40), np.float32), UTM))
    up = np.tile([[0, 0, 1]], (500, 1)).astype(np.float32)
    points = {"points": np.random.default_rng(0).uniform(-5, 5, (500, 3)).astype(np.float32), "normals": up}

    def exported(name: str, place: Place | None = None, terrain: Terrain | None = None, **options: Any) -> None:
        if terrain is not None:
            place = import_pictures(signals, quantity="complex", terrain=terrain).place
        run = replace(some, place=place)
        vars(run).update(points)
        export(run, tmp_path / name, **options)

    new: dict[str, Any] = {"out": tmp_path / "out", "overwrite": True}
    flown, rslc = partial(import_phase_history, size_m=2.0, **new), partial(import_rslc, radar, size_m=50.0, **new)
    mat, cphd = partial(flown, mats[:1]), partial(flown, cphds[:1])
    slant, stack = partial(import_sicd, size_m=12.0, **new), partial(import_stack, passes, wavelength_m=0.03, **new)
    for do, words, options, remedy in (
        (partial(import_pictures, spacing_m=None), "SAFE", {"folder": tmp_path / "a.SAFE"}, on_terrain),
        (partial(import_pictures, maps, spacing_m=None), "is geocoded", {}, GEOCODED),
        (import_pictures, "world file", {"folder": world}, {"folder": maps, "spacing_m": None, **GEOCODED}),
        (partial(import_pictures, stated), "do not belong together", {}, {"scale": 1.0}),
        (partial(import_pictures, stated, scale=1.0), "says that", {"backscatter": "gamma0"}, {"backscatter": "beta0"}),
        (partial(import_pictures, signals), "give `quantity='complex'`", {}, {"quantity": "complex"}),
        (partial(import_pictures, two), "has 2 tables", {}, {"table": two / "angles.csv"}),
        (partial(import_pictures, stated, quantity="amplitude"), "file does not either", {}, {"scale": 1.0}),
        (partial(import_pictures, corners), "that reach from its corners", {}, {"ground": False}),
        (partial(flown, mats[1:]), "is inclined", {}, {"tilted": True}),
        (mat, "leave out `place`", {"place": (48.0, 11.0)}, {"place": None}),
        (mat, "has no channels", {"channel": "a"}, {"channel": None}),
        (mat, "an aperture of", {"aperture_deg": 9.0}, {"aperture_deg": 3.0}),
        (mat, "holds . of 80 pulses", {"aperture_deg": 0.01}, {"aperture_deg": 3.0}),
        (mat, "must be metres", {"around_m": (1e9, 0.0, 0.0)}, {"around_m": (0.2, 0.2, 0.0)}),
        (mat, "is not above", {"around_m": (0.0, 0.0, 5e3)}, {"around_m": (0.0, 0.0, 0.0)}),
        (mat, "its pulses are referred to", {"around_m": (40.0, 0.0, 0.0)}, {"around_m": (0.0, 0.0, 0.0)}),
        (mat, "pulses so far apart show", {"size_m": 7.0}, {"size_m": 2.0}),
        (cphd, "which does not contain", {"around_m": (500.0, 0.0, 0.0)}, {"around_m": (0.0, 0.0, 0.0)}),
        (cphd, "its pulses are referred to", {"size_m": 90.0}, {"size_m": 2.0}),
        (partial(flown, cphds[1:2]), "several channels", {}, {"channel": "b"}),
        (partial(flown, cphds[2:]), "no pulses saw all", {"size_m": 100.0}, {"size_m": 2.0}),
        (partial(import_chips, chips), "`train_views` is", {"train_views": 0}, {"train_views": 4}),
        (partial(import_chips, chips), "no chips at the", {"train_depression": 40}, {"train_depression": 17}),
        (partial(import_chips, more), "add 15 to", {"train_views": 9}, {"train_depression": (17, 15)}),
        (partial(import_chips, both), "also contains JPEG", {"labels": None}, {"labels": both / "labels.csv"}),
        (partial(import_chips, chips), "give the table", {"labels": None}, {"labels": chips / "labels.csv"}),
        (partial(export, some, tmp_path / "a.ply"), "will hold the scene's", {"crs": "EPSG:32632"}, {"crs": None}),
        (partial(export, some, tmp_path / "dsm-1.tif"), "is ambiguous", {}, {"content": "dsm"}),
        (partial(exported, "a.las"), "no georeference", {"crs": "EPSG:32633"}, {"terrain": hills}),
        (partial(exported, "a.tif"), "finer than the points", {"pixel_m": 0.001}, SUGGESTED),
        *(
            (partial(MapSystem.of, where), words, {"crs": crs}, {"crs": right})
            for where, words, crs, right in (
                (place, "not a known", "EPSG:1", "EPSG:32632"),
                (place, "not in metres", "EPSG:4326", "EPSG:32632"),
                (place, "which is for", "EPSG:3031", "EPSG:32632"),
                (place, "cannot show", "+proj=gnom +lat_0=-90", "EPSG:32632"),
                (Place(40.0, 10.0, 5.0), "another datum", "EPSG:26718", "EPSG:32632"),
                (Place(10.0, 180.0, 5.0), "cut in two", "EPSG:3857", "EPSG:32601"),
            )
        ),
        (rslc, "is outside", {"pixel": (99, 3)}, {"pixel": (20, 14)}),
        (rslc, "are asked for", {"size_m": 300.0}, {"size_m": 50.0}),
        (rslc, "makes", {"size_m": 1.0}, {"size_m": 50.0}),
        (rslc, "grid of the file", {"height_m": 9e4}, {"height_m": 0.0}),
        (rslc, "has no 'LSAR/frequencyB'", {"images": "LSAR/frequencyB"}, {"images": "LSAR/frequencyA"}),
        (partial(import_rslc, bands, size_m=50.0, **new), "B .*is left out", {}, {"images": "LSAR/frequencyB"}),
        (partial(slant, [ahead]), "is tilted about", {}, {"tilted": True}),
        (partial(slant, [sicd]), "both", {"around": SPOT, "pixel": (9, 9)}, {"pixel": None}),
        (partial(slant, [sicd]), "are asked for", {"size_m": 900.0}, {"size_m": 12.0}),
        (partial(slant, [sicd]), "is one file", {"stack": True}, {"stack": False}),
        (stack, "lacks a column of views", {"spacing_m": (0.5, 0.4)}, {"columns": {"view": "shot"}}),
    ):
        follow(words, do, options, remedy)
    assert not failed, "\n".join(map(str, failed))
    unmatched = [pattern.pattern for pattern in _templates() if not any(pattern.search(text) for text in said)]
    assert [text for text in unmatched if not any(re.escape(words) in text for words in NOT_RUN)] == []
