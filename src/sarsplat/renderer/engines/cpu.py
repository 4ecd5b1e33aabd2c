"""Loader of the CPU engine, which works on plain arrays."""

import ctypes
import hashlib
import sys
import warnings
from collections.abc import Mapping
from ctypes import byref, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import torch

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.renderer.engines.abi import HEADER, api
from sarsplat.renderer.engines.passes import within_limits

LIBRARY = Path(__file__).parents[1] / ("_engine.dll" if sys.platform == "win32" else "_engine.so")
"""Compiled engine."""

INSTRUCTION_SETS = ("auto", "base", "avx2", "avx512")
"""Names by the engine's numbers; 0 is the widest of this processor."""

_TORCH = {"win32": "torch_cpu.dll", "darwin": "libtorch_cpu.dylib"}.get(sys.platform, "libtorch_cpu.so")

INPUTS = ("means", "quaternions", "scales", "optical_depth", "scattering", "amplitudes", "shift")
"""Names of the inputs of a rendering, for errors."""

_FOOTPRINTS = ("centers", "roots", "optical_depth", "range_m", "tilt", "cross_sections", "slopes")
FAULTS = ("", *INPUTS, "lattice", "memory", *_FOOTPRINTS)
"""Inputs and other causes that a pass can reject, by status code."""

_NO_MEMORY = "there is not enough memory for the rendering; render fewer views at a time or use coarser rays"


@cache
def library() -> ctypes.CDLL:
    """Load the compiled engine on torch's threads; on a single one, with a warning, if torch does not share them.

    Raise if it is missing, does not fit this machine, or was built from another csrc/api.h.
    """
    try:
        lib = ctypes.CDLL(str(LIBRARY))
    except OSError as error:
        raise SarsplatError(
            f"the CPU engine cannot be loaded ({error}); reinstall with `pip install .`, or use engine='reference'"
        ) from error
    if _compiled_with(lib) != hashlib.sha256(HEADER.read_bytes()).hexdigest():
        raise SarsplatError(
            "the compiled CPU engine has other structures or functions than this version of sarsplat; reinstall with "
            "`pip install .`"
        )
    lib.sg_engine_for.restype, lib.sg_use_torch.argtypes = ctypes.POINTER(api.engine), [c_void_p]
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


def _compiled_with(lib: ctypes.CDLL) -> str:
    """Return the digest of the header that a library was compiled with; "" for old ones."""
    try:
        lib.sg_api.restype = ctypes.c_char_p
    except AttributeError:
        return ""
    return lib.sg_api().decode()


def torch_pool() -> c_void_p | None:
    """Return the function that runs a loop on torch's threads, or None if this torch has none."""
    try:
        function = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / _TORCH)).torch_parallel_for
    except (OSError, AttributeError):
        return None
    return ctypes.cast(function, c_void_p)


def instruction_sets() -> list[str]:
    """Return the compiled instruction sets that this processor supports, the widest last."""
    return _usable(library())


@cache
def _usable(lib: ctypes.CDLL) -> list[str]:
    return [INSTRUCTION_SETS[isa] for isa in range(1, lib.sg_supported_isa() + 1) if lib.sg_engine_for(isa)]


def best_instruction_set() -> str:
    """Return the widest instruction set of this processor and build."""
    return INSTRUCTION_SETS[_isa("auto")]


def _isa(instruction_set: str) -> int:
    """Return the engine's number of an instruction set; of the widest for "auto"."""
    usable = instruction_sets()
    if instruction_set in usable or (instruction_set == "auto" and usable):
        return INSTRUCTION_SETS.index(usable[-1] if instruction_set == "auto" else instruction_set)
    supported = INSTRUCTION_SETS[1 : library().sg_supported_isa() + 1]
    if instruction_set not in ("auto", *supported):
        raise SarsplatError(
            f"engine='cpu-{instruction_set}' needs an instruction set that this processor lacks; use 'cpu' or at most "
            f"'cpu-{supported[-1]}'"
        )
    what = "this processor" if instruction_set == "auto" else f"the instruction set {instruction_set!r}"
    raise SarsplatError(
        f"the CPU engine was not compiled for {what}; `python build_engine.py` compiles it for every instruction set"
    )


@cache
def _functions(instruction_set: int) -> dict[str, Any]:
    """Return the engine's functions by their names in csrc/api.h."""
    table = library().sg_engine_for(instruction_set).contents
    return {name: getattr(table, name) for name, _ in table._fields_}


class Pass:
    """Forward pass and the state for its backward pass (`passes.Pass`); its memory is reused by later passes."""

    _idle: dict[int, list[int]] = {}  # noqa: RUF012 - shared on purpose: memory waiting for reuse, per instruction set
    _keep = 3  # as many as there are steps

    def __init__(self, instruction_set: str = "auto") -> None:
        self._isa = _isa(instruction_set)
        self._library, self._functions = library(), _functions(self._isa)
        idle = self._idle.setdefault(self._isa, [])
        try:
            self._context = idle.pop()  # another thread may take the last one meanwhile
        except IndexError:
            self._context = self._functions["create"]()

    def __del__(self) -> None:
        context = getattr(self, "_context", None)
        if context is None:
            return
        idle = self._idle.setdefault(self._isa, [])
        if len(idle) < self._keep:
            idle.append(context)
        else:
            self._functions["destroy"](context)

    def _call(self, function: str, *arguments: object) -> int:
        """Return the status of a function of csrc/api.h on torch's threads; raise if memory is insufficient."""
        self._library.sg_set_threads(torch.get_num_threads())
        status: int = self._functions[function](self._context, *arguments)
        if FAULTS[status] == "memory":
            raise SarsplatError(_NO_MEMORY)
        return status

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        culprit = c_int64(-1)
        return FAULTS[self._call(step, problem, *arguments, byref(culprit))], culprit.value

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        self._call(f"{step}_backward", problem, *arguments)

    def has(self, operation: str, numbers: Mapping[str, Any]) -> bool:
        return operation in self._functions and within_limits(operation, numbers)

    def run(self, operation: str, call: ctypes.Structure) -> None:
        self._call(operation, call)

    def lattices(self, views: int) -> list[ctypes.Structure]:
        lattices = [api.lattice() for _ in range(views)]
        for view, lattice in enumerate(lattices):
            self._functions["lattice"](self._context, view, lattice)
        return lattices

    def ray_count(self, views: int) -> int:
        return sum(lattice.rows * lattice.columns for lattice in self.lattices(views))

    def trace(self, problem: ctypes.Structure, depth: float, transmittance: int, first_return: int | None) -> None:
        offset = 0
        for view, lattice in enumerate(self.lattices(problem.views)):
            ranges = None if first_return is None else first_return + offset
            self._call("trace", problem, view, depth, transmittance + offset, ranges)
            offset += 4 * lattice.rows * lattice.columns

    def statistics(self, problem: ctypes.Structure) -> ctypes.Structure:
        """Return visited blocks and live lanes of the last forward pass."""
        statistics = api.statistics()
        self._functions["statistics"](self._context, problem, statistics)
        return statistics
