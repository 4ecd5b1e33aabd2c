"""What an engine does."""

from __future__ import annotations

import ctypes
from typing import Protocol


class Pass(Protocol):
    """One call forward, and what the call backward needs.

    The steps are "render", "project", "attenuate" and "splat". A problem and whatever else a step takes are structures
    and addresses of arrays, in the order of `sg_engine` in csrc/api.h.
    """

    def forward(self, step: str, problem: ctypes.Structure, *arguments: object) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index."""
        ...

    def backward(self, step: str, problem: ctypes.Structure, *arguments: object) -> None:
        """Run the adjoint of the last forward call; that of "project" keeps nothing: of any problem."""
        ...

    def lattice(self, view: int) -> ctypes.Structure:
        """Where the rays of a view stand."""
        ...

    def normal_lobes(self, lobes: ctypes.Structure) -> None:
        """Fill in γ⁰ of Gaussians towards views."""
        ...

    def normal_lobes_backward(self, lobes: ctypes.Structure) -> None:
        """Fill in the gradients."""
        ...

    def trace(
        self, problem: ctypes.Structure, view: int, depth: float, transmittance: int, first_return: int | None
    ) -> None:
        """Fill T_end and, unless None, the first-return range of a view's rays."""
        ...
