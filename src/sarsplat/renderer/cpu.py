"""A thin loader of the CPU engine: ctypes mirrors of `csrc/api.h`, and nothing of Gaussians or views."""

from __future__ import annotations

import ctypes
import sys
from ctypes import POINTER, c_float, c_int32, c_int64, c_void_p
from functools import cache
from pathlib import Path

import torch

from sarsplat.errors import SarsplatError
from sarsplat.renderer.checks import INSTRUCTION_SETS

LIBRARY = Path(__file__).with_name("_engine.dll" if sys.platform == "win32" else "_engine.so")
"""The compiled engine."""

_TORCH = {"win32": "torch_cpu.dll", "darwin": "libtorch_cpu.dylib"}.get(sys.platform, "libtorch_cpu.so")

_INPUTS = ("means", "quaternions", "scales", "optical_depth", "scattering", "gamma0", "shift")
FAULTS = ("", *_INPUTS, "lattice", "memory")
"""What a pass can reject, by status code."""

_NO_MEMORY = "the memory of this machine does not suffice for the rendering; take fewer views at a time or coarser rays"


def _struct(name: str, *fields: tuple[str, type]) -> type[ctypes.Structure]:
    return type(name, (ctypes.Structure,), {"_fields_": list(fields)})


_PAIR = c_float * 2
Problem = _struct(
    "Problem",
    *((name, c_int32) for name in ("peak", "views", "gaussians", "coefficients", "rows", "columns")),
    *((name, c_void_p) for name in ("means", "quaternions", "scales", "kappa", "harmonics", "gamma0")),
    *((name, c_void_p) for name in ("frames", "basis", "shift")),
    ("p_min", c_float),
    *((name, _PAIR) for name in ("pixel", "center", "response_var", "ray")),
    *((name, c_float) for name in ("cell_widening", "min_ray_depth", "min_transmittance", "image_cut")),
    *((name, c_float) for name in ("min_scale", "max_depth")),
)
Outputs = _struct("Outputs", *((name, c_void_p) for name in ("images", "cross_sections", "lit_area")))
Gradients = _struct(
    "Gradients",
    *((name, c_void_p) for name in ("images", "cross_sections", "transmittance")),
    *((name, c_void_p) for name in ("means", "quaternions", "scales", "kappa", "harmonics", "gamma0")),
    *((name, c_void_p) for name in ("shift", "planes")),
)
Lattice = _struct("Lattice", ("k0x", c_int64), ("k0y", c_int64), ("rows", c_int32), ("columns", c_int32))
Statistics = _struct(
    "Statistics",
    *((f"{what}_{plane}", c_int64) for plane in ("attenuation", "imaging") for what in ("blocks", "live")),
    ("lanes", c_int64),
)


Loss = _struct(
    "Loss",
    *((name, c_int32) for name in ("views", "rows", "columns")),
    *((name, c_void_p) for name in ("power", "truth", "window")),
    *((name, c_float) for name in ("reference", "floor", "ssim_weight", "c1", "c2")),
    *((name, c_void_p) for name in ("loss", "gradient")),
)
_COLUMNS = c_float * 16
AdamGroup = _struct(
    "AdamGroup",
    *((name, c_void_p) for name in ("value", "gradient", "mean", "square")),
    ("rows", c_int64),
    ("columns", c_int32),
    ("logarithmic", c_int32),
    ("decay", c_float),
    *((name, _COLUMNS) for name in ("rate", "low", "high")),
)
AdamStep = _struct(
    "AdamStep",
    ("groups", POINTER(AdamGroup)),
    ("count", c_int32),
    *((name, c_float) for name in ("beta1", "beta2", "epsilon", "beta1_power", "beta2_power")),
)


@cache
def library() -> ctypes.CDLL:
    """The compiled engine, its threads borrowed from torch; on one thread where torch does not lend them.

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
    lib.sg_create.restype = c_void_p
    lib.sg_create.argtypes = [c_int32]
    lib.sg_destroy.argtypes = [c_void_p]
    lib.sg_forward.argtypes = [c_void_p, POINTER(Problem), POINTER(Outputs), POINTER(c_int64)]
    lib.sg_backward.argtypes = [c_void_p, POINTER(Problem), POINTER(Gradients)]
    lib.sg_get_lattice.argtypes = [c_void_p, c_int32, POINTER(Lattice)]
    lib.sg_trace.argtypes = [c_void_p, POINTER(Problem), c_int32, c_float, c_void_p, c_void_p]
    lib.sg_get_statistics.argtypes = [c_void_p, POINTER(Problem), POINTER(Statistics)]
    lib.sg_amplitude_loss.argtypes = [c_void_p, POINTER(Loss)]
    lib.sg_adam.argtypes = [c_int32, POINTER(AdamStep)]
    lib.sg_adam.restype = None
    lib.sg_isa_name.restype = ctypes.c_char_p
    lib.sg_use_torch.argtypes = [c_void_p]
    lib.sg_use_torch.restype = None
    lib.sg_use_torch(torch_pool())
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
    _keep = 2

    def __init__(self, instruction_set: str = "auto") -> None:
        self._isa = INSTRUCTION_SETS.index(instruction_set)
        self._library = library()
        if self._isa > self._library.sg_best_isa():
            raise SarsplatError(
                f"instruction_set {instruction_set!r} is more than this processor has; use 'auto' or at most "
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
        culprit = c_int64(-1)
        self._library.sg_set_threads(torch.get_num_threads())
        status = self._library.sg_forward(self._handle, problem, outputs, culprit)
        _require_memory(status)
        return FAULTS[status], culprit.value

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

    def statistics(self, problem: ctypes.Structure) -> ctypes.Structure:
        """Visited blocks and live lanes of the last forward pass."""
        statistics = Statistics()
        self._library.sg_get_statistics(self._handle, problem, statistics)
        return statistics
