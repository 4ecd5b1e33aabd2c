"""CPHD files made up for tests: points that scatter, seen from a flight around them, written with sarkit."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lxml.etree
import numpy as np
import sarkit.cphd

from sarsplat.geometry import Place

C = 299_792_458.0
PLACE = Place(47.3769, 8.5417, 430.0)
"""The reference point of the scene; coordinates below are east, north and up from there, m."""
_FORMATS: dict[str, tuple[Any, float]] = {
    "CF8": ("c8", 1.0),
    "CI4": ([("real", "i2"), ("imag", "i2")], 2e4),
    "CI2": ([("real", "i1"), ("imag", "i1")], 60.0),
}
_PVPS = {
    "TxTime": 1, "TxPos": 3, "TxVel": 3, "RcvTime": 1, "RcvPos": 3, "RcvVel": 3, "SRPPos": 3, "AmpSF": 1, "aFDOP": 1,
    "aFRR1": 1, "aFRR2": 1, "FX1": 1, "FX2": 1, "TOA1": 1, "TOA2": 1, "TDTropoSRP": 1, "SC0": 1, "SCSS": 1, "SIGNAL": 1,
}  # fmt: skip


def arc(
    azimuth_deg: float, width_deg: float, pulses: int, grazing_deg: float = 35.0, distance: float = 4000.0
) -> np.ndarray:
    """Antenna places [pulses, 3] on a level arc; azimuths are compass bearings from the scene, rising along it."""
    bearing = np.radians(azimuth_deg + width_deg * ((np.arange(pulses) + 0.5) / pulses - 0.5))
    level = distance * np.cos(np.radians(grazing_deg))
    up = np.full(pulses, distance * np.sin(np.radians(grazing_deg)))
    return np.stack([level * np.sin(bearing), level * np.cos(bearing), up], axis=1)


@dataclass(frozen=True)
class Collection:
    """How a file was recorded."""

    antenna: np.ndarray
    """[pulses, 3], where pulses were sent."""
    moved: np.ndarray | None = None
    """[pulses, 3], from there to where their echoes were received."""
    srp: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0)
    band: tuple[float, float] = (9.4e9, 9.9e9)
    samples: int = 96
    version: str = "1.1.0"
    domain: str = "FX"
    sign: int = -1
    form: str = "CF8"
    shift: np.ndarray | float = 0.0
    """Of the frequency of the first sample of each pulse, in steps."""
    stretch: np.ndarray | float = 1.0
    """Of the step."""
    scaled: np.ndarray | None = None
    """AmpSF of each pulse."""
    signal: np.ndarray | None = None
    """SIGNAL of each pulse."""
    swath: float = 20.0
    """Half of what is recorded in range, m."""
    area: float = 500.0
    """Half a side of what is shown, m."""
    dwell: tuple[float, float, float] | None = None
    """Centre of the dwell, s at the reference point and s/m to the east, and its duration; None: all is always seen."""
    channels: tuple[str, ...] = ("Channel A",)
    collect: str = "MONOSTATIC"
    bearing: float = 90.0
    """Of the image area's x axis."""

    @property
    def times(self) -> np.ndarray:
        """When pulses were sent, s."""
        return 0.001 * np.arange(len(self.antenna))


Points = Sequence[tuple[tuple[float, float, float], complex]]
"""Places and amplitudes."""


