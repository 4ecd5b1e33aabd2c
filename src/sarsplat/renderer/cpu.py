"""A thin loader of the CPU engine; it knows arrays, and nothing of Gaussians or views."""

from __future__ import annotations

import ctypes
import sys
import warnings
from ctypes import POINTER, c_float, c_int32, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import torch

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.renderer.checks import INSTRUCTION_SETS
from sarsplat.renderer.structs import (
    AdamStep,
    Channels,
    Gradients,
    Lattice,
    Loss,
    Outputs,
    Problem,
    Projection,
    Statistics,
    check_layouts,
)

LIBRARY = Path(__file__).with_name("_engine.dll" if sys.platform == "win32" else "_engine.so")
"""The compiled engine."""

_TORCH = {"win32": "torch_cpu.dll", "darwin": "libtorch_cpu.dylib"}.get(sys.platform, "libtorch_cpu.so")

_INPUTS = ("means", "quaternions", "scales", "optical_depth", "scattering", "amplitudes", "shift")
_FOOTPRINTS = ("centers", "roots", "optical_depth", "range_m", "tilt", "cross_sections")
FAULTS = ("", *_INPUTS, "lattice", "memory", *_FOOTPRINTS)
"""What a pass can reject, by status code."""

_NO_MEMORY = "there is not enough memory for the rendering; render fewer views at a time or use coarser rays"


@cache
def library() -> ctypes.CDLL:
    """The compiled engine, its threads borrowed from torch; on one, with a warning, where torch does not lend them.

    Raises
    ------
    SarsplatError
        If it was never built, or does not fit this machine.
    """
    try:
        lib = ctypes.CDLL(str(LIBRARY))
    except OSError as error:
        raise SarsplatError(
            f"the CPU engine cannot be loaded ({error}); reinstall with `pip install .`, or use engine='reference'"
        ) from error
    check_layouts(lib)
    lib.sg_create.restype = c_void_p
    lib.sg_create.argtypes = [c_int32]
    lib.sg_destroy.argtypes = [c_void_p]
    lib.sg_forward.argtypes = [c_void_p, POINTER(Problem), POINTER(Outputs), POINTER(c_int64)]
    lib.sg_backward.argtypes = [c_void_p, POINTER(Problem), POINTER(Gradients)]
    lib.sg_get_lattice.argtypes = [c_void_p, c_int32, POINTER(Lattice)]
    lib.sg_trace.argtypes = [c_void_p, POINTER(Problem), c_int32, c_float, c_void_p, c_void_p]
    lib.sg_project.argtypes = [c_void_p, POINTER(Problem), POINTER(Projection), POINTER(c_int64)]
    lib.sg_project_backward.argtypes = [c_void_p, POINTER(Problem), POINTER(Projection), POINTER(Gradients)]
    lib.sg_attenuate.argtypes = [c_void_p, POINTER(Problem), POINTER(Projection), c_void_p, POINTER(c_int64)]
    lib.sg_attenuate_backward.argtypes = [c_void_p, POINTER(Problem), c_void_p, c_void_p, POINTER(Projection)]
    lib.sg_splat.argtypes = [
        *(c_void_p, POINTER(Problem), POINTER(Projection), POINTER(Channels)),
        *(c_void_p, POINTER(c_int64)),
    ]
    lib.sg_splat_backward.argtypes = [
        *(c_void_p, POINTER(Problem), POINTER(Channels)),
        *(c_void_p, POINTER(Projection), c_void_p),
    ]
    lib.sg_get_statistics.argtypes = [c_void_p, POINTER(Problem), POINTER(Statistics)]
    lib.sg_amplitude_loss.argtypes = [c_void_p, POINTER(Loss)]
    lib.sg_adam.argtypes = [c_int32, POINTER(AdamStep)]
    lib.sg_adam.restype = None
    lib.sg_isa_name.restype = ctypes.c_char_p
    lib.sg_use_torch.argtypes = [c_void_p]
    lib.sg_use_torch.restype = None
    pool = torch_pool()
    if pool is None:
        warnings.warn(
            f"the CPU engine runs on one thread, because PyTorch {torch.__version__} has no torch_parallel_for; "
            "install PyTorch from its own wheels to use all of them",
            SarsplatWarning,
            stacklevel=2,
        )
    lib.sg_use_torch(pool)
    return lib


def torch_pool() -> c_void_p | None:
    """The function that runs a loop on torch's threads, or None where this torch has none."""
    try:
        function = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / _TORCH)).torch_parallel_for
    except (OSError, AttributeError):
        return None
    return ctypes.cast(function, c_void_p)


def best_instruction_set() -> str:
    """The widest instruction set that this processor, and this build, can run."""
    return library().sg_isa_name(library().sg_best_isa()).decode()


def adam(step: ctypes.Structure, instruction_set: str = "auto") -> None:
    """One step of Adam on every group, and its values back into their bounds."""
    library().sg_set_threads(torch.get_num_threads())
    library().sg_adam(INSTRUCTION_SETS.index(instruction_set), step)


