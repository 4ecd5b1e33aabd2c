"""The CUDA engine's plan: which arrays a pass needs, which kernels run over them, and what is sorted in between."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import c_float, c_int32, c_int64, c_void_p
from typing import Any

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.bounds import LEFT_BOUNDS, Capacity
from sarsplat.renderer.engines.cpu import FAULTS
from sarsplat.renderer.engines.cuda_arrays import THREADS, Arrays, Launcher
from sarsplat.renderer.engines.cuda_lattices import (
    State,
    ViewLattice,
    begins,
    cut_into_tiles,
    largest,
    smallest_lattice,
    total,
)
from sarsplat.renderer.engines.cuda_operations import OPERATIONS
from sarsplat.renderer.engines.passes import within

# of csrc/cuda_state.cuh
_WARPS = 8
_SPLAT_FLOATS = 8
_PAIR_FLOATS = 23  # of cuda_project.cuh
_CHUNK = 128
_TOGETHER = 4
"""The most channels to a launch, of csrc/cuda_pixels.cuh."""

_MAX_SIDE, _MAX_RAYS = 131_068, 1 << 28
"""Largest side and most rays of a view's lattice, as on the CPU engine."""

_MAX_PAIRS = 1 << 31

_RANKED = 1 << 16
"""A tile's list of up to so many is put in order by counting who is in front, which goes with its square."""

_NOTHING = (1 << 63) - 1
"""The largest key, and more than there is of anything."""

_BACKWARD = ("h", "returns", "slot_moments", "pixel_moments", "planes", "pair gradients")
"""What of the state only a backward pass needs."""


