"""Made-up inputs of tests: datasets, targets, terrain, Gaussians, files."""

import csv
import io
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import tifffile
import torch
from torch import Tensor

from sarsplat import ImageGrid, Stack, Terrain, View, preset, simulate_images
from sarsplat.data import Dataset, DatasetEntry, write_dataset
from sarsplat.gaussians import Gaussians, Harmonics, Scattering

FEW_POINTS = replace(preset("default").points, voxel=0.3, rays_per_pixel=2.0)
"""Of small targets: points and their normals would otherwise take ten times as long as a short training."""

SMALL = ImageGrid(16, 12, (0.3, 0.3), (0.4, 0.4))
TINY = ImageGrid(6, 5, (0.2, 0.3), (0.25, 0.35), (1.0, -2.0))
VIEWS = [
    (View(0.1, 15.0), "train"),
    (View(-45.0, 30.0), "test-17"),
    (View(400.0, 75.0), "train"),
    (View(90.0, 17.09375), "test"),
]
NOISE = np.random.default_rng(1).gamma(1.0, size=(4, 6, 5)).astype(np.float32)
SIGNALS = (np.random.default_rng(2).normal(size=(4, 6, 5, 2)) @ [1, 1j]).astype(np.complex64)


# ---- datasets --------------------------------------------------------------------------------------------------------
def dataset_of(
    grid: ImageGrid, views: Sequence[tuple[View, str]], images: np.ndarray, *, stack: Stack | None = None, **fields: Any
) -> Dataset:
    """Dataset in memory, with phases if images have them or are stacks; images are named 000, 001 …"""
    entries = tuple(DatasetEntry(view, split, f"{index:03d}", stack=stack) for index, (view, split) in enumerate(views))
    return (Dataset.of_complex if np.iscomplexobj(images) else Dataset)(grid, entries, images, **fields)


def small_dataset(**fields: Any) -> Dataset:
    """Three images of 16 × 12 pixels of 0.3 m, one to train on."""
    views = [(View(0, 30), "train"), (View(90, 30), "test"), (View(180, 30), "test")]
    return dataset_of(SMALL, views, np.ones((3, 16, 12), np.float32), ground=True, **fields)


def small_mask() -> np.ndarray:
    """For such an image: a target above its shadow, left of the middle."""
    found = np.zeros((16, 12), np.uint8)
    found[5:8, 2:6], found[8:12, 2:6] = 1, 2
    return found


def tiny_dataset(
    images: np.ndarray = NOISE, *, grid: ImageGrid = TINY, views: Sequence[tuple[View, str]] = VIEWS, **fields: Any
) -> Dataset:
    """Four images of 6 × 5 uneven pixels, of three sets."""
    return dataset_of(grid, views, images, **{"source": {"kind": "made up"}, **fields})


def box_dataset(folder: Path, grid: ImageGrid, *, masks: bool = False) -> Dataset:
    """A box on the ground, seen from twelve sides and two others, by ray casting."""
    pytest.importorskip("embreex")
    from sarsplat.scenes.raycast import raycast_masks

    mesh = boxes(((3.0, 2.0, 1.2), (0, 0, 0.6)))
    views = [(View(azimuth, grazing), "train") for azimuth in range(0, 360, 60) for grazing in (20.0, 50.0)]
    views += [(View(azimuth, 35.0), "test") for azimuth in (30, 200)]
    alone = [view for view, _ in views]
    made = dataset_of(grid, views, simulate_images(mesh, alone, grid), source={"kind": "raycast"})
    true = raycast_masks(mesh, alone, grid) if masks else None
    return write_dataset(folder / "dataset", made, truth_mesh=mesh, masks=true)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((one & other).sum() / (one | other).sum())


# ---- targets, terrain, Gaussians -------------------------------------------------------------------------------------
def lorry(scale: float = 1.0) -> Any:
    """A long box with a cabin at one end and a mast, of no symmetry, larger or smaller."""
    pytest.importorskip("embreex")  # by which images of it are made
    parts = ((6, 2, 1), (0, 0, 0.5)), ((1.5, 1.8, 1.2), (2.2, 0, 1.6)), ((0.8, 0.8, 1), (-2, 0.6, 1.5))
    return boxes(*((np.multiply(sides, scale), np.multiply(middle, scale)) for sides, middle in parts))


def boxes(*parts: tuple[Any, Any]) -> Any:
    """Mesh of boxes: sides and middles, m."""
    trimesh = pytest.importorskip("trimesh")
    made = [trimesh.creation.box(sides).apply_translation(middle) for sides, middle in parts]
    return trimesh.util.concatenate(made) if len(made) > 1 else made[0]


