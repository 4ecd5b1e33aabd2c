"""What strangers may hand to each reader: valid files of every kind, and structure-aware ways to spoil them."""

import json
import random
import re
import struct
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import tifffile
import torch
import trimesh
from PIL import Image

import cphds
import fuzz_pictures as pics
import fuzz_radar_files as radar
import sicds
from chip_files import COLUMNS, phoenix_bytes
from fuzz_mutations import NUMBERS, Mutation, spoil_bytes, spoil_json
from fuzz_radar_files import written
from made import dataset_of, in_memory, pack_glb
from sarsplat.data import (
    load_checkpoint,
    read_dataset,
    read_gaussians_ply,
    read_points_ply,
    read_tiff,
    save_checkpoint,
    write_dataset,
    write_gaussians_ply,
    write_points_ply,
)
from sarsplat.data.gltf_splats import glb_bytes
from sarsplat.data.ply import SPLAT
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, View
from sarsplat.importers import read_phoenix
from sarsplat.importers.mat import read_mat
from sarsplat.importers.mstar_chips import read_chips
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import SCHEMA_VERSION
from sarsplat.scenes import load_mesh
from sarsplat.settings.presets import PRESETS

GRID = ImageGrid(6, 5, (0.2, 0.3), (0.25, 0.35))
IMAGE = np.random.default_rng(1).gamma(1.0, size=(6, 5)).astype(np.float32)


@dataclass(frozen=True)
class Reader:
    """One reader, the file it gets, and how that file is spoilt."""

    name: str
    file: str  # path of the hostile file in a folder that `prepare` has filled
    read: Callable[[Path], object]  # takes that folder
    seeds: Callable[[], list[bytes]]
    mutations: tuple[Mutation, ...] = ()
    prepare: Callable[[Path], object] = lambda folder: None

    def spoil(self, data: bytes, rng: random.Random) -> bytes:
        """The file, changed in one to four places."""
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            data = rng.choice((*self.mutations * 2, spoil_bytes))(data, rng)
        return data[:MAX_BYTES]


MAX_BYTES = 1 << 17
SIGNALLING = b"\x01\0\x80\x7f"  # a NaN that warns when it is cast

# ---- Phoenix ----


def _phoenix_fits(data: bytes, rng: random.Random) -> bytes:
    """A header whose sizes are changed and whose data follow suit."""
    rows, columns = rng.choice((1, 2, 4, 64)), rng.choice((1, 3, 6, 64))
    data = re.sub(rb"NumberOfRows= \d+", b"NumberOfRows= %d" % rows, data, count=1)
    data = re.sub(rb"NumberOfColumns= \d+", b"NumberOfColumns= %d" % columns, data, count=1)
    head, end, _ = data.partition(b"[EndofPhoenixHeader]\n")
    head = re.sub(rb"PhoenixHeaderLength= \d+", b"PhoenixHeaderLength= %05d" % len(head + end), head)
    return (head + end + bytes(8 * rows * columns))[:MAX_BYTES]


def _read_phoenix(folder: Path) -> object:
    chip = read_phoenix(folder / "HB00001.000")
    assert np.isfinite(np.square(chip.magnitude)).all()
    told = chip.target_type, chip.serial, chip.target_az_deg, chip.spacing_m, chip.resolution_m, chip.radar_position
    return chip, told


# ---- datasets and their images ----


def prepare_dataset(folder: Path) -> None:
    """A dataset of four views in the folder `set`."""
    views = [(View(10.0 * k, 20.0), "train" if k else "test-17") for k in range(4)]
    truth = trimesh.creation.box((3.0, 2.0, 1.0))
    images = np.stack([IMAGE] * 4)
    write_dataset(folder / "set", dataset_of(GRID, views, images, source={"kind": "é"}), truth_mesh=truth)


def _dataset_header() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        prepare_dataset(Path(folder))
        return [(Path(folder) / "set/dataset.json").read_bytes()]


def _read_dataset(folder: Path) -> object:
    dataset = read_dataset(folder / "set")
    str(dataset.source).encode()  # what `sarsplat info` prints
    return dataset, dataset.fingerprint(), [dataset.images(split).mean() for split in dataset.splits()]


def _tiffs() -> list[bytes]:
    kinds: list[tuple[np.ndarray, dict[str, Any]]] = [
        (IMAGE, {"metadata": None, "description": "power"}),
        (IMAGE, {"byteorder": ">", "metadata": None}),
        (IMAGE, {"bigtiff": True, "metadata": None}),
        (np.stack([IMAGE, IMAGE]), {"metadata": None, "photometric": "minisblack"}),
        (np.zeros((2048, 2048), np.float32), {"compression": "zlib"}),  # a bomb: 16 MiB in 16 KiB
        (np.zeros((6, 5), np.float32), {"compression": "zlib", "description": "x" * 200}),
        (np.zeros((16, 16), np.float32), {"tile": (16, 16)}),
        (IMAGE.astype(np.float64), {}),
        (IMAGE, {"ome": True}),
        (IMAGE, {"imagej": True}),
    ]
    return [in_memory(tifffile.imwrite, image, **options) for image, options in kinds]


