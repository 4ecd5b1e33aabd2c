"""Phase history as CPHD 1.0.1 and 1.1.0 have it (compensated phase history data, NGA.STND.0068).

A scatterer of amplitude A at p is A·exp(2πj·SGN·f·Δt) in a sample of frequency f, where Δt is how much later its echo
arrives than that of the pulse's stabilisation point (SRP). In the domain of times of arrival, pulses are compressed:
the phase of the peak at Δt is that of the middle of their band, [FX1, FX2].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex64, Float64, Int64

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError
from sarsplat.geometry.responses import UNIFORM
from sarsplat.importers.cphd_file import MAGIC, Channel, Cphd, open_cphd
from sarsplat.importers.files import complex_of, raise_damaged
from sarsplat.importers.histories import PhaseHistoryFormat
from sarsplat.importers.phase_apertures import WIDEST_DEG, whole_flight
from sarsplat.importers.phase_history import SPEED_OF_LIGHT, PhaseHistory, Recorded
from sarsplat.importers.sarkit_xml import sarkit_errors

_MONOSTATIC_DEG = 0.5  # maximum angle between sending and receiving position of a monostatic antenna, degrees
_SAME_BAND = 0.9  # minimum share of its band that a pulse has in common with all others
_EXACT = 1e-6  # rounding tolerance of a calculated index, in steps


def read_cphd(path: str | Path, channel: str | None = None) -> PhaseHistory:
    """Read one channel of a CPHD file, or the only one; its samples stay in the file until they are needed.

    The world frame is level at the reference point of the scene (IARP), x to the east and y to the north. Raises as
    `open_cphd` does, or if it has several channels and none is named, or pulses have little of their bands in common.
    """
    cphd = open_cphd(Path(path))
    chosen = cphd.channel(channel)
    pulses = cphd.pulses(chosen)
    place = cphd.place
    sent, received, point = (place.from_ecef(pulses[name]) for name in ("TxPos", "RcvPos", "SRPPos"))
    _require_monostatic(cphd, sent - point, received - point)
    reference = (np.linalg.norm(sent - point, axis=1) + np.linalg.norm(received - point, axis=1)) / 2
    first_hz, step_hz, signal = (_of_frequencies if cphd.domain == "FX" else _of_times)(cphd, chosen, pulses)
    return PhaseHistory(
        str(cphd.path),
        first_hz,
        step_hz,
        (sent + received) / 2,
        reference,
        signal,
        moved_m=(received - sent) / 2,
        shown_m=_shown(cphd, chosen, pulses, step_hz),
        place=place,
        lit=partial(_lit, cphd, chosen, _times(pulses)),
        collection=_collection(cphd, chosen),
    )


@dataclass(frozen=True, eq=False)
class _Signal(Recorded):
    """Samples of a channel in its file."""

    path: Path
    channel: str
    index: Int64[np.ndarray, " pulses"]
    """Indices of the pulses in the file, rising."""
    scale: Float64[np.ndarray, " pulses"]
    """Factor on the stored samples of each pulse."""
    conjugate: bool
    """True if the phase rises with distance."""
    first: int
    """Index of the first frequency used, among the file's or those of its transformed times."""
    count: int
    """Number of frequencies used."""
    start_s: Float64[np.ndarray, " pulses"] | None = None
    """First time of each pulse, in sampling intervals; None for samples in frequency."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.count, len(self.index)

    def part(self, pulses: slice) -> _Signal:
        start = None if self.start_s is None else self.start_s[pulses]
        return replace(self, index=self.index[pulses], scale=self.scale[pulses], start_s=start)

    def read(self) -> Complex64[np.ndarray, "frequencies pulses"]:
        import sarkit.cphd

        runs = np.split(self.index, np.flatnonzero(np.diff(self.index) != 1) + 1)
        with open_file(self.path) as file, sarkit_errors(self.path, "CPHD"):  # the file may have become shorter
            reader = sarkit.cphd.Reader(file)
            stored = [
                reader.read_signal(self.channel, start_vector=int(run[0]), stop_vector=int(run[-1]) + 1) for run in runs
            ]
            samples = complex_of(np.concatenate(stored)).astype(np.complex64)
        with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused
            if self.conjugate:
                np.conj(samples, out=samples)
            if self.start_s is not None:  # samples in time: to frequency, the centre of the band in the middle
                places = (np.arange(samples.shape[1]) - samples.shape[1] // 2) / samples.shape[1]
                turned = np.exp(-2j * math.pi * self.start_s[:, None] * places)
                samples = np.fft.fftshift(np.fft.fft(samples, axis=1), axes=1) * turned
            samples = samples[:, self.first : self.first + self.count] * self.scale[:, None]
            return np.ascontiguousarray(samples.T.astype(np.complex64))


def _of_frequencies(cphd: Cphd, channel: Channel, pulses: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, _Signal]:
    """Return first frequency and step of each pulse, and the samples that all pulses have within their bands."""
    first, step = pulses["SC0"], pulses["SCSS"]
    _require_steps(cphd, step)
    with np.errstate(over="ignore"):
        low = np.clip(np.ceil((pulses["FX1"] - first) / step - _EXACT), 0, channel.samples)
        high = np.clip(np.floor((pulses["FX2"] - first) / step + _EXACT), -1, channel.samples - 1)
    begin, end = int(low.max()), int(high.min()) + 1
    if end - begin < 2:
        raise_damaged(cphd.path, f"has samples that are not of its band ({_in_mhz(pulses)})")
    _require_one_band(cphd, first + begin * step, first + (end - 1) * step)
    signal = _Signal(cphd.path, channel.name, pulses["index"], pulses["AmpSF"], cphd.sign > 0, begin, end - begin)
    return first + begin * step, step, signal


def _of_times(cphd: Cphd, channel: Channel, pulses: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, _Signal]:
    """Return first frequency and step of each pulse, and the Fourier transform of its samples in time."""
    interval, band = pulses["SCSS"], pulses["FX2"] - pulses["FX1"]
    _require_steps(cphd, interval)
    each_side = np.floor(band / 2 * channel.samples * interval + _EXACT)
    fewest = int(np.clip(each_side.min(), -1, channel.samples))
    if not 1 <= fewest <= (channel.samples - 1) // 2:
        raise_damaged(cphd.path, f"has samples {interval.max():.3g} s apart, not those of its band ({_in_mhz(pulses)})")
    _require_one_band(cphd, pulses["FX1"], pulses["FX2"])
    step = 1 / (channel.samples * interval)
    signal = _Signal(
        cphd.path,
        channel.name,
        pulses["index"],
        pulses["AmpSF"] * interval * band,  # so that the peak of a point is its amplitude in either domain
        cphd.sign > 0,
        channel.samples // 2 - fewest,
        2 * fewest + 1,
        pulses["SC0"] / interval,
    )
    return (pulses["FX1"] + pulses["FX2"]) / 2 - fewest * step, step, signal


def _in_mhz(pulses: dict[str, Any]) -> str:
    return f"FX1 and FX2, {pulses['FX1'][0] / 1e6:.6g} MHz to {pulses['FX2'][0] / 1e6:.6g} MHz"


def _require_steps(cphd: Cphd, steps: Float64[np.ndarray, " pulses"]) -> None:
    if not (steps > 0).all():
        raise_damaged(cphd.path, f"has samples in steps of {steps.min():g}, which must be positive")


def _require_one_band(cphd: Cphd, first: Float64[np.ndarray, " pulses"], last: Float64[np.ndarray, " pulses"]) -> None:
    """Raise if pulses have little of their bands, between these frequencies, in common."""
    each, common = float((last - first).mean()), float(last.min() - first.max())
    if not common >= _SAME_BAND * each:  # also catches NaN
        raise SarsplatError(
            f"{cphd.path} has pulses of {each / 1e6:.4g} MHz, of which all have only {max(common, 0.0) / 1e6:.4g} MHz "
            "in common; get it resampled to one band"
        )


def _require_monostatic(
    cphd: Cphd, sent: Float64[np.ndarray, "pulses 3"], received: Float64[np.ndarray, "pulses 3"]
) -> None:
    cosine = (sent * received).sum(axis=1) / np.maximum(
        np.linalg.norm(sent, axis=1) * np.linalg.norm(received, axis=1), np.finfo(float).tiny
    )
    angle = math.degrees(math.acos(float(np.clip(cosine.min(), -1, 1))))
    if angle > _MONOSTATIC_DEG:
        raise SarsplatError(
            f"{cphd.path} has pulses that were sent and received {angle:.2g}° apart as the scene sees it (bistatic); "
            "give a collection whose radar transmits and receives itself"
        )


def _shown(
    cphd: Cphd, channel: Channel, pulses: dict[str, Any], step_hz: Float64[np.ndarray, " pulses"]
) -> Float64[np.ndarray, "pulses 2"]:
    """Return the ranges that each pulse shows, as stated and unambiguous."""
    half = SPEED_OF_LIGHT / 2
    early, late = pulses["TOA1"] * half, pulses["TOA2"] * half
    if cphd.domain == "TOA":
        recorded = pulses["SC0"] * half, (pulses["SC0"] + (channel.samples - 1) * pulses["SCSS"]) * half
    else:
        recorded = -half / (2 * step_hz), half / (2 * step_hz)
    stated = (early < late) & (late - early <= half / step_hz)
    if cphd.domain == "TOA":
        early, late = np.maximum(early, recorded[0]), np.minimum(late, recorded[1])
    return np.stack([np.where(stated, early, recorded[0]), np.where(stated, late, recorded[1])], axis=1)


def _times(pulses: dict[str, Any]) -> Float64[np.ndarray, " pulses"]:
    """Return the time of each pulse at its stabilisation point, s."""
    from sarkit.cphd import compute_t_ref

    with np.errstate(all="ignore"):  # an antenna at that point sees nothing
        return np.nan_to_num(
            compute_t_ref(*(pulses[name] for name in ("TxPos", "RcvPos", "SRPPos", "TxTime", "RcvTime")))
        )


def _lit(
    cphd: Cphd, channel: Channel, times_s: Float64[np.ndarray, " pulses"], places: Float64[np.ndarray, "places 3"]
) -> Bool[np.ndarray, " pulses"]:
    """Return the pulses of a channel that saw all of some places (ECEF): those of their dwell, about its centre.

    Raises if a place is outside the image area.
    """
    from sarkit.cphd import ecf_to_iac

    with sarkit_errors(cphd.path, "CPHD"):
        x, y = ecf_to_iac(cphd.tree, places)[:, :2].T
        _require_within(cphd, x, y)
        middle, duration = (
            np.polynomial.polynomial.polyval2d(x, y, _dwell_polynomial(cphd, channel, *kind))
            for kind in (("CODTime", "CODId"), ("DwellTime", "DwellId"))
        )
        if not (np.isfinite(middle) & np.isfinite(duration)).all():
            raise_damaged(cphd.path, "has dwell times that are not finite")
        return (np.abs(times_s - middle[:, None]) <= duration[:, None] / 2).all(axis=0)


def _dwell_polynomial(cphd: Cphd, channel: Channel, kind: str, identifier: str) -> np.ndarray:
    """Load the polynomial of the centre (CODTime) or the duration (DwellTime) of a channel's dwell."""
    chosen = cphd.text(f"Channel/Parameters[{{*}}Identifier='{channel.name}']/DwellTimes/{identifier}")
    polynomial = None if "'" in chosen else cphd.load(f"Dwell/{kind}[{{*}}Identifier='{chosen}']/{kind}Poly")
    if polynomial is None:
        raise_damaged(cphd.path, f"has no dwell times ({kind})")
    return np.asarray(polynomial)


