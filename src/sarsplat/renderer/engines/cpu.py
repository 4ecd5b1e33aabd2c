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
from sarsplat.renderer.engines.structs import (
    AdamStep,
    Channels,
    Gradients,
    Ground,
    Lattice,
    Likelihood,
    Lobes,
    Loss,
    Outputs,
    Problem,
    Projection,
    Sections,
    Statistics,
    Terrain,
    check_layouts,
)

LIBRARY = Path(__file__).parents[1] / ("_engine.dll" if sys.platform == "win32" else "_engine.so")
"""The compiled engine."""

_TORCH = {"win32": "torch_cpu.dll", "darwin": "libtorch_cpu.dylib"}.get(sys.platform, "libtorch_cpu.so")

_INPUTS = ("means", "quaternions", "scales", "optical_depth", "scattering", "amplitudes", "shift")
_FOOTPRINTS = ("centers", "roots", "optical_depth", "range_m", "tilt", "cross_sections", "slopes")
FAULTS = ("", *_INPUTS, "lattice", "memory", *_FOOTPRINTS)
"""What a pass can reject, by status code."""

_PROBLEM = (c_void_p, POINTER(Problem))
_PROJECTION, _CHANNELS, _INDEX = POINTER(Projection), POINTER(Channels), POINTER(c_int64)
_ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "create": (c_int32,),
    "destroy": (c_void_p,),
    "render": (*_PROBLEM, POINTER(Outputs), _INDEX),
    "render_backward": (*_PROBLEM, POINTER(Gradients)),
    "project": (*_PROBLEM, _PROJECTION, _INDEX),
    "project_backward": (*_PROBLEM, _PROJECTION, POINTER(Gradients)),
    "attenuate": (*_PROBLEM, _PROJECTION, c_void_p, _INDEX),
    "attenuate_backward": (*_PROBLEM, c_void_p, c_void_p, _PROJECTION),
    "splat": (*_PROBLEM, _PROJECTION, _CHANNELS, c_void_p, _INDEX),
    "splat_backward": (*_PROBLEM, _CHANNELS, c_void_p, _PROJECTION, c_void_p, c_void_p),
    "get_lattice": (c_void_p, c_int32, POINTER(Lattice)),
    "trace": (*_PROBLEM, c_int32, c_float, c_void_p, c_void_p),
    "get_statistics": (*_PROBLEM, POINTER(Statistics)),
    "amplitude_loss": (c_void_p, POINTER(Loss)),
    "stack_likelihood": (c_void_p, POINTER(Likelihood)),
    "pair_sections": (c_void_p, POINTER(Sections)),
    "pair_sections_backward": (c_void_p, POINTER(Sections)),
    "normal_lobes": (c_void_p, POINTER(Lobes)),
    "normal_lobes_backward": (c_void_p, POINTER(Lobes)),
    "lit_ground": (c_void_p, POINTER(Ground)),
    "lit_terrain": (c_void_p, POINTER(Terrain)),
    "adam": (c_int32, POINTER(AdamStep)),
    "use_torch": (c_void_p,),
    "supported_isa": (),
}
"""Argument types of the engine's functions (csrc/dispatch.cpp), by their names without sg_."""

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
    lib.sg_create.restype, lib.sg_isa_name.restype = c_void_p, ctypes.c_char_p
    for name, arguments in _ARGUMENTS.items():
        if not hasattr(lib, f"sg_{name}"):
            raise SarsplatError(
                f"the compiled CPU engine has no sg_{name}, which this version of sarsplat calls; reinstall with "
                "`pip install .`"
            )
        getattr(lib, f"sg_{name}").argtypes = arguments
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


def instruction_sets() -> list[str]:
    """Those that this processor can run and that were compiled, the widest last."""
    lib = library()
    return [INSTRUCTION_SETS[isa] for isa in range(1, lib.sg_supported_isa() + 1) if lib.sg_isa_name(isa)]


def best_instruction_set() -> str:
    """The widest instruction set that this processor, and this build, can run."""
    return INSTRUCTION_SETS[_isa("auto")]