def simulated(made: Collection, points: Points) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Samples [pulses, samples] and the parameters of the pulses."""
    pulses = len(made.antenna)
    sent = made.antenna
    received = sent if made.moved is None else sent + made.moved
    srp = np.broadcast_to(np.asarray(made.srp, float), (pulses, 3))

    def there_and_back(place: np.ndarray) -> np.ndarray:
        return np.linalg.norm(sent - place, axis=1) + np.linalg.norm(received - place, axis=1)

    low, high = made.band
    step = (high - low) / (made.samples - 1) * np.broadcast_to(made.stretch, pulses)
    first = low + np.broadcast_to(made.shift, pulses) * step
    last = first + (made.samples - 1) * step
    middle, band = (first + last) / 2, last - first
    toa = 2 * made.swath / C
    interval = 1 / (1.25 * band)
    times = int(np.ceil(2 * toa / interval.min() * 1.5))
    start = -times // 2 * interval
    data = np.zeros((pulses, made.samples if made.domain == "FX" else times), complex)
    for place, amplitude in points:
        late = ((there_and_back(np.asarray(place, float)) - there_and_back(srp)) / C)[:, None]
        if made.domain == "FX":
            at = first[:, None] + np.arange(made.samples) * step[:, None]
            data += amplitude * np.exp(2j * np.pi * made.sign * at * late)
        else:
            at = start[:, None] + np.arange(times) * interval[:, None]
            data += (
                amplitude
                * np.sinc(band[:, None] * (at - late))
                * np.exp(2j * np.pi * made.sign * middle[:, None] * late)
            )
    scale = np.ones(pulses) if made.scaled is None else made.scaled
    velocity = np.gradient(sent, made.times, axis=0) @ PLACE.axes
    half = there_and_back(srp) / C
    return data / scale[:, None], {
        "TxTime": made.times, "TxPos": PLACE.to_ecef(sent), "TxVel": velocity,
        "RcvTime": made.times + half, "RcvPos": PLACE.to_ecef(received), "RcvVel": velocity,
        "SRPPos": PLACE.to_ecef(srp), "AmpSF": scale,
        "FX1": first, "FX2": last, "TOA1": np.full(pulses, -toa), "TOA2": np.full(pulses, toa),
        "SC0": first if made.domain == "FX" else start, "SCSS": step if made.domain == "FX" else interval,
        "SIGNAL": np.ones(pulses) if made.signal is None else made.signal,
    }  # fmt: skip


def write_cphd(path: Path, made: Collection, points: Points) -> Path:
    """The file of a collection; every channel after the first shows twice the amplitude of the one before."""
    data, values = simulated(made, points)
    dtype, largest = _FORMATS[made.form]
    if made.form != "CF8":  # whole numbers, which a factor for each pulse makes of them what they were
        peak = np.abs(data).max(axis=1) / largest
        values = {**values, "AmpSF": values["AmpSF"] * peak}
        data = data / peak[:, None]
    tree = lxml.etree.ElementTree(lxml.etree.fromstring(metadata(made, values, data.shape[1])))
    pvps = np.zeros(len(data), sarkit.cphd.get_pvp_dtype(tree))
    for name, value in values.items():
        pvps[name] = value
    with path.open("wb") as file, sarkit.cphd.Writer(file, sarkit.cphd.Metadata(xmltree=tree)) as writer:
        for number, channel in enumerate(made.channels):
            if made.form == "CF8":
                stored = data.astype(np.complex64) * 2**number
            else:
                stored = np.empty(data.shape, dtype)
                stored["real"], stored["imag"] = np.round(data.real), np.round(data.imag)
            writer.write_signal(channel, stored)
            writer.write_pvp(channel, pvps)
    return path


def metadata(made: Collection, values: dict[str, np.ndarray], samples: int) -> bytes:
    """The XML, valid by the schema of its version."""
    pulses = len(made.antenna)
    number = {"CF8": 8, "CI4": 4, "CI2": 2}[made.form]
    x, y = made.bearing, made.bearing - 90
    axes = [np.sin(np.radians(one)) * PLACE.axes[0] + np.cos(np.radians(one)) * PLACE.axes[1] for one in (x, y)]
    middle, drift, duration = made.dwell or (made.times.mean(), 0.0, 2 * np.ptp(made.times) + 1)
    toa = values["TOA2"][0]
    place = dict(zip("XYZ", PLACE.ecef, strict=True))
    area = f"<X1Y1>{_xy(-made.area)}</X1Y1><X2Y2>{_xy(made.area)}</X2Y2>"
    listed = "".join(
        f"<Channel><Identifier>{name}</Identifier><NumVectors>{pulses}</NumVectors><NumSamples>{samples}</NumSamples>"
        f"<SignalArrayByteOffset>{at * pulses * samples * number}</SignalArrayByteOffset>"
        f"<PVPArrayByteOffset>{at * pulses * 8 * sum(_PVPS.values())}</PVPArrayByteOffset></Channel>"
        for at, name in enumerate(made.channels)
    )
    same = {name: str(bool(np.ptp(values[name], axis=0).max() == 0)).lower() for name in ("FX1", "SRPPos")}
    parameters = "".join(
        f"<Parameters><Identifier>{name}</Identifier><RefVectorIndex>{pulses // 2}</RefVectorIndex>"
        f"<FXFixed>{same['FX1']}</FXFixed><TOAFixed>true</TOAFixed><SRPFixed>{same['SRPPos']}</SRPFixed>"
        f"<Polarization><TxPol>{'VH'[at % 2]}</TxPol><RcvPol>V</RcvPol></Polarization>"
        f"<FxC>{np.mean(made.band)}</FxC><FxBW>{np.ptp(made.band)}</FxBW><TOASaved>{2 * toa}</TOASaved>"
        "<DwellTimes><CODId>c</CODId><DwellId>d</DwellId></DwellTimes></Parameters>"
        for at, name in enumerate(made.channels)
    )
    offset, pvps = 0, ""
    for name, size in _PVPS.items():
        form = "I8" if name == "SIGNAL" else "F8" if size == 1 else "X=F8;Y=F8;Z=F8;"
        pvps += f"<{name}><Offset>{offset}</Offset><Size>{size}</Size><Format>{form}</Format></{name}>"
        offset += size
    side = "".join(f"<{name}>{value}</{name}>" for name, value in _GEOMETRY.items())
    text = f"""<CPHD xmlns="http://api.nsgreg.nga.mil/schema/cphd/{made.version}"><CollectionID>
