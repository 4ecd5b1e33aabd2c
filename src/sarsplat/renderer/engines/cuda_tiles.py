"""Lattices of the views' rays and pixels for the CUDA kernels, and the lists of Gaussians of their tiles."""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Sequence
from ctypes import c_int32, c_int64

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.abi import SOURCES, api, structures
from sarsplat.renderer.engines.bounds import TILE, Capacity
from sarsplat.renderer.engines.cpu import FAULTS
from sarsplat.renderer.engines.cuda_device import THREADS, Arrays, Device

_structures = structures((SOURCES / "cuda_state.cuh").read_text(encoding="utf-8"), ("Lattice", "Plane", "State"))
ViewLattice, State = _structures["Lattice"], _structures["State"]
"""Structures of the rays or pixels of one view, and of a pass's state on the device."""

_SPLAT_FLOATS, _CHUNK = 8, 128  # as in csrc/cuda_state.cuh
_MAX_SIDE, _MAX_RAYS = 131_068, 1 << 28  # maximum side and number of rays of a view's lattice, as on the CPU engine

_MAX_PAIRS = 1 << 31

_MAX_RANKED = 1 << 16  # maximum length of a tile's list that is ordered by counting predecessors, in quadratic time
_UNLIMITED = (1 << 63) - 1  # sentinel: largest sort key, and no limit of a count


