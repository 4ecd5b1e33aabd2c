"""SICD files for tests, written with sarkit: point scatterers at known places, seen by a radar on a straight track.

Where a scatterer lies in an image follows from its range and range rate at the centre of the aperture alone
(`locate`), so that sarkit's projections can be held against it.
"""

import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryFile

import lxml.etree
import numpy as np
import sarkit.sicd as sk
import sarkit.wgs84

SPOT = (47.3, 8.5, 420.0)  # latitude and longitude, degrees, and height above the ellipsoid, m
SPEED = 200.0  # m/s
FREQUENCY = 9.6e9  # Hz
LIGHT = 299_792_458.0
WIDTHS = {"UNIFORM": 0.886, "TAYLOR": 1.130, None: 0.886}
"""Of responses at half power, for a bandwidth of 1."""


@dataclass(frozen=True)
class Track:
    """One flight past the spot.

    The compass bearing and the elevation of the radar seen from there, on which side of the track the spot lies, by how
    much the radar looks ahead (squint) and climbs, and how far away it is; degrees and metres.
    """

    bearing: float = 90.0
    grazing: float = 35.0
    look: str = "R"
    squint: float = 0.0
    climb: float = 0.0
    distance: float = 500e3

    def position(self) -> np.ndarray:
        """Of the radar, metres east, north and above the spot."""
        bearing, grazing = np.radians([self.bearing, self.grazing])
        level = math.cos(grazing)
        return self.distance * np.array([level * math.sin(bearing), level * math.cos(bearing), math.sin(grazing)])

    def velocity(self) -> np.ndarray:
        """Of the radar, m/s towards east, north and up."""
        turned = self.bearing - 90 if self.look == "L" else self.bearing + 90  # spot on the left, or on the right
        ahead = self.squint if self.look == "L" else -self.squint
        course, climb = np.radians([turned - ahead, self.climb])
        return SPEED * np.array(
            [math.sin(course) * math.cos(climb), math.cos(course) * math.cos(climb), math.sin(climb)]
        )


@dataclass(frozen=True)
class Recording:
    """How the image is laid out: pixel type, samples, and the image plane.

    `turn` rotates the axes within the plane and `tilt` the plane about the line of sight, degrees; `offset` is where
    the scene centre point lies, metres east, north and above the spot.
    """

    rows: int = 300
    columns: int = 280
    bandwidth: tuple[float, float] = (1.5, 1.4)  # of rows and columns, cycles per metre
    oversampling: float = 1.25
    turn: float = 0.0
    tilt: float = 0.0
    ground_plane: bool = False
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    doppler: tuple[float, float] = (0.0, 0.0)  # centre of the band, rows and columns, cycles per metre
    kind: str = "PLANE"
    pixel_type: str = "RE32F_IM32F"
    amplitude_table: bool = False
    calibration: tuple[tuple[str, float], ...] = ()
    window: str | None = "UNIFORM"
    parameters: tuple[tuple[str, str], ...] = ()
    sign: int = -1
    polarisation: str = "V:V"
    coregistered_to: Track | None = None
    """Whose image plane it lies in; its own if None."""

    @property
    def spacing(self) -> tuple[float, float]:
        return 1 / (self.oversampling * self.bandwidth[0]), 1 / (self.oversampling * self.bandwidth[1])


def axes(llh: Sequence[float] = SPOT) -> np.ndarray:
    """Rows: east, north and up at a place, in ECEF."""
    return np.array([sarkit.wgs84.east(llh), sarkit.wgs84.north(llh), sarkit.wgs84.up(llh)])


def ecef(place: Sequence[float]) -> np.ndarray:
    """Of a place given in metres east, north and above the spot."""
    return sarkit.wgs84.geodetic_to_cartesian(SPOT) + np.asarray(place) @ axes()


def write_sicd(
    path: Path,
    track: Track,
    places: Sequence[Sequence[float]],
    recording: Recording = Recording(),
    amplitudes: Sequence[complex] | None = None,
) -> Path:
    """A SICD of point scatterers at `places`, metres east, north and above the spot."""
    where = tuple(tuple(map(float, place)) for place in places)
    path.write_bytes(_sicd(track, where, recording, tuple(amplitudes or [1.0] * len(where))))
    return path


