"""Files from strangers: read, or refused with one sentence; never a crash, a hang or a flood of memory.

`make fuzz` tries many more inputs on the same readers.
"""

import json
import os
import pickle
import re
import shutil
import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import sarsplat
from fuzz import Tally, judge, sentence_faults, watched
from fuzz_inputs import GRID, READERS, Reader, prepare_dataset
from made import pack_glb
from sarsplat.cli import main
from sarsplat.data import load_checkpoint, read_dataset, read_json, read_points_ply, read_tiff, write_json, write_tiff
from sarsplat.errors import SarsplatError
from sarsplat.importers import read_phoenix
from sarsplat.scenes import load_mesh

SUFFIXES = (".000", ".json", ".tif", ".ply", ".safetensors", ".obj", ".stl", ".off", ".glb")


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> dict[str, Path]:
    """A prepared folder for each reader."""
    folders = {reader.name: tmp_path_factory.mktemp("reader") for reader in READERS}
    for reader in READERS:
        reader.prepare(folders[reader.name])
    return folders


@cache
def seeds_of(reader: Reader) -> list[bytes]:
    return reader.seeds()


class TooLong(BaseException):
    """No reader can take it for an error of the file."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TooLong(f"it took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # of one view alone, for instance
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_valid_files_are_read(reader, places):
    path = places[reader.name] / reader.file
    path.write_bytes(seeds_of(reader)[0])
    reader.read(places[reader.name])


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_spoilt_files_are_read_or_refused(reader, places):
    for number in range(10):
        rng = Random(number)
        data = reader.spoil(rng.choice(seeds_of(reader)), rng)
        assert judge(reader, places[reader.name], data, Tally()) is None, number


SPECIAL = {
    "pipe": os.mkfifo,
    "zero": lambda path: path.symlink_to("/dev/zero"),
    "loop": lambda path: path.symlink_to(path),
    "folder": Path.mkdir,
    "absent": id,
    "empty": Path.touch,
    "sparse": lambda path: path.touch() or os.truncate(path, 2**40),
}
"""What a path may lead to besides a file with something in it."""

READ = {".000": read_phoenix, ".json": lambda path: read_json(path, Any), ".safetensors": load_checkpoint}
READ |= {".tif": lambda path: read_tiff(path, (6, 5))}


def read(path: Path) -> None:
    READ.get(path.suffix, load_mesh)(path)


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_file_is_refused_at_once(tmp_path, suffix, kind):
    path = tmp_path / f"it{suffix}"
    SPECIAL[kind](path)
    for reader in (read, read_points_ply) if suffix == ".ply" else (read,):
        with at_most(5), watched() as cost, pytest.raises(SarsplatError, match=re.escape(str(path))) as caught:
            reader(path)
        assert cost.seconds < 1
        assert cost.bytes < 64 << 20
        assert sentence_faults(str(caught.value)) == []


def test_nothing_is_ever_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    for suffix in (*SUFFIXES, ".pkl", ".npy", ".npz", ".pt"):
        path = tmp_path / f"it{suffix}"
        path.write_bytes(pickle.dumps(Evil()))
        with pytest.raises(SarsplatError, match=str(path)):
            read(path)
    assert not (tmp_path / "ran").exists()
    sources = "".join(file.read_text() for file in Path(sarsplat.__file__).parent.rglob("*.py"))
    assert re.findall(r"pickle\.load|allow_pickle=True|weights_only=False|joblib|shelve", sources) == []


# ---- JSON and datasets ----


@pytest.mark.parametrize("text", [b'{"a": -Infinity}', rb'["\ud800"]', b'{"a": 1e999}', b'{"a":' * 100_000])
def test_json(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text)
    with watched() as cost, pytest.raises(SarsplatError, match=str(path)):
        read_json(path, Any)
    assert cost.bytes < 4 * len(text) + (64 << 20)
    path.write_text(r'["😀 \ud83d\ude00"]', encoding="utf-8")
    assert read_json(path, Any) == ["😀 😀"]


def test_folders_whose_names_are_not_text(tmp_path):
    prepare_dataset(tmp_path)
    there = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe"))
    shutil.move(tmp_path / "set", there)
    assert read_dataset(there).grid == GRID
    assert main(["info", str(there)]) == 0
    with pytest.raises(SarsplatError, match=r"cannot be written as JSON: .*surrogates not allowed"):
        write_json(tmp_path / "a.json", {"seed": 0, "dataset": os.fsdecode(b"a/\xff")})  # as a run names it


@pytest.mark.parametrize("pages", [1, 3])
def test_stacks_of_another_number_of_pages(tmp_path, pages):
    stack = np.ones((pages, 6, 5), np.complex64)
    write_tiff(tmp_path / "a.tif", stack, "a stack")
    np.testing.assert_array_equal(read_tiff(tmp_path / "a.tif", (pages, 6, 5), np.complex64), stack)
    with pytest.raises(SarsplatError, match=r"give 2 pages of uncompressed complex64|bytes, too few"):
        read_tiff(tmp_path / "a.tif", (2, 6, 5), np.complex64)


# ---- headers that promise more than there is ----


@pytest.mark.parametrize(
    "lines",
    [
        b"comment end_header\nelement more 900000000000\nproperty double q\n",
        b"comment \x0belement none 0\nproperty double q\n",  # splitlines sees two lines
        b"element none 0\relement more 900000000000\nproperty double q\n",
    ],
)
def test_ply_headers_that_promise_more_than_there_is(tmp_path, lines):
    path = tmp_path / "p.ply"
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    head += b"property float z\n"
    path.write_bytes(head + lines + b"end_header\n" + bytes(12))
    with watched() as cost, pytest.raises(SarsplatError):
        read_points_ply(path)
    assert cost.bytes < 64 << 20


def triangle(**changes: object) -> bytes:
    scene = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    body = struct.pack("<I4s9f", 36, b"BIN\0", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    return pack_glb(json.dumps({**scene, **changes}).encode(), body)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"accessors": [{"componentType": 5126, "count": 10**9, "type": "VEC3"}]}, "sparse and compressed"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**9, "type": "VEC3"}]}, "expands"),
        ({"nodes": [{"mesh": 0}] * 5000, "scenes": [{"nodes": [*range(5000)]}]}, "expands"),
        ({"nodes": [{"children": [*range(90)], "mesh": 0}] * 90, "scenes": [{"nodes": [*range(90)]}]}, "expands"),
        ({"buffers": [{"byteLength": 36, "uri": "pipe"}]}, "cannot be read"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": -3, "type": "VEC3"}]}, "not a count"),
        ({"extras": "x" * (1 << 20)}, "bytes of JSON"),
    ],
)
def test_glb_scenes_that_unfold(tmp_path, changes, words):
    path = tmp_path / "a.glb"
    os.mkfifo(tmp_path / "pipe")
    path.write_bytes(triangle())
    assert len(load_mesh(path).faces) == 1
    path.write_bytes(triangle(**changes))
    with at_most(5), watched() as cost, pytest.raises(SarsplatError, match=words):
        load_mesh(path)
    assert cost.seconds < 1
    assert cost.bytes < 64 << 20


def test_meshes_open_no_other_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")  # opening it would hang
    square = "v 0 0 0\nv 2 0 0\nv 2 2 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text("mtllib pipe\nusemtl a\n" + square)
    head = "ply\nformat ascii 1.0\ncomment TextureFile pipe\nelement vertex 3\nproperty float x\nproperty float y\n"
    head += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0\n2 0 0\n2 2 0\n3 0 1 2\n")
    with at_most(5):
        assert len(load_mesh(tmp_path / "a.obj").faces) == 1
        assert len(load_mesh(tmp_path / "a.ply").faces) == 1


@pytest.mark.parametrize("name", ["a.obj", "a.off", "a.stl", "a.ply"])
def test_text_that_is_too_long(tmp_path, name):
    with (tmp_path / name).open("wb") as file:
        file.write(b"ply\nformat ascii 1.0\n")
        file.truncate(60 << 20)
    with watched() as cost, pytest.raises(SarsplatError, match="62914560 bytes of text; simplify the mesh"):
        load_mesh(tmp_path / name)
    assert cost.seconds < 1


def test_text_that_is_not_utf8(tmp_path):
    (tmp_path / "a.off").write_bytes(b"OFF # \xe9t\xe9\n3 1 0\n0 0 0\n2 0 0\n2 2 0\n3 0 1 2\n")
    assert len(load_mesh(tmp_path / "a.off").faces) == 1