def _spoil_tiff(data: bytes, rng: random.Random) -> bytes:
    """One tag of the first directory: its number, type, count or value."""
    if len(data) < 30 or data[:4] != b"II*\0":
        return spoil_bytes(data, rng)
    start = struct.unpack_from("<I", data, 4)[0]
    if start + 14 > len(data):
        return spoil_bytes(data, rng)
    count = struct.unpack_from("<H", data, start)[0]
    place = start + 2 + 12 * rng.randrange(max(1, min(count, 20)))
    tags = (256, 257, 258, 259, 262, 270, 273, 277, 278, 279, 284, 322, 324, 325, 330, 339, 347, 34735, 65535)
    fields = ((0, "<H", tags), (2, "<H", range(20)), (4, "<I", NUMBERS), (8, "<I", NUMBERS))
    offset, code, values = rng.choice(fields)
    value = rng.choice(values)
    packed = struct.pack(code, value % 256 ** struct.calcsize(code))
    return data[: place + offset] + packed + data[place + offset + len(packed) :]


def _read_tiff(folder: Path) -> object:
    power = read_tiff(folder / "image.tif", (6, 5))
    assert power.shape == (6, 5)
    return power.mean()


# ---- PLY ----


def _gaussians(degree: int, glb: bool = False) -> bytes:
    g = torch.Generator().manual_seed(degree)
    some = Gaussians(
        torch.randn(5, 3, generator=g), torch.randn(5, 4, generator=g), torch.rand(5, 3, generator=g) + 0.1,
        torch.rand(5, generator=g), Harmonics(torch.randn(5, (degree + 1) ** 2, generator=g), 0.05),
    )  # fmt: skip
    return glb_bytes(some, "db") if glb else written(lambda path: write_gaussians_ply(path, some))


def _points() -> bytes:
    points = np.random.default_rng(0).normal(size=(9, 3))
    return written(lambda path: write_points_ply(path, points, power=np.arange(9), support=np.linspace(0, 1, 9)))


def _ply_fits(data: bytes, rng: random.Random) -> bytes:
    """Types, names and counts changed in the header, and the data cut or filled to the length it then asks for."""
    head, end, body = data.partition(b"end_header\n")
    lines, sizes = head.split(b"\n"), {b"uchar": 1, b"double": 8, b"float": 4, b"int": 4}
    for _ in range(rng.choice((1, 3))):
        place = rng.randrange(len(lines))
        kind, name = rng.choice([*sizes]), rng.choice((b"x", b"a", b"scale_0", b"f_rest_9"))
        new = (b"property " + kind + b" " + name, b"element vertex %d" % rng.choice((0, 1, 50_000)), b"element e 3")
        lines[place] = rng.choice(new)
    size = count = 0
    for words in (line.split() for line in lines):
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit():
            count = int(words[2])
        if len(words) == 3 and words[0] == b"property":
            size += count * sizes.get(words[1], 0)
    if size > MAX_BYTES:
        return data
    fill = rng.choice((b"\0", b"\xff", b"\x3f"))
    return b"\n".join(lines) + end + (body + fill * size)[:size]


def _splat() -> bytes:
    table = np.zeros(5, SPLAT)
    table["position"], table["scale"] = np.arange(15).reshape(5, 3), 0.5
    table["rgba"], table["rotation"] = 99, 200
    return table.tobytes()


def _gaussians_reader(name: str, seeds: Callable[[], list[bytes]], *mutations: Mutation) -> Reader:
    return Reader(name, name, lambda folder: _finite(read_gaussians_ply(folder / name)), seeds, mutations)


def _finite(gaussians: Gaussians) -> object:
    assert all(torch.isfinite(tensor).all() for tensor in gaussians.tensors().values())
    return gaussians


# ---- checkpoints ----


def _checkpoints() -> list[bytes]:
    tensors = {"model/means": torch.randn(4, 3), "mask": torch.tensor([True]), "n": torch.arange(3)}
    state = {"iteration": 7, "seconds": 1.5, "g": [2**70, "ü"]}
    return [written(lambda path: save_checkpoint(path, tensors, state)), safetensors.torch.save({"x": torch.ones(3)})]