@lru_cache(maxsize=40)
def _sicd(
    track: Track, places: tuple[tuple[float, ...], ...], recording: Recording, amplitudes: tuple[complex, ...]
) -> bytes:
    """Made once; the files of tests are often the same."""
    tree, grid_of = describe(track, recording)
    image = np.zeros((recording.rows, recording.columns), np.complex128)
    for place, amplitude in zip(places, amplitudes, strict=True):
        image += amplitude * response(recording, grid_of(ecef(place)))
    meta = sk.NitfMetadata(
        xmltree=tree,
        file_header_part=sk.NitfFileHeaderPart(ostaid="nowhere", security=sk.NitfSecurityFields(clas="U")),
        im_subheader_part=sk.NitfImSubheaderPart(isorce="made up", security=sk.NitfSecurityFields(clas="U")),
        de_subheader_part=sk.NitfDeSubheaderPart(security=sk.NitfSecurityFields(clas="U")),
    )
    with TemporaryFile() as file, _deprecations_ignored():
        with sk.NitfWriter(file, meta) as writer:
            writer.write_image(pixels(image, recording))
        file.seek(0)
        return file.read()


def xml_of(data: bytes) -> bytes:
    """The metadata of a SICD that `write_sicd` made: the last part of the file."""
    return data[len(data) - int(data[395:404]) :]


def with_xml(data: bytes, xml: bytes) -> bytes:
    """Such a file with other metadata, and lengths in its header that fit them."""
    kept = data[: len(data) - int(data[395:404])]
    length = b"%012d" % (len(kept) + len(xml))
    return kept[:342] + length + kept[354:395] + b"%09d" % len(xml) + kept[404:] + xml


def of_version(data: bytes, version: str) -> bytes:
    """A SICD as files of a version have it: those of 0.4 state types, and 0.4.0 has a rate of one variable."""
    xml = xml_of(data).decode().replace("urn:SICD:1.4.0", f"urn:SICD:{version}")
    if version < "1":
        data = data.replace(b"XML_DATA_CONTENT", b"SICD_XML".ljust(16))
    if version < "0.5":
        xml = re.sub(r"<WgtType><WindowName>(\w+)</WindowName>.*?</WgtType>", r"<WgtType>\1</WgtType>", xml)
        xml = re.sub(r"<Coef ", '<Coef class="xs:double" ', xml)
        xml = re.sub(r"<(NumRows|SS|ModeType)>", r'<\1 class="xs:string">', xml)
    if version == "0.4.0":
        start = xml.partition("<DRateSFPoly")[0]
        rate, end = re.findall(r"(<DRateSFPoly.*</DRateSFPoly>)(.*)", xml)[0]
        xml = start + re.sub(r' (order2|exponent2)="0"', "", rate) + end
    return with_xml(data, xml.encode())