def _isa(instruction_set: str) -> int:
    """What the engine calls an instruction set; of "auto", the widest there is."""
    here = instruction_sets()
    if instruction_set in here or (instruction_set == "auto" and here):
        return INSTRUCTION_SETS.index(here[-1] if instruction_set == "auto" else instruction_set)
    supported = INSTRUCTION_SETS[1 : library().sg_supported_isa() + 1]
    if instruction_set not in ("auto", *supported):
        raise SarsplatError(
            f"instruction_set {instruction_set!r} is not supported by this processor; use 'auto' or at most "
            f"{supported[-1]!r}"
        )
    what = "this processor" if instruction_set == "auto" else f"the instruction set {instruction_set!r}"
    raise SarsplatError(
        f"the CPU engine was not compiled for {what}; `python build_engine.py` compiles it for every instruction set"
    )


def adam(step: ctypes.Structure, instruction_set: str = "auto") -> None:
    """One step of Adam on every group, and its values back into their bounds."""
    library().sg_set_threads(torch.get_num_threads())
    library().sg_adam(_isa(instruction_set), step)


def _require_memory(status: int) -> None:
    if FAULTS[status] == "memory":
        raise SarsplatError(_NO_MEMORY)


class Pass:
    """One forward pass and what its backward pass needs. Memory goes back to a small pool for the next one."""

    _idle: dict[int, list[int]] = {}  # noqa: RUF012 - shared on purpose: handles waiting for reuse, per instruction set
    _keep = 3  # as many as there are steps

    def __init__(self, instruction_set: str = "auto") -> None:
        self._isa = _isa(instruction_set)
        self._library = library()
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

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index.

        Raises
        ------
        SarsplatError
            If there is not enough memory, here and below.
        """
        culprit = c_int64(-1)
        self._library.sg_set_threads(torch.get_num_threads())
        status = getattr(self._library, f"sg_{step}")(self._handle, problem, *arguments, culprit)
        _require_memory(status)
        return FAULTS[status], culprit.value

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        """Run the adjoint of the last forward call."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(getattr(self._library, f"sg_{step}_backward")(self._handle, problem, *arguments))

    def amplitude_loss(self, loss: ctypes.Structure) -> None:
        """Fill in the loss and its gradient."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_amplitude_loss(self._handle, loss))

    def stack_likelihood(self, likelihood: ctypes.Structure) -> None:
        """Fill in the likelihood and its gradients."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_stack_likelihood(self._handle, likelihood))

    def pair_sections(self, sections: ctypes.Structure) -> None:
        """Fill in the cross-sections of pairs, and their slopes."""
        self._library.sg_set_threads(torch.get_num_threads())
        self._library.sg_pair_sections(self._handle, sections)

    def pair_sections_backward(self, sections: ctypes.Structure) -> None:
        """Fill in the gradients."""
        self._library.sg_set_threads(torch.get_num_threads())
        self._library.sg_pair_sections_backward(self._handle, sections)

    def normal_lobes(self, lobes: ctypes.Structure) -> None:
        """Fill in γ⁰ of a law of lobes."""
        self._library.sg_set_threads(torch.get_num_threads())
        self._library.sg_normal_lobes(self._handle, lobes)

    def normal_lobes_backward(self, lobes: ctypes.Structure) -> None:
        """Fill in the gradients."""
        self._library.sg_set_threads(torch.get_num_threads())
        self._library.sg_normal_lobes_backward(self._handle, lobes)

    def lit_ground(self, ground: ctypes.Structure) -> None:
        """Fill in what is lit, or the gradients."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_lit_ground(self._handle, ground))

    def lit_terrain(self, terrain: ctypes.Structure) -> None:
        """Fill in what the terrain returns, or the gradients."""
        self._library.sg_set_threads(torch.get_num_threads())
        _require_memory(self._library.sg_lit_terrain(self._handle, terrain))

    def lattice(self, view: int) -> ctypes.Structure:
        """Where the rays of a view stand."""
        lattice = Lattice()
        self._library.sg_get_lattice(self._handle, view, lattice)
        return lattice

    def trace(
        self, problem: ctypes.Structure, view: int, depth: float, transmittance: int, first_return: int | None
    ) -> None:
        """Fill T_end and, unless None, the first-return range of a view's rays."""
        status = self._library.sg_trace(self._handle, problem, view, depth, transmittance, first_return)
        _require_memory(status)

    def statistics(self, problem: ctypes.Structure) -> ctypes.Structure:
        """Visited blocks and live lanes of the last forward pass."""
        statistics = Statistics()
        self._library.sg_get_statistics(self._handle, problem, statistics)
        return statistics
