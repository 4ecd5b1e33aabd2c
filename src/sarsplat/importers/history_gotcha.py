"""Phase history in the layout of AFRL's GOTCHA volumetric data set: MATLAB files with one record `data`.

Its fields: `fp`, samples [frequency, pulse]; `freq`, Hz; `x`, `y`, `z`, the antenna, m; `r0`, its distance from the
scene centre, where x = y = z = 0; `af`, from an autofocus: `r_correct`, to be added to `r0`, and `ph_correct`,
to be added to the samples' phases. These two belong together: `ph_correct` brings back most of the phase that a longer
`r0` takes away at mid-band, so that either alone blurs the image more than neither. `th` and `phi` repeat x, y and z.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError
from sarsplat.importers.files import raise_damaged
from sarsplat.importers.histories import PhaseHistoryFormat
from sarsplat.importers.mat import read_mat
from sarsplat.importers.phase_history import SPEED_OF_LIGHT, PhaseHistory

_UNEVEN = 0.01  # maximum deviation of frequencies from even spacing, in steps; single precision costs 0.03 %


def read_gotcha(path: str | Path) -> PhaseHistory:
    """Read one file, and apply the autofocus that it states.

    Raises if it is no MATLAB 5 file, a field is missing or of the wrong kind, sizes contradict each other, `r0` is not
    the distance from the scene centre, or a number is not finite.
    """
    path = Path(path)
    record = read_mat(path).get("data")
    if not isinstance(record, dict):
        raise SarsplatError(f"{path} holds no record named data; give files of GOTCHA's layout")
    samples = _array(path, record, "fp", "c")
    if samples.ndim != 2:
        raise_damaged(path, f"has a field fp of the shape {samples.shape}, not frequencies × pulses")
    antenna = np.stack([_of_pulses(path, record, name, samples.shape[1]) for name in "xyz"], axis=1)
    reference = _of_pulses(path, record, "r0", samples.shape[1])
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused
        samples, reference = _focused(path, record, samples, reference)
        samples = samples.astype(np.complex64)
    first, step = _band(path, record, samples)
    pulses = samples.shape[1]
    history = PhaseHistory(str(path), np.full(pulses, first), np.full(pulses, step), antenna, reference, samples)
    off = np.abs(np.linalg.norm(antenna, axis=1) - _line(path, record, "r0")).max()
    if off > SPEED_OF_LIGHT / (2 * history.bandwidth_hz):
        raise SarsplatError(
            f"{path} has antenna positions whose distance from the scene centre differs from r0 by {off:.3g} m, more "
            "than a range cell; only data with the scene centre at x = y = z = 0 are supported"
        )
    return history


def _band(path: Path, record: dict[str, Any], samples: np.ndarray) -> tuple[float, float]:
    """Return the lowest frequency and the step between frequencies, which must rise evenly."""
    values = _line(path, record, "freq")
    count = len(values)
    if count != len(samples) or count < 2 or not np.isfinite(values).all():
        raise_damaged(path, f"has {count} frequencies, or some that are not finite, for samples of {len(samples)}")
    steps, step = np.diff(values), float(values[-1] - values[0]) / (count - 1)
    even = np.linspace(values[0], values[-1], count)
    if steps.min() <= 0 or np.abs(values - even).max() > _UNEVEN * step:
        raise SarsplatError(
            f"{path} has frequencies in steps of {steps.min():g} to {steps.max():g} Hz; only rising, evenly spaced "
            "ones are supported"
        )
    return float(values[count // 2]) - count // 2 * step, step  # exact in the middle


def _focused(
    path: Path, record: dict[str, Any], samples: np.ndarray, reference: Float64[np.ndarray, " pulses"]
) -> tuple[np.ndarray, Float64[np.ndarray, " pulses"]]:
    """Apply the autofocus, if there is one, to samples and reference ranges."""
    autofocus = record.get("af")
    if not isinstance(autofocus, dict):
        return samples, reference
    distance, phase = (_of_pulses(path, autofocus, name, samples.shape[1]) for name in ("r_correct", "ph_correct"))
    return samples * np.exp(1j * phase), reference + distance


def _of_pulses(path: Path, record: dict[str, Any], name: str, pulses: int) -> Float64[np.ndarray, " pulses"]:
    """Read a field with a number for each pulse."""
    values = _line(path, record, name)
    if len(values) != pulses:
        raise_damaged(path, f"has {len(values)} values of {name} for {pulses} pulses")
    return values


def _line(path: Path, record: dict[str, Any], name: str) -> Float64[np.ndarray, " n"]:
    return _array(path, record, name, "fiu").astype(np.float64).ravel()


def _array(path: Path, record: dict[str, Any], name: str, kinds: str) -> np.ndarray:
    values = record.get(name)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in kinds:
        missing = "no field" if name not in record else f"no {'complex' if kinds == 'c' else 'real'} numbers in"
        raise SarsplatError(f"{path} has {missing} {name}; give files of GOTCHA's layout")
    return values


FORMAT = PhaseHistoryFormat(
    "MATLAB files (.mat) in the layout of GOTCHA", (".mat",), read_gotcha, container=b"MATLAB 5.0 MAT-file"
)