class TileLists(Arrays):
    """Lattices of a pass, and the Gaussians of each of their tiles, in order of depth on rays.

    With a capacity nothing is read back from the device.
    """

    def __init__(self, launcher: Device, capacity: Capacity | None = None) -> None:
        super().__init__(launcher)
        self._capacity = capacity
        self._state = State()
        self._pairs = 0
        self._chunks: dict[str, int] = {}
        self._lattices: list[tuple[int, int, int, int]] = []
        self._rays: list[ctypes.Structure] = []

    def lattices(self, views: int) -> list[ctypes.Structure]:
        return [api.lattice(*lattice) for lattice in self._lattices]

    def ray_count(self, views: int) -> int:
        return total(self._rays)[0]

    def _begin(self, problem: ctypes.Structure, *planes: str) -> Tensor:
        """Make the footprints of planes; return the minima of faults and of the footprints' bounds, initialised."""
        views, n = problem.views, problem.gaussians
        self._pairs = views * n
        if self._pairs >= _MAX_PAIRS:
            raise SarsplatError(f"{views} views of {n} Gaussians are too many at once; render fewer views at a time")
        for name in planes:
            plane = getattr(self._state, name)
            plane.splats = self.new(f"{name} splats", self._pairs, _SPLAT_FLOATS).data_ptr()
            plane.reach = self.new(f"{name} reach", self._pairs, 2).data_ptr()
        minima = self.new("minima", 2 + 4 * views, dtype=torch.int64).fill_(-1)
        self._state.minima = minima.data_ptr()
        return minima

    def _place_lattices(self, minima: Tensor) -> tuple[str, int] | None:
        """Place the rays' lattices around all footprints; return the rejected input, if any."""
        if self._capacity is not None:
            self._lattices = list(self._capacity.lattices)
        else:
            fault, *bounds, _ = minima.tolist()
            if fault >= 0:
                return fault_of(fault)
            self._lattices = [smallest_lattice(bounds[k : k + 4]) for k in range(0, len(bounds), 4)]
            for v, (_, _, rows, columns) in enumerate(self._lattices):
                if max(rows, columns) > _MAX_SIDE or rows * columns > _MAX_RAYS:
                    return "lattice", v
        if self._capacity is None or self._capacity.chosen is None:
            self._rays = cut_into_tiles(self._lattices, 0.5)
        else:
            rows, columns = (max(lattice[k] for lattice in self._lattices) for k in (2, 3))
            self._rays = cut_into_tiles([(0, 0, rows, columns)] * len(self._capacity.chosen), 0.5)
        return None

    def _pixels(self, problem: ctypes.Structure) -> list[ctypes.Structure]:
        return cut_into_tiles([(0, 0, problem.rows, problem.columns)] * problem.views, 0.0)

    def _arrange(self, problem: ctypes.Structure, planes: dict[str, list[ctypes.Structure]]) -> None:
        """List the Gaussians of every tile of the planes, on rays front to back."""
        for name, tiles in planes.items():
            self._count(name, getattr(self._state, name), tiles, problem)
        if self._capacity is not None:
            numbers = [[self._pairs * self._capacity.tiles[name], problem.gaussians] for name in planes]
        else:
            counted = ((self.arrays[f"{name} counts"], self.arrays[f"{name} in tile"]) for name in planes)
            sizes = torch.stack([n for count, listed in counted for n in (count.sum(), listed.max().long())])
            numbers = sizes.view(-1, 2).tolist()  # synchronises with the GPU
        for name, (slots, longest) in zip(planes, numbers, strict=True):
            plane = getattr(self._state, name)
            self._list(name, plane, slots, problem, by_depth=name == "rays", ranked=longest <= _MAX_RANKED)

    def _count(
        self, name: str, plane: ctypes.Structure, lattices: Sequence[ctypes.Structure], problem: ctypes.Structure
    ) -> None:
        """Count the tiles of every Gaussian, and the Gaussians of every tile."""
        if name == "rays" and self._capacity is not None and self._capacity.chosen is not None:
            on_device = self._chosen_lattices(lattices, self._capacity.chosen)
        else:
            on_device = self.sent(b"".join(lattices))
        plane.lattices = self.keep(f"{name} lattices", on_device).data_ptr()
        counts = self.new(f"{name} counts", problem.views * problem.gaussians, dtype=torch.int64)
        plane.counts, plane.tiles = counts.data_ptr(), total(lattices)[1]
        in_tile = self.new(f"{name} in tile", plane.tiles + 1, dtype=torch.int32).zero_()
        plane.in_tile = in_tile.data_ptr()
        limit = _UNLIMITED if self._capacity is None else self._capacity.tiles[name]
        self._over_pairs("count_tiles", problem, self._state, plane, c_int64(limit))
        plane.starts = self.keep(f"{name} starts", torch.cumsum(in_tile, 0)).data_ptr()
        ends = self.keep(f"{name} ends", torch.cumsum(counts, 0))
        plane.ends = ends.data_ptr()

    def _chosen_lattices(self, places: Sequence[ctypes.Structure], chosen: Tensor) -> Tensor:
        """Return the chosen views' lattices, each with room for the largest; they begin as `places` do."""
        alone = [cut_into_tiles([lattice], 0.5)[0] for lattice in self._lattices]
        return _words(self.sent(b"".join(alone))).index_select(0, chosen).add_(_words(self.sent(begins(places))))

    def _list(
        self, name: str, plane: ctypes.Structure, slots: int, problem: ctypes.Structure, *, by_depth: bool, ranked: bool
    ) -> None:
        """List the Gaussians of every tile in `slots`; ordered by counting predecessors if `ranked`, else sorted."""
        self._chunks[name] = slots // _CHUNK + plane.tiles
        keys = self.new(f"{name} keys", slots, dtype=torch.int64)
        if not ranked:
            keys.fill_(_UNLIMITED)  # unused slots come last
        plane.keys = keys.data_ptr()
        plane.owners = self.new(f"{name} owners", slots, dtype=torch.int32).data_ptr()
        self._over_pairs("list_tiles", problem, plane, c_int32(by_depth), c_int32(ranked))
        if ranked:
            plane.order = self.new(f"{name} order", slots, dtype=torch.int64).data_ptr()
            self.launch("rank_chunks", self._chunks[name], problem, plane)
        else:
            plane.order = self.keep(f"{name} order", torch.sort(keys, stable=True).indices).data_ptr()
        del self.arrays[f"{name} keys"]

    def _over_pairs(self, name: str, problem: ctypes.Structure, *arguments: ctypes._CData) -> None:
        self.launch(name, problem.views * -(-problem.gaussians // THREADS), problem, *arguments)

    def _fill(self, dtype: torch.dtype = torch.float32, **shapes: tuple[int, ...]) -> None:
        """Make arrays of the state, by name."""
        for name, shape in shapes.items():
            setattr(self._state, name, self.new(name, *shape, dtype=dtype).data_ptr())


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


def begins(lattices: Sequence[ctypes.Structure]) -> bytes:
    """Return first tiles and points of lattices, to be added to lattices that were cut separately."""
    return b"".join(ViewLattice(0, 0, 0, 0, 0, one.first_tile, one.first_point) for one in lattices)


def tiles_of(lattice: ctypes.Structure) -> int:
    return lattice.tiles_x * -(-lattice.rows // TILE)


def total(lattices: Sequence[ctypes.Structure]) -> tuple[int, int]:
    """Return the points and tiles of all views."""
    last = lattices[-1]
    return last.first_point + last.rows * last.columns, last.first_tile + tiles_of(last)


def _words(lattices: Tensor) -> Tensor:
    """View lattices as rows of int32."""
    return lattices.view(torch.int32).view(-1, ctypes.sizeof(ViewLattice) // 4)


def fault_of(code: int) -> tuple[str, int]:
    """Decode a kernel's smallest fault code to the rejected input and its index; -1 is no fault."""
    return ("", -1) if code < 0 else (FAULTS[code >> 56], code & (1 << 56) - 1)
