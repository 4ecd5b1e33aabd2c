"""Interface of an engine's passes."""

import ctypes
from collections.abc import Callable, Mapping
from typing import Any, Protocol


class Pass(Protocol):
    """Forward call of a step and the state for its backward call; or stateless operations of one structure.

    Steps are "render", "project", "attenuate" and "splat". Their arguments are structures and addresses of arrays, in
    the order of `sg_engine` in csrc/api.h. Operations are the `SG_OPERATIONS` of that file.
    """

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        """Run a step; return the rejected input ("" for none) and its index."""

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        """Run the adjoint of the last forward call; "project" is stateless: of any problem."""

    def lattices(self, views: int) -> list[ctypes.Structure]:
        """Return the ray lattices of the views; for `ChosenViews`, of all candidates."""

    def ray_count(self, views: int) -> int:
        """Return the number of rays that `trace` fills; `ChosenViews` have room for the largest lattice each."""

    def trace(self, problem: ctypes.Structure, depth: float, transmittance: int, first_return: int | None) -> None:
        """Fill T_end and, unless None, the first-return ranges of the rays of all views, one after the other."""

    def has(self, operation: str, numbers: Mapping[str, Any]) -> bool:
        """Return True if the engine has an operation, for these numbers."""

    def run(self, operation: str, call: ctypes.Structure) -> None:
        """Run an operation, which fills in its outputs."""


NewPass = Callable[..., Pass]
"""Constructor of an engine's passes; the CUDA engine's accepts a `Capacity`."""


_LIMITS: dict[str, dict[str, float]] = {"adam": {"columns": 16}, "stack_likelihood": {"passes": 16}}
"""Maxima of numbers that an operation supports."""


def within_limits(operation: str, numbers: Mapping[str, Any]) -> bool:
    """Return True if the kernels of an operation, on any engine, support its numbers."""
    return all(numbers[name] <= most for name, most in _LIMITS.get(operation, {}).items())
