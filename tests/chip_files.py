"""Made-up MSTAR chips: Phoenix files, and JPEGs with their labels."""

import csv
from pathlib import Path

import numpy as np
from PIL import Image

FIELDS = {
    "native_header_length": "0",
    "NumberOfColumns": "6",
    "NumberOfRows": "4",
    "TargetType": "t72_tank",
    "TargetSerNum": "132",
    "TargetAz": "10.790657",
    "DesiredDepression": "17",
    "MeasuredDepression": "17.093750",
    "RadarPosition": "bottom",
    "Range3dBWidth": "0.301300",
    "CrossRange3dBWidth": "0.322900",
    "RangePixelSpacing": "0.202148",
    "CrossRangePixelSpacing": "0.203125",
}
MAGNITUDE = np.arange(24, dtype=np.float32).reshape(4, 6) / 50


def phoenix_bytes(magnitude: np.ndarray = MAGNITUDE, **changes: str) -> bytes:
    fields = {**FIELDS, "NumberOfRows": str(magnitude.shape[0]), "NumberOfColumns": str(magnitude.shape[1]), **changes}
    body = "".join(f"{key}= {value}\n" for key, value in fields.items()) + "[EndofPhoenixHeader]\n"
    top = "\n[PhoenixHeaderVer01.04]\nPhoenixHeaderLength= 00000\n"
    header = top.replace("00000", f"{len(top) + len(body):05d}") + body
    phase = np.full_like(magnitude, 3.0)
    return header.encode() + magnitude.astype(">f4").tobytes() + phase.astype(">f4").tobytes()


def write_originals(folder: Path, factor: float = 1 / 300) -> Path:
    """Five Phoenix files of a T72, and one of a BMP2."""
    folder.mkdir(exist_ok=True)
    for index, azimuth in enumerate((2, 92, 178, 275, 300)):
        magnitude = LOWER_LEFT * np.float32(factor * (1 + index / 500))
        (folder / f"HB{index}.015").write_bytes(phoenix_bytes(magnitude, TargetAz=str(azimuth)))
    (folder / "HB0.000").write_bytes(phoenix_bytes(TargetType="bmp2_tank"))
    return folder


COLUMNS = ["path", "class", "serial", "desired_depression_deg", "measured_depression_deg", "target_az_deg"]
LOWER_LEFT = np.zeros((16, 16), np.uint8)
LOWER_LEFT[8:, :8] = 200 - np.add.outer(range(8), range(8)) % 3  # near: the radar is at the bottom


def write_chips(folder: Path, rows: list[tuple], size: int = 16, *, random: bool = False) -> Path:
    """JPEGs and their labels; rows are (class, serial, depression, azimuth)."""
    with (folder / "labels.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for index, (name, serial, depression, azimuth) in enumerate(rows):
            path = folder / name / f"chip{index:03d}.jpeg"
            path.parent.mkdir(exist_ok=True)
            picture = np.resize(LOWER_LEFT, (size, size)) - index % 5 * (np.resize(LOWER_LEFT, (size, size)) > 0)
            picture[-1, 0] -= index // 5  # no two alike
            if random:
                picture = np.random.default_rng(index).integers(20, 255, picture.shape)
            Image.fromarray(picture.astype(np.uint8)).save(path, quality=100)
            table.writerow([f"{name}/{path.name}", name, serial, depression, depression + 0.1, azimuth])
    return folder / "labels.csv"


ROWS = [("T72", "132", 17, azimuth) for azimuth in (1, 44, 89, 91, 181, 269, 330, 359.5)]
ROWS += [("T72", "132", 15, azimuth) for azimuth in (10, 100)] + [("BMP2", "9563", 17, 5)]