def _spoil_checkpoint(data: bytes, rng: random.Random) -> bytes:
    """The JSON of the header or the state in it, with the header's length put right."""
    length = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(data[8 : 8 + length])
        if rng.random() < 0.5:
            header["__metadata__"]["state"] = spoil_json(header["__metadata__"]["state"].encode(), rng).decode(
                "latin-1"
            )
            text = json.dumps(header).encode()
        elif rng.random() < 0.1:
            empty = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
            text = json.dumps({str(k): empty for k in range(5000)} | header).encode()
        else:
            text = spoil_json(data[8 : 8 + length], rng)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return spoil_bytes(data, rng)
    return len(text).to_bytes(8, "little") + text + data[8 + length :]


# ---- runs ----


def _run_reader(name: str, file: str, what: str, seeds: Callable[[], list[bytes]], mutation: Mutation) -> Reader:
    def prepare(folder: Path) -> None:
        (folder / "run").mkdir()
        (folder / "run/config.json").write_bytes(_run_config()[0])

    return Reader(name, f"run/{file}", lambda at: getattr(Run.load(at / "run"), what), seeds, (mutation,), prepare)


def _run_config() -> list[bytes]:
    head = {"schema": "sarsplat-run", "schema_version": SCHEMA_VERSION, "method": "sar-gs"}
    head |= {"dataset": "/nowhere", "dataset_fingerprint": "0" * 64, "config": asdict(PRESETS["measured"])}
    return [json.dumps(head).encode()]


def _history() -> list[bytes]:
    line = {"iteration": 1, "seconds": 0.5, "loss": 0.25, "gaussians": 100}
    return ["".join(json.dumps({**line, "iteration": k}) + "\n" for k in range(5)).encode()]


def _spoil_lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    place = rng.randrange(len(lines))
    lines[place] = spoil_json(lines[place], rng)
    return b"\n".join(lines)


def _metrics() -> list[bytes]:
    scores = {"psnr_db": 30.5, "ssim": 0.9, "lpips": None}
    found = {"images": {"test": scores}, "points": {"visible": {"cd_m": 0.1}}, "mesh": {}, "baselines": None}
    found |= {"truth": {"mesh": None}, "time_s": 2.5, "seed": 0, "parameters": {"mean_power": 0.1}}
    found |= {"definitions": {"ssim": "…"}, "reasons": {"a": "b"}}
    return [json.dumps(found).encode()]


# ---- meshes ----


def _mesh(kind: str) -> list[bytes]:
    box = trimesh.creation.box((4, 2, 1))
    scene = trimesh.Scene([box, trimesh.creation.icosphere(subdivisions=1).apply_translation((0, 0, 2))])
    match kind:
        case "obj":
            text = "mtllib a.mtl\nv 0 0 0\nv 2 0 0\nv 2 2 0 1 0 0\nv 0 2 1\nvt 0 0\nvn 0 0 1\n"
            faces = "f 1 2 3\nusemtl b\nf 1/1/1 2/1/1 3/1/1\nf 1//1 3//1 4//1\nf 1 2 3 4\n"
            concave = (
                "v 0 0 0\nv 4 0 0\nv 4 1 0\nv 1 1 0\nv 1 4 0\nv 0 4 0\nf 2 3 4 5 6 1\nf 1/1 2/1 4/1 6/1\nf 1 2 3\n"
            )
            back = text + "f -4/-1/-1 -3/-1/-1 \\\n -2/-1/-1\nv 0 0 1\nf -1 -2 -3 -4\n"
            return [box.export(file_type="obj").encode(), *(made.encode() for made in (text + faces, concave, back))]
        case "stl":
            return [box.export(file_type="stl"), box.export(file_type="stl_ascii").encode()]
        case "ply":
            # Headers that end with a texture, and lists of differing lengths.
            head = "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 4\nproperty float x\n"
            head += "property float y\nproperty float z\nelement face 2\nproperty list uchar int vertex_indices\n"
            ascii_ply = head + "end_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n4 0 1 2 3\n"
            binary = head.replace("ascii", "binary_big_endian") + "end_header\n"
            corners = np.array([(0, 0, 0), (4, 0, 0), (1, 1, 0), (0, 4, 0)], ">f4").tobytes()
            lists = [b"\x03" + np.arange(3, dtype=">i4").tobytes(), b"\x04" + np.arange(4, dtype=">i4").tobytes()]
            mixed = binary.encode() + corners + b"".join(lists)
            plain = [box.export(file_type="ply"), box.export(file_type="ply", encoding="ascii")]
            return [*plain, ascii_ply.encode(), mixed]
        case "off":
            square = b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
            dented = [square.replace(b"1 1 0\n", corner + b" .2 0\n") for corner in (b".2", b"1e300")]
            return [box.export(file_type="off").encode(), square, *dented]
    glb = scene.export(file_type="glb")
    return [glb, _with_header(glb, _instances), _with_header(glb, _with_fan)]


def _with_fan(text: bytes) -> bytes:
    """The first mesh as a fan, and a hidden node."""
    header = json.loads(text)
    header["meshes"][0]["primitives"][0]["mode"] = 6
    header["nodes"][-1]["extensions"] = {"KHR_node_visibility": {"visible": False}}
    return json.dumps(header).encode()


