"""Lattices of the views' rays and pixels for the CUDA kernels, cut into tiles."""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Sequence

from sarsplat.renderer.engines.abi import SOURCES, structures
from sarsplat.renderer.engines.bounds import TILE

_structures = structures((SOURCES / "cuda_state.cuh").read_text(encoding="utf-8"), ("Lattice", "Plane", "State"))
ViewLattice, State = _structures["Lattice"], _structures["State"]
"""Structures of the rays or pixels of one view, and of a pass's state on the device."""


def smallest_lattice(bounds: Sequence[int]) -> tuple[int, int, int, int]:
    """Return (k0x, k0y, rows, columns) of rays that contain all footprints; `bounds`: ordered bits of x, y, −x, −y."""
    if bounds[0] < 0:  # nothing touches a ray
        return 0, 0, 0, 0
    x0, y0, x1, y1 = (math.floor(_unordered(bits)) for bits in bounds)
    return x0, y0, max(1, -y1 - y0), max(1, -x1 - x0)


def _unordered(bits: int) -> float:
    """Return the float whose bits were mapped to an unsigned integer of the same order."""
    bits = bits ^ 0x80000000 if bits & 0x80000000 else ~bits & 0xFFFFFFFF
    return struct.unpack("f", struct.pack("I", bits))[0]


def cut_into_tiles(lattices: Sequence[tuple[int, int, int, int]], offset: float) -> list[ctypes.Structure]:
    """Return the views' lattices for the kernels, with tiles and points numbered consecutively."""
    cut, tile, point = [], 0, 0
    for k0x, k0y, rows, columns in lattices:
        tiles_x = -(-columns // TILE)
        cut.append(ViewLattice(k0x + offset, k0y + offset, rows, columns, tiles_x, tile, point))
        tile += tiles_of(cut[-1])
        point += rows * columns
    return cut


def largest(lattices: Sequence[tuple[int, int, int, int]]) -> tuple[int, int, int, int]:
    """Return a lattice with room for each of these."""
    return 0, 0, max(rows for *_, rows, _ in lattices), max(columns for *_, columns in lattices)


def begins(lattices: Sequence[ctypes.Structure]) -> bytes:
    """Return first tiles and points of lattices, to be added to lattices that were cut separately."""
    return b"".join(ViewLattice(0, 0, 0, 0, 0, one.first_tile, one.first_point) for one in lattices)


def tiles_of(lattice: ctypes.Structure) -> int:
    return lattice.tiles_x * -(-lattice.rows // TILE)


def total(lattices: Sequence[ctypes.Structure]) -> tuple[int, int]:
    """Return the points and tiles of all views."""
    last = lattices[-1]
    return last.first_point + last.rows * last.columns, last.first_tile + tiles_of(last)
