"""MATLAB files: numbers and structs, of versions 5 (`save -v6`, `-v7`) and 7.3, which is HDF5, by h5py.

SciPy's reader crashes on some damaged files. A file of version 5 is a list of elements, each a tag (type, bytes) and
data; an array is an element that holds further ones: flags, dimensions, name, values. Files are untrusted: sizes must
fit their container, and the unpacked size is limited by the file's.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.importers.files import complex_of, hdf5_array, opened_hdf5

if TYPE_CHECKING:
    import h5py

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Types of elements that hold numbers → types of numpy."""
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
_STRUCT = 2
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""Classes of arrays of numbers → types of numpy; a file may hold values in a narrower type."""
_COMPLEX = 0x800
_DEEPEST = 16
_EXPANSION, _FREE_BYTES = 16, 16 << 20
"""Maximum unpacked size: factor on the size of the file, and bytes besides; measured data compress far less."""
_BYTES_PER_ARRAY = 512  # memory of an array besides its values, bytes


def read_mat(path: str | Path) -> dict[str, Any]:
    """Read the variables of a MATLAB file, as `save -v6`, `save -v7` (MATLAB's default) or `save -v7.3` writes it.

    Numbers are arrays of MATLAB's shape and type, complex ones included; a struct is a dict of its fields. Other values
    (text, cells, arrays of structs, sparse matrices …) are None, and such variables left out. Raises if it is no such
    file, truncated or garbled, or expands to far more than measured data do.
    """
    path = Path(path)
    with open_file(path) as file:
        size = path.stat().st_size
        decoder = _Decoder(path, _byte_order(path, file.read(128)), _EXPANSION * size + _FREE_BYTES)
        if not decoder.order:
            with opened_hdf5(path) as hdf5:
                return decoder.members(hdf5, "", 0)
        variables: dict[str, Any] = {}
        while len(tag := file.read(8)) == 8:
            kind, length = np.frombuffer(tag, decoder.order + "u4").tolist()
            if length > size - file.tell():
                decoder.refuse(f"an element of {length} bytes where {size - file.tell()} are left")
            data = memoryview(file.read(length))
            if kind == _COMPRESSED:
                kind, data = decoder.decompress(data)
            if kind != _MATRIX:
                decoder.refuse(f"an element of type {kind} among its variables")
            name, value = decoder.array(data, 0)
            if not name.isidentifier():
                continue  # no counterpart, or MATLAB's own notes on objects
            if name in variables:
                decoder.refuse(f"the variable {name!r} twice")
            variables[name] = value
        if tag:
            decoder.refuse(f"{len(tag)} bytes after its last variable")
    return variables


def _byte_order(path: Path, header: bytes) -> str:
    """Return the byte order by the 128 bytes of the header; "" of version 7.3."""
    if header.startswith((b"MATLAB 7.3", b"\x89HDF")):
        return ""
    order = {b"IM": "<", b"MI": ">"}.get(header[126:128])
    if order is None:
        raise SarsplatError(f"{path} is not a MATLAB file; save it in MATLAB with -v7")
    return order


class _Decoder:
    """Decoder of values from a file's bytes, up to a limit on their total size."""

    def __init__(self, path: Path, order: str, allowance: int) -> None:
        self.path = path
        self.order = order
        self.allowance = allowance

    def refuse(self, what: str) -> NoReturn:
        raise SarsplatError(f"{self.path} is damaged: it holds {what}; download or save it again")

    def spend(self, amount: int) -> None:
        self.allowance -= amount
        if self.allowance < 0:
            raise SarsplatError(
                f"{self.path} expands to more than {_EXPANSION} times its size, as no measured data do; "
                "save it in MATLAB with -v6"
            )

    def members(self, file: h5py.File, within: str, depth: int) -> dict[str, Any]:
        """Read the variables of version 7.3, or the fields of the struct `within/`; HDF5 has their axes reversed."""
        self.deepen(depth)
        found: dict[str, Any] = {}
        for name in filter(str.isidentifier, file[within or "/"]):
            path = within + name
            if file.get(path, getclass=True, getlink=False).__name__ == "Group":
                found[name] = self.members(file, f"{path}/", depth + 1)
                continue
            stored = hdf5_array(self.path, file, path)
            numbers = stored.dtype.kind in "iuf" or stored.dtype.names == ("real", "imag")
            text = stored.attrs.get("MATLAB_class") in (b"char", b"cell")
            self.spend(_BYTES_PER_ARRAY + 2 * stored.size * stored.dtype.itemsize)
            empty = "MATLAB_empty" in stored.attrs
            if numbers and not text:
                found[name] = np.zeros((0, 0)) if empty else complex_of(stored[()]).T
            elif depth:
                found[name] = None
        return found

    def decompress(self, data: memoryview) -> tuple[int, memoryview]:
        """Return type and data of the element in a compressed one."""
        stream = zlib.decompressobj()
        try:
            start = stream.decompress(data, 8)
            if len(start) < 8:
                self.refuse("a compressed element with nothing in it")
            kind, length = np.frombuffer(start, self.order + "u4").tolist()
            self.spend(length)
            rest = stream.decompress(stream.unconsumed_tail, length) if length else b""
        except zlib.error as error:
            self.refuse(f"a compressed element that cannot be read ({shown(str(error))})")
        if len(rest) < length:
            self.refuse(f"a compressed element of {len(rest)} bytes where {length} are stated")
        return kind, memoryview(rest)

    def deepen(self, depth: int) -> None:
        self.spend(_BYTES_PER_ARRAY)
        if depth > _DEEPEST:
            self.refuse(f"structs nested more than {_DEEPEST} deep")

    def element(self, data: memoryview) -> tuple[int, memoryview, memoryview]:
        """Return type and data of the first element, and the rest."""
        if len(data) < 8:
            self.refuse(f"{len(data)} bytes where an element should begin")
        kind, length = np.frombuffer(data[:8], self.order + "u4").tolist()
        if kind > 0xFFFF:  # up to 4 bytes are packed into the tag
            kind, length, start, end = kind & 0xFFFF, kind >> 16, 4, 8
        else:
            start, end = 8, 8 + length + -length % 8
        if length > len(data) - start or (start == 4 and length > 4):
            self.refuse(f"an element of {length} bytes where {len(data) - start} are left")
        return kind, data[start : start + length], data[end:]

    def array(self, data: memoryview, depth: int) -> tuple[str, Any]:
        """Return name and value of an array."""
        self.deepen(depth)
        if not data:
            return "", np.zeros((0, 0))
        flags, data = self.whole(data, _UINT32)
        kind = flags[0] & 0xFF if len(flags) == 2 else 0
        if kind not in (_STRUCT, *_CLASSES):
            return "", None
        shape, data = self.whole(data, _INT32)
        if not 2 <= len(shape) <= 32 or min(shape) < 0:
            self.refuse(f"an array of the shape {shown(shape)}")
        name, data = self.name(data)
        if kind == _STRUCT:
            return (name, self.struct(data, depth)) if math.prod(shape) == 1 else ("", None)
        values, data = self.numbers(data, shape, np.dtype(_CLASSES[kind]))
        if not flags[0] & _COMPLEX:
            return name, values
        imaginary, _ = self.numbers(data, shape, values.dtype)
        self.spend(2 * values.nbytes)
        joined = np.empty_like(values, np.complex64 if values.dtype == np.float32 else np.complex128)
        joined.real, joined.imag = values, imaginary
        return name, joined

    def whole(self, data: memoryview, wanted: int) -> tuple[list[int], memoryview]:
        """Return an element of whole numbers, and the rest."""
        kind, values, rest = self.element(data)
        if kind != wanted or len(values) % 4 or len(values) > 4 * 32:
            self.refuse(f"{len(values)} bytes of type {kind} where an array's flags or dimensions should be")
        return np.frombuffer(values, self.order + _NUMBERS[kind]).tolist(), rest

    def name(self, data: memoryview) -> tuple[str, memoryview]:
        kind, letters, rest = self.element(data)
        if kind != _INT8 or not bytes(letters).isascii():
            self.refuse(f"{shown(bytes(letters[:40]))} where a name should be")
        return bytes(letters).decode(), rest

    def numbers(self, data: memoryview, shape: list[int], wanted: np.dtype) -> tuple[np.ndarray, memoryview]:
        kind, values, rest = self.element(data)
        stored = np.dtype(self.order + _NUMBERS.get(kind, "V1"))
        if stored.kind == "V" or (stored.kind == "f" and wanted.kind != "f"):
            self.refuse(f"values of type {kind} in an array of {wanted.name}")
        if len(values) != math.prod(shape) * stored.itemsize:
            self.refuse(f"{len(values)} bytes of {stored.name} in an array of the shape {shown(shape)}")
        self.spend(math.prod(shape) * wanted.itemsize)
        if not values:  # numpy minds empty arrays that are long in another dimension
            return np.zeros((0, 0), wanted), rest
        with np.errstate(over="ignore"):
            return np.frombuffer(values, stored).reshape(shape, order="F").astype(wanted), rest

    def struct(self, data: memoryview, depth: int) -> dict[str, Any]:
        """Read the fields of one struct: names padded to one length with zeros, and then their values."""
        lengths, data = self.whole(data, _INT32)
        _, letters, data = self.element(data)
        longest = lengths[0] if len(lengths) == 1 else 0
        if longest < 1 or len(letters) % longest or not bytes(letters).isascii():
            self.refuse("names of fields that cannot be read")
        self.spend(len(letters) // longest * _BYTES_PER_ARRAY)
        fields: dict[str, Any] = {}
        for k in range(0, len(letters), longest):
            name = bytes(letters[k : k + longest]).partition(b"\0")[0].decode()
            if name in fields:
                self.refuse("two fields of one name")
            _, value, data = self.element(data)
            fields[name] = self.array(value, depth + 1)[1]
        return fields
