"""Files as the public description of the SAMPLE set has them: names and variables."""

import io
from pathlib import Path

import numpy as np
import scipy.io


def sample_bytes(image: np.ndarray, azimuth: float, changes: dict[str, object] | None = None) -> bytes:
    """One file; a change to None leaves a variable out."""
    variables = {
        "complex_img": image,
        "complex_img_unshifted": image,
        "azimuth": azimuth,
        "elevation": 15.8,
        "center_freq": 9.6e9,
        "bandwidth": 591e6,
        "taylor_weights": 35.0,
        "range_pixel_spacing": 0.2021,
        "xrange_pixel_spacing": 0.2031,
        "range_resolution": 0.3047,
        "xrange_resolution": 0.3047,
        "target_name": "t72",
        "source_mstar_file": "HB19377.016",
        "aligned": 1.0,
        "explanation": "one line",
        **(changes or {}),
    }
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {name: value for name, value in variables.items() if value is not None})
    return buffer.getvalue()


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
    """One file in its place."""
    path = sample_path(folder, azimuth, kind, target)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(sample_bytes(image, azimuth, changes))