@contextmanager
def _deprecations_ignored() -> Iterator[None]:
    """Sarkit reads its schemas in a way that Python 3.11 warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def response(recording: Recording, place: np.ndarray) -> np.ndarray:
    """What a scatterer at (xrow, ycol), metres, leaves in the image: amplitude 1 at its peak."""
    lines = []
    for axis, (count, size) in enumerate(zip((recording.rows, recording.columns), recording.spacing, strict=True)):
        away = (np.arange(count) - count // 2) * size - place[axis]
        band = np.sinc(recording.bandwidth[axis] * away)
        if recording.window == "TAYLOR":  # two terms of a raised cosine are close enough to such a window
            band = sum(
                weight * np.sinc(recording.bandwidth[axis] * away + shift)
                for shift, weight in ((0, 1.0), (1, 0.3), (-1, 0.3))
            )
        lines.append(band * np.exp(-recording.sign * 2j * np.pi * recording.doppler[axis] * away))
    carrier = np.exp(recording.sign * 2j * np.pi * 2 * FREQUENCY / LIGHT * place[0])
    return carrier * np.outer(*lines)


def pixels(image: np.ndarray, recording: Recording) -> np.ndarray:
    """The image in its pixel type; integers at full scale."""
    largest = max(np.abs(image).max(), 1e-30)
    made = np.empty(image.shape, sk.PIXEL_TYPES[recording.pixel_type]["dtype"])
    if recording.pixel_type == "RE32F_IM32F":
        made[...] = image
    elif recording.pixel_type == "RE16I_IM16I":
        made["real"], made["imag"] = np.round(image.real / largest * 32000), np.round(image.imag / largest * 32000)
    else:
        made["phase"] = np.round(np.angle(image) / (2 * np.pi) * 256).astype(int) % 256
        share = np.abs(image) / largest
        made["amp"] = np.round(255 * (np.sqrt(share) if recording.amplitude_table else share))
    return made


@lru_cache(maxsize=40)
@_deprecations_ignored()
def describe(track: Track, recording: Recording) -> tuple[lxml.etree._ElementTree, Callable[[np.ndarray], np.ndarray]]:
    """The metadata, and the function from ECEF to (xrow, ycol) that the image follows."""
    scp, east_north_up = ecef(recording.offset), axes()
    arp, velocity = ecef(track.position()), track.velocity() @ east_north_up
    llh = sarkit.wgs84.cartesian_to_geodetic(scp)
    up = sarkit.wgs84.up(llh)
    base = recording.coregistered_to or track
    seen_from = ecef(base.position()), base.velocity() @ east_north_up
    row, column = plane(recording, scp, *seen_from, up)

    root = lxml.etree.Element("{urn:SICD:1.4.0}SICD", nsmap={None: "urn:SICD:1.4.0"})
    tree = lxml.etree.ElementTree(root)
    sicd = sk.ElementWrapper(root)
    sicd["CollectionInfo"] = {
        "CollectorName": "made up",
        "CoreName": f"bearing {track.bearing:g}",
        "CollectType": "MONOSTATIC",
        "RadarMode": {"ModeType": "SPOTLIGHT"},
        "Classification": "UNCLASSIFIED",
    }
    sicd["ImageData"] = {"PixelType": recording.pixel_type}
    if recording.amplitude_table:
        sicd["ImageData"]["AmpTable"] = np.arange(256.0) ** 2
    for name, value in (
        ("NumRows", recording.rows),
        ("NumCols", recording.columns),
        ("FirstRow", 0),
        ("FirstCol", 0),
        ("FullImage", {"NumRows": recording.rows, "NumCols": recording.columns}),
        ("SCPPixel", (recording.rows // 2, recording.columns // 2)),
    ):
        sicd["ImageData"][name] = value
    half = 1e-3
    corners = [(llh[0] + a * half, llh[1] + b * half) for a, b in ((1, -1), (1, 1), (-1, 1), (-1, -1))]
    sicd["GeoData"] = {"EarthModel": "WGS_84", "SCP": {"ECF": scp, "LLH": llh}, "ImageCorners": np.array(corners)}
    rate = rate_along(scp, arp, velocity, column)
    passing = math.copysign(1 / SPEED, velocity @ column)  # seconds for each metre along the columns
    coa = np.array([[1.0, passing]]) if recording.kind == "RGZERO" else np.array([[1.0]])
    sicd["Grid"] = {"ImagePlane": "SLANT" if not recording.ground_plane else "GROUND", "Type": recording.kind}
    sicd["Grid"]["TimeCOAPoly"] = coa
    for axis, (name, vector, centre) in enumerate((("Row", row, 2 * FREQUENCY / LIGHT), ("Col", column, 0.0))):
        band, step, doppler = recording.bandwidth[axis], recording.spacing[axis], recording.doppler[axis]
        widest = 0.5 / step if doppler else band / 2
        sicd["Grid"][name] = {
            "UVectECF": vector,
            "SS": step,
            "ImpRespWid": WIDTHS[recording.window] / band,
            "Sgn": recording.sign,
            "ImpRespBW": band,
            "KCtr": centre,
            "DeltaK1": -widest,
            "DeltaK2": widest,
            "DeltaKCOAPoly": np.array([[doppler]]),
        }
        if recording.window:
            sicd["Grid"][name]["WgtType"]["WindowName"] = recording.window
        if recording.parameters:
            sicd["Grid"][name]["WgtType"]["Parameter"] = recording.parameters
    sicd["Timeline"] = {"CollectStart": datetime(2024, 5, 1, tzinfo=UTC), "CollectDuration": 2.0}
    sicd["Position"]["ARPPoly"] = np.array([arp - velocity, velocity])
    sicd["RadarCollection"] = {
        "TxFrequency": {"Min": FREQUENCY - 3e8, "Max": FREQUENCY + 3e8},
        "TxPolarization": recording.polarisation[0],
        "RcvChannels": {"@size": 1, "ChanParameters": [{"@index": 1, "TxRcvPolarization": recording.polarisation}]},
    }
    algorithm = {"RGZERO": "RMA", "RGAZIM": "PFA"}.get(recording.kind, "OTHER")
    sicd["ImageFormation"] = {
        "RcvChanProc": {"NumChanProc": 1, "ChanIndex": [1]},
        "TxRcvPolarizationProc": recording.polarisation,
        "TStartProc": 0.0,
        "TEndProc": 2.0,
        "TxFrequencyProc": {"MinProc": FREQUENCY - 3e8, "MaxProc": FREQUENCY + 3e8},
        "ImageFormAlgo": algorithm,
        "STBeamComp": "NO",
        "ImageBeamComp": "NO",
        "AzAutofocus": "NO",
        "RgAutofocus": "NO",
    }
    root.append(sk.compute_scp_coa(tree))
    for name, factor in recording.calibration:
        sicd["Radiometric"][f"{name}SFPoly"] = np.array([[factor]])
    if recording.kind == "RGAZIM":
        sicd["PFA"] = {
            "FPN": up,
            "IPN": np.cross(row, column),
            "PolarAngRefTime": 1.0,
            "PolarAngPoly": np.array([-rate, rate]),
            "SpatialFreqSFPoly": np.array([1.0]),
            "Krg1": 60.0,
            "Krg2": 68.0,
            "Kaz1": -1.0,
            "Kaz2": 1.0,
        }
    if recording.kind == "RGZERO":
        sicd["RMA"] = {
            "RMAlgoType": "OMEGA_K",
            "ImageType": "INCA",
            "INCA": {
                "TimeCAPoly": np.array([1.0, passing]),
                "R_CA_SCP": np.linalg.norm(scp - arp),
                "FreqZero": FREQUENCY,
                "DRateSFPoly": np.array([[1.0]]),
            },
        }

    def grid_of(place: np.ndarray) -> np.ndarray:
        return locate(recording.kind, place, scp, *seen_from, row, column)

    return tree, grid_of


def plane(
    recording: Recording, scp: np.ndarray, arp: np.ndarray, velocity: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors of rows (away from the radar) and columns."""
    sight = (scp - arp) / np.linalg.norm(scp - arp)
    normal = np.cross(velocity, sight)
    normal = (np.sign(normal @ up) * normal) / np.linalg.norm(normal)
    if recording.ground_plane:
        normal = up
    row = sight - (sight @ normal) * normal
    row /= np.linalg.norm(row)
    tilt, turn = np.radians([recording.tilt, recording.turn])
    normal = math.cos(tilt) * normal + math.sin(tilt) * np.cross(row, normal)
    column = np.cross(normal, row)
    return (math.cos(turn) * row + math.sin(turn) * column, math.cos(turn) * column - math.sin(turn) * row)


