"""MATLAB 5 files: what SciPy writes is read as it was; garbled ones are those of the fuzz harness."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from sarsplat.errors import SarsplatError
from sarsplat.importers.mat import read_mat


def write(path: Path, compressed: bool = False, **variables: object) -> Path:
    scipy.io.savemat(path, variables, do_compression=compressed)
    return path


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "c8", "c16"])
@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (4, 5), (2, 3, 4)])
def test_numbers(tmp_path, kind, shape, compressed):
    rng = np.random.default_rng(1)
    values = (100 * rng.random(shape)).astype(kind)
    if values.dtype.kind == "c":
        values = values + (1j * rng.random(shape)).astype(kind)
    read = read_mat(write(tmp_path / "a.mat", compressed, values=values, other=1.5))
    np.testing.assert_array_equal(read["values"], values)
    assert read["values"].dtype == values.dtype
    assert read["other"] == [[1.5]]


@pytest.mark.parametrize("compressed", [False, True])
def test_structs_and_what_has_no_counterpart(tmp_path, compressed):
    many = np.zeros(2, [("az", object)])
    many["az"] = [1.0, 2.0]
    cells = np.array([np.ones((2, 2)), "two"], object)
    sparse = scipy.sparse.eye_array(3).tocsc()
    inner = {"name": "M1 ü", "sizes": np.arange(3.0), "deeper": {"n": np.int32(7)}, "many": many, "sparse": sparse}
    read = read_mat(write(tmp_path / "a.mat", compressed, one=inner, cells=cells, rows=["ab"], none=np.zeros((0, 3))))
    assert set(read) == {"one", "none"}
    assert read["one"]["deeper"]["n"] == [[7]]
    np.testing.assert_array_equal(read["one"]["sizes"], [[0, 1, 2]])
    assert [read["one"][name] for name in ("name", "many", "sparse")] == [None, None, None]
    assert read["none"].size == 0


def element(kind: int, data: bytes, order: str = "<") -> bytes:
    return struct.pack(order + "II", kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(shape=(1, 2), values=b"\1\2", kind=2, array_class=6, name=b"a", order="<") -> bytes:
    flags = element(6, struct.pack(order + "II", array_class, 0), order)
    sizes = element(5, struct.pack(f"{order}{len(shape)}i", *shape), order)
    return element(14, flags + sizes + element(1, name, order) + element(kind, values, order), order)


def mat(*elements: bytes, order: str = "<") -> bytes:
    mark = b"\0\1IM" if order == "<" else b"\1\0MI"
    return b"MATLAB 5.0 MAT-file, made up".ljust(124) + mark + b"".join(elements)


def packed(data: bytes, level: int) -> bytes:
    inner = zlib.compress(data, level)
    return struct.pack("<II", 15, len(inner)) + inner


def test_version_7_3(tmp_path):
    """HDF5 reverses the axes; complex numbers are records, and text has numbers of letters."""
    h5py = pytest.importorskip("h5py")
    values = np.arange(12.0).reshape(3, 4)
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["values"], file["one/deeper"] = values.T, values.T.astype("i2")
        file["signal"] = np.rec.fromarrays([values.T, -values.T], [("real", "f8"), ("imag", "f8")])
        file["text"] = np.array([[72]], "u2")
        file["text"].attrs["MATLAB_class"] = np.bytes_("char")
        file.create_group("#refs#")
    with (tmp_path / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
    read = read_mat(tmp_path / "a.mat")
    assert set(read) == {"values", "one", "signal"}
    np.testing.assert_array_equal(read["values"], values)
    np.testing.assert_array_equal(read["signal"], values * (1 - 1j))
    np.testing.assert_array_equal(read["one"]["deeper"], values)


@pytest.mark.parametrize("order", ["<", ">"])
def test_either_byte_order_and_values_in_a_narrower_type(tmp_path, order):
    values = struct.pack(order + "2h", 3, -500)
    (tmp_path / "a.mat").write_bytes(mat(matrix(values=values, kind=3, order=order), order=order))
    (values,) = read_mat(tmp_path / "a.mat").values()
    assert values.dtype == np.float64
    assert values.tolist() == [[3, -500]]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM\x89HDF", "not a readable HDF5 file"),
        (b"MATLAB 4", "is not a MATLAB file; save it in MATLAB with -v7"),
        (mat(matrix(), matrix()), "the variable 'a' twice"),
        (mat(matrix(kind=16)), "values of type 16 in an array of float64"),
        (mat(matrix((1, 1), bytes(4), 7, 12)), "values of type 7 in an array of int32"),
        (mat(packed(matrix((1, 2**25), bytes(2**25)), 1)), "expands to more than 16 times its size"),
    ],
)
def test_what_is_refused(tmp_path, data, words):
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(SarsplatError, match=words):
        read_mat(tmp_path / "a.mat")
