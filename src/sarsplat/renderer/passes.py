"""What an engine does."""

from __future__ import annotations

import ctypes
from typing import Protocol


class Pass(Protocol):
    """What an engine does: one forward pass, and what its backward pass needs."""

    def forward(self, problem: ctypes.Structure, outputs: ctypes.Structure) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index."""
        ...

    def backward(self, problem: ctypes.Structure, gradients: ctypes.Structure) -> None:
        """Run the adjoint of the last forward pass."""
        ...

    def lattice(self, view: int) -> ctypes.Structure:
        """Where the rays of a view stand."""
        ...

    def trace(self, problem: ctypes.Structure, view: int, depth: float, transmittance: int, first_return: int) -> None:
        """Fill T_end and the first-return range of a view's rays."""
        ...

    # one step alone each (structs.Projection between them), and its adjoint
    def project(self, problem: ctypes.Structure, out: ctypes.Structure) -> tuple[str, int]: ...
    def project_backward(
        self, problem: ctypes.Structure, seeds: ctypes.Structure, gradients: ctypes.Structure
    ) -> None: ...
    def attenuate(self, problem: ctypes.Structure, footprints: ctypes.Structure, lit_area: int) -> tuple[str, int]: ...
    def attenuate_backward(
        self,
        problem: ctypes.Structure,
        d_lit_area: int | None,
        d_transmittance: int | None,
        gradients: ctypes.Structure,
    ) -> None: ...
    def splat(
        self, problem: ctypes.Structure, footprints: ctypes.Structure, channels: ctypes.Structure, images: int
    ) -> tuple[str, int]: ...
    def splat_backward(
        self,
        problem: ctypes.Structure,
        channels: ctypes.Structure,
        d_images: int,
        gradients: ctypes.Structure,
        d_cross_sections: int,
    ) -> None: ...
