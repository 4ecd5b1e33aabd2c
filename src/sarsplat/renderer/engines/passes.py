"""What an engine does."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from typing import Any, Protocol


class Pass(Protocol):
    """One call forward, and what the call backward needs; or operations of one structure, which keep nothing.

    The steps are "render", "project", "attenuate" and "splat". A problem and whatever else a step takes are structures
    and addresses of arrays, in the order of `sg_engine` in csrc/api.h. Operations are the `SG_OPERATIONS` of that file.
    """

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index."""
        ...

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        """Run the adjoint of the last forward call; that of "project" keeps nothing: of any problem."""
        ...

    def lattices(self, views: int) -> list[ctypes.Structure]:
        """Where the rays of the views stand; if they are chosen on the device, of all that may be."""
        ...

    def ray_count(self, views: int) -> int:
        """How many rays `trace` fills; if views are chosen on the device, each has room for the largest lattice."""
        ...

    def trace(self, problem: ctypes.Structure, depth: float, transmittance: int, first_return: int | None) -> None:
        """Fill T_end and, unless None, the first-return ranges of the rays of all views, one after the other."""
        ...

    def has(self, operation: str, numbers: Mapping[str, Any]) -> bool:
        """Whether it does an operation of one structure, given the numbers in that."""
        ...

    def run(self, operation: str, call: ctypes.Structure) -> None:
        """Fill in what such an operation gives."""
        ...


NewPass = Callable[..., Pass]
"""Makes passes of one engine; the CUDA engine's may be given a `Capacity`."""


def within(limits: Mapping[str, float], numbers: Mapping[str, Any]) -> bool:
    """Whether numbers keep their limits."""
    return all(numbers[name] <= most for name, most in limits.items())