def _instances(text: bytes) -> bytes:
    """A thousand copies of the first mesh."""
    copies = {"nodes": [{"mesh": 0}] * 1000, "scenes": [{"nodes": list(range(1000))}]}
    return json.dumps({**json.loads(text), **copies}).encode()


def _with_header(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """A GLB whose JSON is changed, with the lengths put right."""
    length = int.from_bytes(data[12:16], "little")
    return pack_glb(change(data[20 : 20 + length]), data[20 + length :])


def _spoil_glb(data: bytes, rng: random.Random) -> bytes:
    return _with_header(data, lambda text: spoil_json(text, rng))


def _mesh_reader(kind: str, *mutations: Mutation) -> Reader:
    name = f"mesh.{kind}"
    return Reader(name, name, lambda folder: load_mesh(folder / name).area, lambda: _mesh(kind), mutations)


# ---- chips ----


def _jpeg() -> bytes:
    return in_memory(Image.fromarray((IMAGE * 20).astype(np.uint8)).save, "JPEG")


_LABELS = (
    ",".join([*COLUMNS, "dn_per_magnitude"]) + "\na.jpeg,T72,132,17,17.1,10.5,500\nb.jpeg,BMP2,9563,15,15.1,20,99.5\n"
).encode()


def _chips(folder: Path) -> None:
    (folder / "chips").mkdir()
    (folder / "chips/a.jpeg").write_bytes(_jpeg())
    (folder / "labels.csv").write_bytes(_LABELS)


def _read_chips(folder: Path) -> object:
    return [chip.magnitude for chip in read_chips(folder / "chips", folder / "labels.csv", "T72")]


_LITTLE, _BIG = radar.spoil_number(("<f4", "<f8"), 128), radar.spoil_number((">f4", ">f8"), 4096)

READERS = (
    Reader("phoenix", "HB00001.000", _read_phoenix, lambda: [phoenix_bytes()], (_phoenix_fits,)),
    Reader("dataset.json", "set/dataset.json", _read_dataset, _dataset_header, (spoil_json,), prepare_dataset),
    Reader("image.tif", "image.tif", _read_tiff, _tiffs, (_spoil_tiff,)),
    _gaussians_reader("gaussians.ply", lambda: [_gaussians(0), _gaussians(2)], _ply_fits),
    _gaussians_reader("gaussians.glb", lambda: [_gaussians(1, glb=True)], _spoil_glb),
    _gaussians_reader("g.splat", lambda: [_splat(), SIGNALLING + _splat()[4:]]),
    Reader(
        "points.ply",
        "p.ply",
        lambda folder: read_points_ply(folder / "p.ply"),
        lambda: [_points(), _points()[:-4] + SIGNALLING],
        (_ply_fits,),
    ),
    Reader(
        "checkpoint", "c.ckpt", lambda folder: load_checkpoint(folder / "c.ckpt"), _checkpoints, (_spoil_checkpoint,)
    ),
    _run_reader("run config", "config.json", "config", _run_config, spoil_json),
    _run_reader("run history", "metrics.jsonl", "history", _history, _spoil_lines),
    _run_reader("run metrics", "metrics.json", "metrics", _metrics, spoil_json),
    _mesh_reader("obj"),
    _mesh_reader("stl"),
    _mesh_reader("ply", _ply_fits),
    _mesh_reader("off"),
    _mesh_reader("glb", _spoil_glb),
    Reader("labels.csv", "labels.csv", _read_chips, lambda: [_LABELS], (), _chips),
    Reader("chip.jpeg", "chips/a.jpeg", _read_chips, lambda: [_jpeg()], (), _chips),
    Reader("sicd", "a.nitf", radar.read_sicd, radar.sicd_seeds, (radar.spoil_xml(sicds),)),
    Reader("rslc", "a.h5", radar.read_rslc, radar.rslc_seeds),
    Reader("mat", "a.mat", lambda folder: read_mat(folder / "a.mat"), radar.mat_seeds, (radar.spoil_mat,)),
    Reader("gotcha", "a.mat", radar.read_pulses, radar.pulse_seeds, (radar.spoil_mat, _LITTLE)),
    Reader("cphd", "a.cphd", radar.read_cphd, radar.cphd_seeds, (radar.spoil_xml(cphds), _BIG)),
    Reader("folder table", "shots/t.csv", pics.read_table, pics.tables, (pics.spoil_cell,), pics.prepare_table),
    Reader("folder picture", "picture", pics.read_picture, pics.pictures, (_spoil_tiff, pics.spoil_npy)),
    Reader("sample", pics.SAMPLE_FILE, pics.read_sample, pics.samples, (radar.spoil_mat,), pics.prepare_sample),
)