def rate_along(scp: np.ndarray, arp: np.ndarray, velocity: np.ndarray, column: np.ndarray) -> float:
    """By how much the range rate grows with each metre along the columns."""
    line = arp - scp
    across = velocity - (velocity @ line) / (line @ line) * line
    return float(-across @ column / np.linalg.norm(line))


def locate(
    kind: str,
    place: np.ndarray,
    scp: np.ndarray,
    arp: np.ndarray,
    velocity: np.ndarray,
    row: np.ndarray,
    column: np.ndarray,
) -> np.ndarray:
    """(xrow, ycol) of a scatterer, metres: where range and range rate are its own."""

    def seen(point: np.ndarray) -> np.ndarray:
        line = arp - point
        distance = np.linalg.norm(line)
        return np.array([distance, velocity @ line / distance])

    wanted = seen(place)
    if kind == "RGAZIM":  # polar format, at the middle of its aperture
        difference = wanted - seen(scp)
        return np.array([difference[0], difference[1] / rate_along(scp, arp, velocity, column)])
    if kind == "RGZERO":  # closest approach of a straight track; its columns grow with time
        speed = float(np.linalg.norm(velocity))
        since = -(velocity @ (arp - place)) / speed**2
        closest = np.linalg.norm(arp + since * velocity - place)
        return np.array([closest - np.linalg.norm(arp - scp), since * math.copysign(speed, velocity @ column)])
    found = np.zeros(2)
    for _ in range(20):
        here = seen(scp + found @ np.array([row, column]))
        steps = np.array([seen(scp + (found + step) @ np.array([row, column])) - here for step in np.eye(2)]).T
        found = found + np.linalg.solve(steps, wanted - here)
    return found