def _require_memory(status: int) -> None:
    if FAULTS[status] == "memory":
        raise SarsplatError(_NO_MEMORY)


class Pass:
    """One forward pass and what its backward pass needs. Memory goes back to a small pool for the next one."""

    _idle: dict[int, list[int]] = {}  # noqa: RUF012 - shared on purpose: handles waiting for reuse, per instruction set
    _keep = 3  # as many as there are steps

    def __init__(self, instruction_set: str = "auto") -> None:
        self._isa = INSTRUCTION_SETS.index(instruction_set)
        self._library = library()
        if self._isa > self._library.sg_best_isa():
            raise SarsplatError(
                f"instruction_set {instruction_set!r} is not supported by this processor; use 'auto' or at most "
                f"{best_instruction_set()!r}"
            )
        idle = self._idle.setdefault(self._isa, [])
        self._handle = idle.pop() if idle else self._library.sg_create(self._isa)

    def __del__(self) -> None:
        handle = getattr(self, "_handle", None)
        if handle is None:
            return
        idle = self._idle.setdefault(self._isa, [])
        if len(idle) < self._keep:
            idle.append(handle)
        else:
            self._library.sg_destroy(handle)

    def forward(self, problem: ctypes.Structure, outputs: ctypes.Structure) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index.

        Raises
        ------
        SarsplatError
            If there is not enough memory, here and below.
        """
        return self._run(self._library.sg_forward, problem, outputs)

    def backward(self, problem: ctypes.Structure, gradients: ctypes.Structure) -> None:
        """Run the adjoint of the last forward pass."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_backward(self._handle, problem, gradients))

    def amplitude_loss(self, loss: ctypes.Structure) -> None:
        """Fill in the loss and its gradient."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_amplitude_loss(self._handle, loss))

    def lattice(self, view: int) -> ctypes.Structure:
        """Where the rays of a view stand."""
        lattice = Lattice()
        self._library.sg_get_lattice(self._handle, view, lattice)
        return lattice

    def trace(self, problem: ctypes.Structure, view: int, depth: float, transmittance: int, first_return: int) -> None:
        """Fill T_end and the first-return range of a view's rays."""
        status = self._library.sg_trace(self._handle, problem, view, depth, transmittance, first_return)
        _require_memory(status)

    def project(self, problem: ctypes.Structure, out: ctypes.Structure) -> tuple[str, int]:
        """Gaussians to footprints, alone; returns as `forward` does."""
        return self._run(self._library.sg_project, problem, out)

    def project_backward(self, problem: ctypes.Structure, seeds: ctypes.Structure, gradients: ctypes.Structure) -> None:
        """The adjoint of `project`, which keeps nothing: of any problem."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_project_backward(self._handle, problem, seeds, gradients))

    def attenuate(self, problem: ctypes.Structure, footprints: ctypes.Structure, lit_area: int) -> tuple[str, int]:
        """Footprints on rays to lit areas, alone; returns as `forward` does."""
        return self._run(self._library.sg_attenuate, problem, footprints, lit_area)

    def attenuate_backward(
        self,
        problem: ctypes.Structure,
        d_lit_area: int | None,
        d_transmittance: int | None,
        gradients: ctypes.Structure,
    ) -> None:
        """The adjoint of the last `attenuate`."""
        self._library.sg_set_threads(torch.get_num_threads())
        arguments = problem, d_lit_area, d_transmittance, gradients
        _require_memory(self._library.sg_attenuate_backward(self._handle, *arguments))

    def splat(
        self, problem: ctypes.Structure, footprints: ctypes.Structure, channels: ctypes.Structure, images: int
    ) -> tuple[str, int]:
        """Cross-sections to images, alone; returns as `forward` does."""
        return self._run(self._library.sg_splat, problem, footprints, channels, images)

    def splat_backward(
        self,
        problem: ctypes.Structure,
        channels: ctypes.Structure,
        d_images: int,
        gradients: ctypes.Structure,
        d_cross_sections: int,
    ) -> None:
        """The adjoint of the last `splat`."""
        self._library.sg_set_threads(torch.get_num_threads())
        arguments = problem, channels, d_images, gradients, d_cross_sections
        _require_memory(self._library.sg_splat_backward(self._handle, *arguments))

    def _run(self, function: Any, *arguments: object) -> tuple[str, int]:
        """A step forward: its status, and the index of what it rejects."""
        culprit = c_int64(-1)
        self._library.sg_set_threads(torch.get_num_threads())
        status = function(self._handle, *arguments, culprit)
        _require_memory(status)
        return FAULTS[status], culprit.value

    def statistics(self, problem: ctypes.Structure) -> ctypes.Structure:
        """Visited blocks and live lanes of the last forward pass."""
        statistics = Statistics()
        self._library.sg_get_statistics(self._handle, problem, statistics)
        return statistics
