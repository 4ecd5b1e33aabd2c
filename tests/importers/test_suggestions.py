"""Every command that `sarsplat info` suggests runs as it is printed, once the words in capitals are replaced."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from chip_files import ROWS, write_chips
from geocoded import write_map
from pulses import circle, record
from pulses import write as write_pulses
from sample_files import write_sample
from sarsplat.cli import main

pytestmark = [
    pytest.mark.usefixtures("undrawn"),
    pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning"),
]

RNG = np.random.default_rng(0)
POWER = RNG.gamma(1.0, size=(4, 24, 20)).astype(np.float32) + 0.1
COMPLEX = (POWER * np.exp(1j * RNG.uniform(0, 6, POWER.shape))).astype(np.complex64)
REPLACED = {"DEGREES": "35", "METRES": "0.5", "QUANTITY": "power", "GROUND": "level", "SIDE": "right", "NAME": "angle"}


def table(folder: Path, names: list[str], columns: str = "file,azimuth,grazing", more: str = ",30") -> None:
    rows = [f"{name},{90 * k}{more}" for k, name in enumerate(names)]
    (folder / "t.csv").write_text("\n".join([columns, *rows]))


def tiffs(folder: Path, images: np.ndarray, write: Callable[[Path, np.ndarray], object] = tifffile.imwrite) -> None:
    for k, image in enumerate(images):
        write(folder / f"{k}.tif", image)


def npys(folder: Path, images: np.ndarray = POWER) -> None:
    for k, image in enumerate(images):
        np.save(folder / f"{k}.npy", image)


def mats(folder: Path, images: np.ndarray = POWER) -> None:
    for k, image in enumerate(images):
        scipy.io.savemat(folder / f"{k}.mat", {"image": image})


def pngs(folder: Path) -> None:
    for k, image in enumerate(POWER):
        Image.fromarray((image * 30).clip(0, 255).astype(np.uint8)).save(folder / f"{k}.png")


def maps(folder: Path, images: np.ndarray) -> None:
    tiffs(folder, images, lambda path, image: write_map(path, image, 0.5))


def names(ending: str) -> list[str]:
    return [f"{k}{ending}" for k in range(4)]


def stack(folder: Path) -> None:
    npys(folder, COMPLEX)
    rows = [f"{k}.npy,{90 * (k // 2)},30,v{k // 2},{0.001 * (k % 2)}" for k in range(4)]
    (folder / "t.csv").write_text("\n".join(["file,azimuth,grazing,view,baseline", *rows]))


def headings(folder: Path) -> None:
    tiffs(folder, POWER)
    table(folder, names(".tif"), "file,heading,incidence")


def sample(folder: Path) -> None:
    for image, azimuth in zip(COMPLEX, (11.0, 100.0, 190.0, 280.0), strict=True):
        write_sample(folder, image, azimuth)


def pulses(folder: Path) -> None:
    write_pulses(folder / "p.mat", record(circle(np.linspace(0, 3, 200)), [(0.0, 0.0, 0.0)]))


def sicd(folder: Path) -> None:
    pytest.importorskip("sarkit")
    from sicds import Track, write_sicd

    write_sicd(folder / "a b.nitf", Track(40.0, 35.0), [(0.0, 0.0, 0.0)])


def cphd(folder: Path) -> None:
    pytest.importorskip("sarkit")
    from cphds import Collection, arc, write_cphd

    write_cphd(folder / "a b.cphd", Collection(arc(30.0, 2.0, 80)), [((0.0, 0.0, 0.0), 1.0)])  # type: ignore[list-item]


def rslc(folder: Path) -> None:
    pytest.importorskip("h5py")
    from rslcs import write_rslc

    image = (RNG.integers(-50, 50, (40, 30, 2)) @ [1, 1j]).astype(np.complex64)
    write_rslc(folder / "q.h5", {"HH": image, "HV": image[::-1], "VH": image[::-1], "VV": image[:, ::-1]})


def both(*steps: Callable[[Path], object]) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        for step in steps:
            step(folder)

    return make


KINDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "float TIFFs with a table": (both(lambda at: tiffs(at, POWER), lambda at: table(at, names(".tif"))), ""),
    "complex TIFFs": (both(lambda at: tiffs(at, COMPLEX), lambda at: table(at, names(".tif"))), ""),
    "float GeoTIFFs": (both(lambda at: maps(at, POWER), lambda at: table(at, names(".tif"))), ""),
    "8-bit GeoTIFFs": (
        both(lambda at: maps(at, (POWER * 30).clip(0, 255).astype(np.uint8)), lambda at: table(at, names(".tif"))),
        "",
    ),
    "float TIFFs with headings": (headings, ""),
    "float arrays with a table": (both(npys, lambda at: table(at, names(".npy"))), ""),
    "MATLAB files with a table": (both(mats, lambda at: table(at, names(".mat"))), ""),
    "PNGs without grazing angles": (both(pngs, lambda at: table(at, names(".png"), "file,azimuth", "")), ""),
    "PNGs whose azimuths are called otherwise": (
        both(pngs, lambda at: table(at, names(".png"), "file,angle,grazing")),
        "",
    ),
    "PNGs without a table": (pngs, ""),
    "float TIFFs without a table": (lambda at: tiffs(at, POWER), ""),
    "one array": (npys, "0.npy"),
    "one complex array": (lambda at: npys(at, COMPLEX), "0.npy"),
    "one MATLAB file": (mats, "0.mat"),
    "a stack": (stack, ""),
    "SAMPLE": (sample, ""),
    "MSTAR": (lambda at: write_chips(at, ROWS), ""),
    "a SICD": (sicd, "a b.nitf"),
    "a folder with a SICD": (sicd, ""),
    "phase history": (pulses, "p.mat"),
    "a CPHD": (cphd, "a b.cphd"),
    "an RSLC": (rslc, "q.h5"),
}

SIZES = {"phase history": "6", "an RSLC": "60"}


@pytest.mark.parametrize("kind", KINDS)
def test_what_info_suggests_runs_as_printed(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make, file = KINDS[kind]
    folder = tmp_path / "my data"  # a name that must be quoted
    folder.mkdir()
    make(folder)
    assert main(["info", str(folder / file)]) == 0
    said = capsys.readouterr().out.splitlines()
    (line,) = (line for line in said if line.startswith("import with: "))
    words = shlex.split(line.removeprefix("import with: "))
    explained = " ".join(line for line in said if line.startswith("  --"))
    for word in set(re.findall(r"\b[A-Z]{4,}\b(?!\.)", " ".join(words[2:]).replace(str(folder), ""))):
        assert f" {word}: " in explained, word
    sizes = {"METRES": SIZES.get(kind, "20")} if "--size" in words else {"METRES": "0.03"} if kind == "a stack" else {}
    if "TABLE.csv" in words:
        ending = next(path.suffix for path in sorted(folder.iterdir()))
        table(tmp_path, names(ending))
        words[words.index("TABLE.csv")] = str(tmp_path / "t.csv")
    words = [re.sub(r"\b[A-Z]{4,}\b", lambda found: (REPLACED | sizes).get(found[0], found[0]), word) for word in words]
    words[words.index("--out") + 1] = str(tmp_path / "out")
    code = main(words[1:])
    assert code in (0, 1), capsys.readouterr().err  # 1: noise contradicts what is said of it
    assert (tmp_path / "out" / "dataset.json").is_file()


def test_what_info_says_of_a_map_of_others_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_map(tmp_path / "a dem.tif", np.add.outer(np.arange(20.0), np.zeros(30)).astype(np.float32), 2.0)
    assert main(["info", str(path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    words = shlex.split(re.search(r"`(sarsplat export [^`]*)`", said)[1])  # type: ignore[index]
    words = [REPLACED.get(word, word) for word in words]
    words[words.index("layover-shadow.tif")] = str(tmp_path / "layover-shadow.tif")
    assert main(words[1:]) == 0