class Pass(Arrays):
    """One forward pass and what its backward pass needs; the same interface as the CPU engine's.

    With a capacity `forward` waits for nothing and rejects nothing: what goes wrong, `Capacity.broken` says later.
    """

    def __init__(self, launcher: Launcher, capacity: Capacity | None = None) -> None:
        super().__init__(launcher)
        self._capacity = capacity
        self._state = State()
        self._pairs = 0
        self._chunks: dict[str, int] = {}
        self._lattices: list[tuple[int, int, int, int]] = []
        self._rays: list[ctypes.Structure] = []

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index.

        Raises
        ------
        SarsplatError
            If there is not enough memory, here and below.
        """
        with self._memory():
            return getattr(self, f"_{step}")(problem, *arguments)

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        """Run the adjoint of the last forward call."""
        with self._memory():
            getattr(self, f"_{step}_backward")(problem, *arguments)

    def lattices(self, views: int) -> list[ctypes.Structure]:
        """Where the rays of the views stand; if they are chosen on the device, of all that may be."""
        return [api.lattice(*lattice) for lattice in self._lattices]

    def ray_count(self, views: int) -> int:
        """How many rays `trace` has room for."""
        return total(self._rays)[0]

    def trace(self, problem: ctypes.Structure, depth: float, transmittance: int, first_return: int | None) -> None:
        """Fill T_end and, unless None, the first-return ranges of the rays of all views, one after the other."""
        arrays = c_void_p(transmittance), c_void_p(first_return)
        self.launch("trace_tiles", total(self._rays)[1], problem, self._state, c_float(depth), *arrays)

    def has(self, operation: str, numbers: Mapping[str, Any]) -> bool:
        """Whether it does an operation of one structure, given the numbers in that."""
        return operation in OPERATIONS and within(OPERATIONS[operation].limits, numbers)

    def run(self, operation: str, call: ctypes.Structure) -> None:
        """Fill in what such an operation gives."""
        OPERATIONS[operation].run(self, call)

    # ---- a whole rendering
    def _render(self, problem: ctypes.Structure, outputs: ctypes.Structure) -> tuple[str, int]:
        bounds = self._begin(problem)
        self._new_planes("rays", "pixels")
        self._fill(slope=(self._pairs, 2), lit_area=(self._pairs,))
        if problem.coefficients:
            self.new("gamma0", self._pairs)
        channels = self._channels(problem)
        self._over_pairs("project_gaussians", problem, problem, self._state, self._gamma0("gamma0"))
        if (fault := self._place_lattices(bounds)) is not None:
            return fault
        pixels = self._pixels(problem)
        self._arrange(problem, {"rays": self._rays, "pixels": pixels})
        if self._capacity is not None:
            broken = c_void_p(self._capacity.broken.data_ptr())
            self.launch("keep_fault", 1, problem, self._state, c_int64(LEFT_BOUNDS), broken)
        self._attenuate_tiles(problem, channels, outputs)
        self._splat_tiles(problem, channels, pixels, outputs.images)
        return "", -1

    def _render_backward(self, problem: ctypes.Structure, gradients: ctypes.Structure) -> None:
        channels = self._channels(problem)
        through_images = self.new("d_cross_sections", self._pairs, channels.count).data_ptr()
        if problem.coefficients:
            d_amplitudes = self.new("gamma0 gradient", self._pairs).data_ptr()
        else:
            d_amplitudes = gradients.amplitudes
        self._splat_tiles_backward(problem, channels, gradients.images, through_images)
        seeds = (c_void_p(p) for p in (gradients.lit_area, through_images, gradients.cross_sections, d_amplitudes))
        self._attenuate_tiles_backward(problem, channels, gradients.transmittance, *seeds)
        self._project_backward(problem, self._gamma0("gamma0 gradient"), gradients)

    # ---- one step alone
    def _project(self, problem: ctypes.Structure, out: ctypes.Structure) -> tuple[str, int]:
        faults = self._begin(problem)
        self._over_pairs("project_gaussians", problem, problem, self._state, out)
        return _fault(faults.tolist()[0])

    def _project_backward(
        self, problem: ctypes.Structure, seeds: ctypes.Structure, gradients: ctypes.Structure
    ) -> None:
        pairs = problem.views * problem.gaussians
        self._state.planes = gradients.planes or self.new("planes", pairs, 4).data_ptr()
        shares = c_void_p(self.new("pair gradients", pairs, _PAIR_FLOATS).data_ptr())
        self._over_pairs("project_pairs_backward", problem, problem, self._state, seeds, shares)
        self.launch("project_gaussians_backward", -(-problem.gaussians // THREADS), problem, shares, gradients)
        if gradients.shift:
            self.launch("sum_shift", problem.views, problem, self._state, c_void_p(gradients.shift))

    def _attenuate(self, problem: ctypes.Structure, footprints: ctypes.Structure, lit_area: int) -> tuple[str, int]:
        bounds = self._begin(problem)
        self._new_planes("rays")
        self._fill(slope=(self._pairs, 2))
        self._over_pairs("place_footprints", problem, problem, self._state, footprints, api.channels())
        if (fault := self._place_lattices(bounds)) is not None:
            return fault
        self._arrange(problem, {"rays": self._rays})
        self._attenuate_tiles(problem, api.channels(), api.outputs(lit_area=lit_area))
        return "", -1

    def _attenuate_backward(
        self,
        problem: ctypes.Structure,
        d_lit_area: int | None,
        d_transmittance: int | None,
        gradients: ctypes.Structure,
    ) -> None:
        seeds = (c_void_p(p) for p in (d_lit_area, None, None, None))
        self._attenuate_tiles_backward(problem, api.channels(), d_transmittance, *seeds)
        self._over_pairs("write_footprint_gradients", problem, problem, self._state, gradients)

    def _splat(
        self, problem: ctypes.Structure, footprints: ctypes.Structure, channels: ctypes.Structure, images: int
    ) -> tuple[str, int]:
        faults = self._begin(problem)
        self._new_planes("pixels")
        self._over_pairs("place_footprints", problem, problem, self._state, footprints, channels)
        if (status := faults.tolist()[0]) >= 0:
            return _fault(status)
        pixels = self._pixels(problem)
        self._arrange(problem, {"pixels": pixels})
        self._splat_tiles(problem, channels, pixels, images)
        return "", -1

    def _splat_backward(
        self,
        problem: ctypes.Structure,
        channels: ctypes.Structure,
        d_images: int,
        gradients: ctypes.Structure,
        d_cross_sections: int,
        d_elevation: int | None,
    ) -> None:
        self._splat_tiles_backward(problem, channels, d_images, d_cross_sections, d_elevation)
        self._over_pairs("write_footprint_gradients", problem, problem, self._state, gradients)

    # ---- what they are made of
    def _begin(self, problem: ctypes.Structure) -> Tensor:
        """The first fault, and the bounds of the footprints on rays: none yet."""
        views, n = problem.views, problem.gaussians
        self._pairs = views * n
        if self._pairs >= _MAX_PAIRS:
            raise SarsplatError(f"{views} views of {n} Gaussians are too many at once; render fewer views at a time")
        minima = self.new("minima", 2 + 4 * views, dtype=torch.int64).fill_(-1)
        self._state.minima = minima.data_ptr()
        return minima

    @contextmanager
    def _memory(self) -> Iterator[None]:
        """Say in a sentence that there is not enough; afterwards, forget what only a backward pass needs."""
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise SarsplatError(
                f"the memory of {self.launcher.device} is not enough for the rendering; render fewer views at a time "
                "or use coarser rays"
            ) from error
        for name in ("gamma0 gradient", "d_cross_sections", *_BACKWARD):
            self.arrays.pop(name, None)

    def _new_planes(self, *names: str) -> None:
        for name in names:
            plane = getattr(self._state, name)
            plane.splats = self.new(f"{name} splats", self._pairs, _SPLAT_FLOATS).data_ptr()
            plane.reach = self.new(f"{name} reach", self._pairs, 2).data_ptr()

    def _gamma0(self, name: str) -> ctypes.Structure:
        """What the kernels of a whole rendering read and write of a projection; the rest is never written out."""
        array = self.arrays.get(name)
        return api.projection(gamma0=None if array is None else array.data_ptr())

    def _channels(self, problem: ctypes.Structure) -> ctypes.Structure:
        """What is multiplied by lit areas in a whole rendering."""
        return api.channels(problem.channels, problem.amplitudes or self.arrays["gamma0"].data_ptr())

    def _place_lattices(self, minima: Tensor) -> tuple[str, int] | None:
        """Rays that hold all footprints; or what was rejected."""
        if self._capacity is not None:
            self._lattices = list(self._capacity.lattices)
        else:
            fault, *bounds, _ = minima.tolist()
            if fault >= 0:
                return _fault(fault)
            self._lattices = [smallest_lattice(bounds[k : k + 4]) for k in range(0, len(bounds), 4)]
            for v, (_, _, rows, columns) in enumerate(self._lattices):
                if max(rows, columns) > _MAX_SIDE or rows * columns > _MAX_RAYS:
                    return "lattice", v
        if self._capacity is None or self._capacity.chosen is None:
            self._rays = cut_into_tiles(self._lattices, 0.5)
        else:
            self._rays = cut_into_tiles([largest(self._lattices)] * len(self._capacity.chosen), 0.5)
        return None

    def _pixels(self, problem: ctypes.Structure) -> list[ctypes.Structure]:
        return cut_into_tiles([(0, 0, problem.rows, problem.columns)] * problem.views, 0.0)

    def _arrange(self, problem: ctypes.Structure, planes: dict[str, list[ctypes.Structure]]) -> None:
        """List the Gaussians of every tile of these planes: on rays front to back."""
        for name, tiles in planes.items():
            self._count(name, getattr(self._state, name), tiles, problem)
        if self._capacity is not None:
            numbers = [[self._pairs * self._capacity.tiles[name], problem.gaussians] for name in planes]
        else:
            counted = ((self.arrays[f"{name} counts"], self.arrays[f"{name} in tile"]) for name in planes)
            found = torch.stack([n for count, listed in counted for n in (count.sum(), listed.max().long())])
            numbers = found.view(-1, 2).tolist()  # here the CPU waits for the GPU
        for name, (slots, longest) in zip(planes, numbers, strict=True):
            plane = getattr(self._state, name)
            self._list(name, plane, slots, problem, by_depth=name == "rays", ranked=longest <= _RANKED)

    def _attenuate_tiles(
        self, problem: ctypes.Structure, channels: ctypes.Structure, outputs: ctypes.Structure
    ) -> None:
        """Once the rays are arranged."""
        rays, _ = total(self._rays)
        self._fill(transmittance=(rays,))
        self._fill(torch.int32, last=(rays,))
        self._fill(slot_weights=(len(self.arrays["rays owners"]),))
        self._state.rays.sums = self.new("rays sums", self._chunks["rays"], THREADS).data_ptr()
        for kernel in ("sum_depths", "attenuate_chunks"):
            self.launch(kernel, self._chunks["rays"], problem, self._state)
        self._over_pairs("light_gaussians", problem, problem, self._state, channels, outputs)

    def _splat_tiles(
        self, problem: ctypes.Structure, channels: ctypes.Structure, pixels: list[ctypes.Structure], images: int
    ) -> None:
        """Once the pixels are arranged."""
        chunks, tiles = self._chunks["pixels"], total(pixels)[1]
        most = 1 if channels.count == 1 else _TOGETHER
        self._state.pixels.sums = self.new("pixels sums", chunks, most, THREADS).data_ptr()
        for first, kernel, together in _in_groups(channels):
            group = channels, c_int32(first)
            self.launch(kernel, chunks, problem, self._state, *group)
            self.launch("sum_chunks", tiles, problem, self._state, *group, c_int32(together), c_void_p(images))
        del self.arrays["pixels sums"]

    def _splat_tiles_backward(
        self,
        problem: ctypes.Structure,
        channels: ctypes.Structure,
        d_images: int,
        d_cross_sections: int,
        d_elevation: int | None = None,
    ) -> None:
        self._fill(pixel_moments=(self._pairs, 6))
        for first, kernel, _ in _in_groups(channels):
            arguments = channels, c_int32(first), *map(c_void_p, (d_images, d_cross_sections, d_elevation))
            blocks = -(-self._pairs // _WARPS)
            self.launch(f"{kernel}_backward", blocks, problem, self._state, *arguments)

    def _attenuate_tiles_backward(
        self, problem: ctypes.Structure, channels: ctypes.Structure, d_transmittance: int | None, *seeds: c_void_p
    ) -> None:
        self._fill(h=(self._pairs,), slot_moments=(len(self.arrays["slot_weights"]), 6))
        self._over_pairs("light_gaussians_backward", problem, problem, self._state, channels, *seeds)
        self._state.rays.returns = self.new("returns", self._chunks["rays"], THREADS).data_ptr()
        self.launch("sum_returns", self._chunks["rays"], problem, self._state)
        arguments = self._state, c_void_p(d_transmittance)
        self.launch("attenuate_chunks_backward", self._chunks["rays"], problem, *arguments)

    def _count(
        self, name: str, plane: ctypes.Structure, lattices: Sequence[ctypes.Structure], problem: ctypes.Structure
    ) -> None:
        """Count the tiles of every Gaussian, and the Gaussians of every tile."""
        if name == "rays" and self._capacity is not None and self._capacity.chosen is not None:
            there = self._chosen_lattices(lattices, self._capacity.chosen)
        else:
            there = self.sent(b"".join(lattices))
        plane.lattices = self.keep(f"{name} lattices", there).data_ptr()
        counts = self.new(f"{name} counts", problem.views * problem.gaussians, dtype=torch.int64)
        plane.counts, plane.tiles = counts.data_ptr(), total(lattices)[1]
        in_tile = self.new(f"{name} in tile", plane.tiles + 1, dtype=torch.int32).zero_()
        plane.in_tile = in_tile.data_ptr()
        most = _NOTHING if self._capacity is None else self._capacity.tiles[name]
        self._over_pairs("count_tiles", problem, problem, self._state, plane, c_int64(most))
        plane.starts = self.keep(f"{name} starts", torch.cumsum(in_tile, 0)).data_ptr()
        ends = self.keep(f"{name} ends", torch.cumsum(counts, 0))
        plane.ends = ends.data_ptr()

    def _chosen_lattices(self, places: Sequence[ctypes.Structure], chosen: Tensor) -> Tensor:
        """The chosen views' lattices, each with room for the largest; `places` says where those begin."""
        alone = [cut_into_tiles([lattice], 0.5)[0] for lattice in self._lattices]
        return _words(self.sent(b"".join(alone))).index_select(0, chosen).add_(_words(self.sent(begins(places))))

    def _list(
        self, name: str, plane: ctypes.Structure, slots: int, problem: ctypes.Structure, *, by_depth: bool, ranked: bool
    ) -> None:
        """List the Gaussians of every tile."""
        self._chunks[name] = slots // _CHUNK + plane.tiles
        keys = self.new(f"{name} keys", slots, dtype=torch.int64)
        if not ranked:
            keys.fill_(_NOTHING)  # what is not used comes last
        plane.keys = keys.data_ptr()
        plane.owners = self.new(f"{name} owners", slots, dtype=torch.int32).data_ptr()
        self._over_pairs("list_tiles", problem, problem, plane, c_int32(by_depth), c_int32(ranked))
        if ranked:
            plane.order = self.new(f"{name} order", slots, dtype=torch.int64).data_ptr()
            self.launch("rank_chunks", self._chunks[name], problem, plane)
        else:
            plane.order = self.keep(f"{name} order", torch.sort(keys, stable=True).indices).data_ptr()
        del self.arrays[f"{name} keys"]

    def _over_pairs(self, name: str, problem: ctypes.Structure, *arguments: ctypes._CData) -> None:
        self.launch(name, problem.views * -(-problem.gaussians // THREADS), *arguments)

    def _fill(self, dtype: torch.dtype = torch.float32, **shapes: tuple[int, ...]) -> None:
        """New arrays of the state, by name."""
        for name, shape in shapes.items():
            setattr(self._state, name, self.new(name, *shape, dtype=dtype).data_ptr())


def _words(lattices: Tensor) -> Tensor:
    """A row of int32 for each lattice."""
    return lattices.view(torch.int32).view(-1, ctypes.sizeof(ViewLattice) // 4)


def _in_groups(channels: ctypes.Structure) -> Iterator[tuple[int, str, int]]:
    """The first channel of every launch, its kernel, and how many channels that does."""
    kind = "waves" if channels.wavenumbers else "chunks"
    for first in range(0, channels.count, _TOGETHER):
        together = 1 if channels.count - first == 1 else _TOGETHER
        yield first, f"splat_{kind}_{together}", together


def _fault(code: int) -> tuple[str, int]:
    """What was rejected, and at which index, from the smallest number that a kernel reported; -1 for nothing."""
    return ("", -1) if code < 0 else (FAULTS[code >> 56], code & (1 << 56) - 1)
