"""CUDA engine: the kernels of each step of a rendering, and the arrays between them."""

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from ctypes import c_float, c_int32, c_int64, c_void_p
from typing import Any

import torch

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.bounds import LEFT_BOUNDS
from sarsplat.renderer.engines.cuda_device import THREADS
from sarsplat.renderer.engines.cuda_operations import OPERATIONS
from sarsplat.renderer.engines.cuda_tiles import TileLists, fault_of, total
from sarsplat.renderer.engines.passes import within_limits

_WARPS, _PAIR_FLOATS = 8, 23  # as in csrc/cuda_state.cuh and cuda_project.cuh
_MAX_CHANNELS = 4  # maximum channels of a launch, as in csrc/cuda_pixels.cuh

_BACKWARD = ("h", "returns", "slot_moments", "pixel_moments", "planes", "pair gradients")
"""Arrays that only a backward pass needs."""


class Pass(TileLists):
    """Forward pass and the state for its backward pass (`passes.Pass`).

    With a capacity `forward` neither synchronises nor rejects; faults are reported in `Capacity.broken`.
    """

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        with self._memory():
            return getattr(self, f"_{step}")(problem, *arguments)

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        with self._memory():
            getattr(self, f"_{step}_backward")(problem, *arguments)

    def trace(self, problem: ctypes.Structure, depth: float, transmittance: int, first_return: int | None) -> None:
        arrays = c_void_p(transmittance), c_void_p(first_return)
        self.launch("trace_tiles", total(self._rays)[1], problem, self._state, c_float(depth), *arrays)

    def has(self, operation: str, numbers: Mapping[str, Any]) -> bool:
        return operation in OPERATIONS and within_limits(operation, numbers)

    def run(self, operation: str, call: ctypes.Structure) -> None:
        OPERATIONS[operation](self, call)

    # ---- a whole rendering
    def _render(self, problem: ctypes.Structure, outputs: ctypes.Structure) -> tuple[str, int]:
        bounds = self._begin(problem, "rays", "pixels")
        self._fill(slope=(self._pairs, 2), lit_area=(self._pairs,))
        if problem.coefficients:
            self.new("gamma0", self._pairs)
        channels = self._channels(problem)
        self._over_pairs("project_gaussians", problem, self._state, self._gamma0("gamma0"))
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

    # ---- single steps
    def _project(self, problem: ctypes.Structure, out: ctypes.Structure) -> tuple[str, int]:
        faults = self._begin(problem)
        self._over_pairs("project_gaussians", problem, self._state, out)
        return fault_of(faults.tolist()[0])

    def _project_backward(
        self, problem: ctypes.Structure, seeds: ctypes.Structure, gradients: ctypes.Structure
    ) -> None:
        pairs = problem.views * problem.gaussians
        self._state.planes = gradients.planes or self.new("planes", pairs, 4).data_ptr()
        shares = c_void_p(self.new("pair gradients", pairs, _PAIR_FLOATS).data_ptr())
        self._over_pairs("project_pairs_backward", problem, self._state, seeds, shares)
        self.launch("project_gaussians_backward", -(-problem.gaussians // THREADS), problem, shares, gradients)
        if gradients.shift:
            self.launch("sum_shift", problem.views, problem, self._state, c_void_p(gradients.shift))

    def _attenuate(self, problem: ctypes.Structure, footprints: ctypes.Structure, lit_area: int) -> tuple[str, int]:
        bounds = self._begin(problem, "rays")
        self._fill(slope=(self._pairs, 2))
        self._over_pairs("place_footprints", problem, self._state, footprints, api.channels())
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
        self._over_pairs("write_footprint_gradients", problem, self._state, gradients)

    def _splat(
        self, problem: ctypes.Structure, footprints: ctypes.Structure, channels: ctypes.Structure, images: int
    ) -> tuple[str, int]:
        faults = self._begin(problem, "pixels")
        self._over_pairs("place_footprints", problem, self._state, footprints, channels)
        if (status := faults.tolist()[0]) >= 0:
            return fault_of(status)
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
        self._over_pairs("write_footprint_gradients", problem, self._state, gradients)

    # ---- parts of these
    @contextmanager
    def _memory(self) -> Iterator[None]:
        """Raise if memory is insufficient; afterwards, free arrays that only a backward pass needs."""
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise SarsplatError(
                f"the memory of {self.launcher.device} is not enough for the rendering; render fewer views at a time "
                "or use coarser rays"
            ) from error
        for name in ("gamma0 gradient", "d_cross_sections", *_BACKWARD):
            self.arrays.pop(name, None)

    def _gamma0(self, name: str) -> ctypes.Structure:
        """Make the part of a projection that the kernels of a whole rendering read and write."""
        array = self.arrays.get(name)
        return api.projection(gamma0=None if array is None else array.data_ptr())

    def _channels(self, problem: ctypes.Structure) -> ctypes.Structure:
        """Return the amplitudes of a whole rendering, which lit areas multiply."""
        return api.channels(problem.channels, problem.amplitudes or self.arrays["gamma0"].data_ptr())

    def _attenuate_tiles(
        self, problem: ctypes.Structure, channels: ctypes.Structure, outputs: ctypes.Structure
    ) -> None:
        """Attenuate rays along the lists of tiles."""
        rays, _ = total(self._rays)
        self._fill(transmittance=(rays,))
        self._fill(torch.int32, last=(rays,))
        self._fill(slot_weights=(len(self.arrays["rays owners"]),))
        self._state.rays.sums = self.new("rays sums", self._chunks["rays"], THREADS).data_ptr()
        for kernel in ("sum_depths", "attenuate_chunks"):
            self.launch(kernel, self._chunks["rays"], problem, self._state)
        self._over_pairs("light_gaussians", problem, self._state, channels, outputs)

    def _splat_tiles(
        self, problem: ctypes.Structure, channels: ctypes.Structure, pixels: list[ctypes.Structure], images: int
    ) -> None:
        """Splat to pixels along the lists of tiles."""
        chunks, tiles = self._chunks["pixels"], total(pixels)[1]
        width = 1 if channels.count == 1 else _MAX_CHANNELS
        self._state.pixels.sums = self.new("pixels sums", chunks, width, THREADS).data_ptr()
        for first, kernel, count in _in_groups(channels):
            group = channels, c_int32(first)
            self.launch(kernel, chunks, problem, self._state, *group)
            self.launch("sum_chunks", tiles, problem, self._state, *group, c_int32(count), c_void_p(images))
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
        self._over_pairs("light_gaussians_backward", problem, self._state, channels, *seeds)
        self._state.rays.returns = self.new("returns", self._chunks["rays"], THREADS).data_ptr()
        self.launch("sum_returns", self._chunks["rays"], problem, self._state)
        arguments = self._state, c_void_p(d_transmittance)
        self.launch("attenuate_chunks_backward", self._chunks["rays"], problem, *arguments)


def _in_groups(channels: ctypes.Structure) -> Iterator[tuple[int, str, int]]:
    """Yield the first channel, the kernel and the number of channels of each launch."""
    kind = "waves" if channels.wavenumbers else "chunks"
    for first in range(0, channels.count, _MAX_CHANNELS):
        count = 1 if channels.count - first == 1 else _MAX_CHANNELS
        yield first, f"splat_{kind}_{count}", count