def _require_within(cphd: Cphd, x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"]) -> None:
    corners = [cphd.load(f"SceneCoordinates/ImageArea/{name}") for name in ("X1Y1", "X2Y2")]
    if any(corner is None or not np.all(np.isfinite(corner)) for corner in corners):
        raise_damaged(cphd.path, "has no valid ImageArea")
    low, high = np.sort(corners, axis=0)
    if min(x.min() - low[0], y.min() - low[1], high[0] - x.max(), high[1] - y.max()) < 0:
        place = cphd.place
        raise SarsplatError(
            f"{cphd.path} shows {high[0] - low[0]:.0f} m × {high[1] - low[1]:.0f} m about "
            f"{place.latitude_deg:.6f}, {place.longitude_deg:.6f}, which does not contain the image; "
            "give a smaller `size_m`, or a `place` or `around_m` within it"
        )


def _collection(cphd: Cphd, channel: Channel) -> dict[str, str]:
    """Return collector, collection, mode, start and polarisation, as far as stated."""
    names = {
        "collector": "CollectionID/CollectorName",
        "collection": "CollectionID/CoreName",
        "mode": "CollectionID/RadarMode/ModeType",
        "start": "Global/Timeline/CollectionStart",
    }
    facts = {key: text for key, name in names.items() if (text := cphd.text(name))}
    return facts | ({"polarisation": channel.polarisation} if channel.polarisation else {})


def describe_cphd(path: Path) -> dict[str, str]:
    """Describe a file, of several channels the first."""
    cphd = open_cphd(path)
    history = read_cphd(path, cphd.channels[0].name)
    assert history.place is not None
    facts = {"version": cphd.version, **history.collection}
    if len(cphd.channels) > 1:
        facts["channels"] = cphd.listed + "; what follows is of the first"
    seen = history.seeing(np.zeros((1, 3)))
    aperture = whole_flight(seen, np.zeros(3))
    distance = float(np.linalg.norm(seen.antenna_m, axis=1).mean())
    azimuth, away = aperture.resolution_m(UNIFORM)
    sharpness = f"; {azimuth:.3g} m × {away:.3g} m (azimuth × slant range, 3 dB, unweighted) if they make one image"
    return {
        **facts,
        "where": f"{history.place} (reference point of the scene)",
        "radar": f"looks {'left' if aperture.looks_left else 'right'}, {distance / 1e3:.4g} km away at the compass "
        f"bearing {history.place.bearing_deg(aperture.view.azimuth_deg):.1f}°",
        "grazing": f"{aperture.view.grazing_deg:.2f}°, slant plane tilted by {aperture.tilt_deg:z.1f}°",
        "band": f"{history.bandwidth_hz / 1e6:.4g} MHz about {history.carrier_hz / 1e9:.4g} GHz",
        "pulses": f"{len(history)}, of {history.frequencies} frequencies (domain {cphd.domain}, SGN {cphd.sign:+d})",
        "aperture": f"{len(seen)} pulses saw that point, from {aperture.width_deg:.3g}° of azimuth"
        + sharpness * (aperture.width_deg <= WIDEST_DEG),
    }


FORMAT = PhaseHistoryFormat(
    "CPHD files (.cphd), versions 1.0.1 and 1.1.0",
    (".cphd",),
    read_cphd,
    begins=MAGIC,
    several=True,
    describe=describe_cphd,
)