<CollectorName>Made up</CollectorName><CoreName>A core</CoreName><CollectType>{made.collect}</CollectType>
<RadarMode><ModeType>SPOTLIGHT</ModeType></RadarMode><Classification>UNCLASSIFIED</Classification>
<ReleaseInfo>UNRESTRICTED</ReleaseInfo></CollectionID><Global><DomainType>{made.domain}</DomainType>
<SGN>{made.sign:+d}</SGN><Timeline><CollectionStart>2026-01-02T03:04:05Z</CollectionStart>
<TxTime1>{made.times[0]}</TxTime1><TxTime2>{made.times[-1]}</TxTime2></Timeline>
<FxBand><FxMin>{values["FX1"].min()}</FxMin><FxMax>{values["FX2"].max()}</FxMax></FxBand>
<TOASwath><TOAMin>{-toa}</TOAMin><TOAMax>{toa}</TOAMax></TOASwath></Global><SceneCoordinates>
<EarthModel>WGS_84</EarthModel><IARP><ECF>{_tags(place)}</ECF><LLH><Lat>{PLACE.latitude_deg}</Lat>
<Lon>{PLACE.longitude_deg}</Lon><HAE>{PLACE.height_m}</HAE></LLH></IARP><ReferenceSurface><Planar>
<uIAX>{_tags(dict(zip("XYZ", axes[0], strict=True)))}</uIAX><uIAY>{_tags(dict(zip("XYZ", axes[1], strict=True)))}</uIAY>
</Planar></ReferenceSurface><ImageArea>{area}</ImageArea><ImageAreaCornerPoints>{_corners()}</ImageAreaCornerPoints>
</SceneCoordinates><Data><SignalArrayFormat>{made.form}</SignalArrayFormat>
<NumBytesPVP>{8 * sum(_PVPS.values())}</NumBytesPVP><NumCPHDChannels>{len(made.channels)}</NumCPHDChannels>{listed}
<NumSupportArrays>0</NumSupportArrays></Data><Channel><RefChId>{made.channels[0]}</RefChId>
<FXFixedCPHD>{same["FX1"]}</FXFixedCPHD><TOAFixedCPHD>true</TOAFixedCPHD><SRPFixedCPHD>{same["SRPPos"]}</SRPFixedCPHD>
{parameters}</Channel><PVP>{pvps}</PVP><Dwell><NumCODTimes>1</NumCODTimes><CODTime><Identifier>c</Identifier>
<CODTimePoly order1="1" order2="0"><Coef exponent1="0" exponent2="0">{middle}</Coef>
<Coef exponent1="1" exponent2="0">{drift}</Coef></CODTimePoly></CODTime><NumDwellTimes>1</NumDwellTimes><DwellTime>
<Identifier>d</Identifier><DwellTimePoly order1="0" order2="0"><Coef exponent1="0" exponent2="0">{duration}</Coef>
</DwellTimePoly></DwellTime></Dwell><ReferenceGeometry><SRP><ECF>{_tags(place)}</ECF><IAC><X>0</X><Y>0</Y><Z>0</Z></IAC>
</SRP><ReferenceTime>0</ReferenceTime><SRPCODTime>0</SRPCODTime><SRPDwellTime>0</SRPDwellTime><Monostatic>
<ARPPos>{_tags(place)}</ARPPos><ARPVel>{_tags(place)}</ARPVel>{side}</Monostatic></ReferenceGeometry></CPHD>"""
    return text.replace("\n", "").encode()


_GEOMETRY = {
    "SideOfTrack": "L", "SlantRange": 1, "GroundRange": 1, "DopplerConeAngle": 90, "GrazeAngle": 30,
    "IncidenceAngle": 60, "AzimuthAngle": 0, "TwistAngle": 0, "SlopeAngle": 30, "LayoverAngle": 0,
}  # fmt: skip
"""Not read, but part of every file."""


def _tags(values: dict[str, float]) -> str:
    return "".join(f"<{name}>{float(value)!r}</{name}>" for name, value in values.items())


def _xy(value: float) -> str:
    return _tags({"X": value, "Y": value})


def _corners() -> str:
    signs = ((1, -1), (1, 1), (-1, 1), (-1, -1))
    near = [(PLACE.latitude_deg + 0.01 * a, PLACE.longitude_deg + 0.01 * b) for a, b in signs]
    return "".join(f'<IACP index="{k}"><Lat>{lat}</Lat><Lon>{lon}</Lon></IACP>' for k, (lat, lon) in enumerate(near, 1))


def xml_of(data: bytes) -> bytes:
    """The metadata of a file."""
    start, size = (
        int(data.split(f"XML_BLOCK_{name} := ".encode())[1].split(b"\n")[0]) for name in ("BYTE_OFFSET", "SIZE")
    )
    return data[start : start + size]


def with_xml(data: bytes, xml: bytes) -> bytes:
    """The file with other metadata, which follow all else, where the header says."""
    head, end, _ = data.partition(b"\f\n")
    for field, value in ((b"BYTE_OFFSET", len(data)), (b"SIZE", len(xml))):
        head = re.sub(rb"(XML_BLOCK_%s := )\d+" % field, rb"\g<1>%d" % value, head)
    return head + end + data[len(head + end) :] + xml