def terrain(height, half_m: tuple[float, float] = (15.0, 15.0), pitch_m: tuple[float, float] = (0.5, 0.5)) -> Terrain:
    """Heights height(x, y) of a rectangle around the origin."""
    x, y = (np.arange(-half, half + pitch / 2, pitch) for half, pitch in zip(half_m, pitch_m, strict=True))
    return Terrain(np.broadcast_to(height(x[None, :], y[:, None]), (len(y), len(x))).astype(float), pitch_m)


def slope(degrees: float) -> Terrain:
    """A plane that falls along +x: its slope faces a radar at azimuth 0 if positive, and away from it if negative."""
    return terrain(lambda x, y: -math.tan(math.radians(degrees)) * x + 0 * y, (60.0, 60.0), (5.0, 4.0))


def hill(height_m: float = 2.5, at: tuple[float, float] = (1.0, 0.0), width_m: float = 1.5) -> Terrain:
    """A round hill on a slight slope."""
    return terrain(
        lambda x, y: height_m * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * width_m**2)) + 0.05 * x,
        (15.0, 12.0),
        (0.5, 0.4),
    )


def upright(
    means: np.ndarray | Tensor | list,
    scales: float | list | Tensor = 1.0,
    depth: float | list | Tensor = 1.0,
    law: Scattering | float | np.ndarray | Tensor = 1.0,
) -> Gaussians:
    """Unturned Gaussians at places [N, 3], m; other values of each, or of all, and harmonics or another law."""
    places = torch.as_tensor(means, dtype=torch.float32).reshape(-1, 3)
    n = len(places)
    sizes, depths = (torch.as_tensor(values, dtype=torch.float32) for values in (scales, depth))
    if not isinstance(law, Scattering):
        coefficients = torch.as_tensor(law, dtype=torch.float32)
        law = Harmonics(coefficients.expand(n, 1).clone() if coefficients.ndim == 0 else coefficients)
    turns = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    return Gaussians(places, turns, sizes.expand(n, 3).clone(), depths.expand(n).clone(), law)


# ---- files -----------------------------------------------------------------------------------------------------------
def in_memory(write: Callable[..., object], *arguments: Any, **options: Any) -> bytes:
    """What a function such as `numpy.save` writes to the open file that it is given first."""
    buffer = io.BytesIO()
    write(buffer, *arguments, **options)
    return buffer.getvalue()


def pack_glb(text: bytes, rest: bytes) -> bytes:
    """A binary glTF of this JSON, and chunks after it."""
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def read_table(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file with a header."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


PROJECTED = (1, 1, 0, 2, 1024, 0, 1, 1, 3076, 0, 1, 9001)
"""GeoTIFF keys of a projected system in metres."""


def write_geotiff(
    path: Path, heights: np.ndarray, keys=PROJECTED, scale=(2.0, 3.0, 0.0), extra=(), corner=(5e5, 5e6), **options
) -> Path:
    """What other programs write; the top left corner lies at `corner`."""
    tags = [(33922, "d", 6, (0.0, 0.0, 0.0, *corner, 0.0), True)]
    tags += [(33550, "d", 3, scale, True)] if scale else []
    tags += [(34735, "H", len(keys), keys, True)] if keys else []
    tifffile.imwrite(path, heights, metadata=None, extratags=[*tags, *extra], **options)
    return path


def sample_bytes(image: np.ndarray, azimuth: float, changes: dict[str, object] | None = None) -> bytes:
    """A file of the SAMPLE set, as its public description has it; a change to None leaves a variable out."""
    variables = {
        **{"complex_img": image, "complex_img_unshifted": image, "azimuth": azimuth, "elevation": 15.8},
        **{"center_freq": 9.6e9, "bandwidth": 591e6, "taylor_weights": 35.0, "aligned": 1.0},
        **{"range_pixel_spacing": 0.2021, "xrange_pixel_spacing": 0.2031},
        **{"range_resolution": 0.3047, "xrange_resolution": 0.3047},
        **{"target_name": "t72", "source_mstar_file": "HB19377.016", "explanation": "one line", **(changes or {})},
    }
    return in_memory(scipy.io.savemat, {name: value for name, value in variables.items() if value is not None})


def sample_path(folder: Path, azimuth: float, kind: str = "real", target: str = "t72") -> Path:
    """Where the set has it."""
    name = f"{target}_{kind}_A_elevDeg_016_azCenter_{round(azimuth):03d}_77_serial_812.mat"
    return folder / "mat_files" / kind / target / name


def write_sample(
    folder: Path,
    image: np.ndarray,
    azimuth: float,
    kind: str = "real",
    target: str = "t72",
    changes: dict[str, object] | None = None,
) -> None:
    """Write one file in its place."""
    path = sample_path(folder, azimuth, kind, target)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(sample_bytes(image, azimuth, changes))
