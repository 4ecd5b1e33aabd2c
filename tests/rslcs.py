"""RSLC files for tests, in the layout that NISAR describes, written with h5py."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

ROOT = "science/LSAR/RSLC"
SWATHS = f"{ROOT}/swaths"
IMAGES = f"{SWATHS}/frequencyA"
GEOLOCATION = f"{ROOT}/metadata/geolocationGrid"
HALF = np.dtype([("r", "<f2"), ("i", "<f2")])
TIMES, RANGES = 100.0 + 5e-4 * np.arange(40), 8e5 + 6.0 * np.arange(30)
SPEED = 6800.0  # m/s


def write_rslc(path: Path, images: Mapping[str, np.ndarray], changed: Mapping[str, Any] = {}, look="Right") -> Path:
    """A file of images [40 azimuth times, 30 slant ranges] by transmitted and received polarisation.

    The radar is in the west, 60° above the horizon at the first slant range and 50° at the last. `changed` are values
    by the ends of their names; None leaves one out.
    """
    up = np.sin(np.radians([60.0, 50.0]))
    west = np.sqrt(1 - up**2) * np.ones((2, 2, 1))
    values = {
        f"{SWATHS}/zeroDopplerTime": TIMES,
        f"{SWATHS}/zeroDopplerTimeSpacing": 5e-4,
        f"{IMAGES}/slantRange": RANGES,
        f"{IMAGES}/slantRangeSpacing": 6.0,
        f"{IMAGES}/processedCenterFrequency": 1.25e9,
        f"{IMAGES}/processedAzimuthBandwidth": 1500.0,
        f"{IMAGES}/processedRangeBandwidth": 20e6,
        f"{IMAGES}/listOfPolarizations": np.array([*images], "S2"),
        f"{GEOLOCATION}/heightAboveEllipsoid": np.array([-500.0, 500.0]),
        f"{GEOLOCATION}/zeroDopplerTime": TIMES[[0, -1]],
        f"{GEOLOCATION}/slantRange": RANGES[[0, -1]],
        f"{GEOLOCATION}/losUnitVectorX": -west,
        f"{GEOLOCATION}/losUnitVectorY": 0 * west,
        f"{GEOLOCATION}/groundTrackVelocity": SPEED + 0 * west,
        **{f"{GEOLOCATION}/{name}": None for name in ("epsg", "coordinateX", "coordinateY")},
        "science/LSAR/identification/lookDirection": np.bytes_(look),
        "science/LSAR/identification/missionId": np.bytes_("NONE"),
        **{f"{IMAGES}/{name}": image for name, image in images.items()},
    }
    with h5py.File(path, "w") as file:
        for name, value in values.items():
            value = next((new for end, new in changed.items() if name.endswith(end)), value)
            if value is not None:
                file[name] = value
    return path


def halves(image: np.ndarray) -> np.ndarray:
    """In pairs of 16-bit floats, as NISAR stores them."""
    made = np.empty(image.shape, HALF)
    made["r"], made["i"] = image.real, image.imag
    return made
