"""Values at places on a lattice around the origin: linear between them, and beyond the last ones as there."""

from __future__ import annotations

from jaxtyping import Float, Int64
from torch import Tensor


def at_places(
    table: Float[Tensor, "ny nx"], x: Float[Tensor, "*n"], y: Float[Tensor, "*n"], pitch_m: float
) -> Float[Tensor, "*n"]:
    """The table's values at (x, y), m; differentiable by all three, with sums in the same order in every run."""
    (column, right, next_column), (row, down, next_row) = (
        _between(at, pitch_m, count) for at, count in zip((x, y), reversed(table.shape), strict=True)
    )
    flat, at, step = table.reshape(-1), row * table.shape[1] + column, next_row * table.shape[1]
    upper = _rows(flat, at).lerp(_rows(flat, at + next_column), right)
    lower = _rows(flat, at + step).lerp(_rows(flat, at + step + next_column), right)
    return upper.lerp(lower, down)


def _between(
    place_m: Float[Tensor, "*n"], pitch_m: float, count: int
) -> tuple[Int64[Tensor, "*n"], Float[Tensor, "*n"], int]:
    """The places before, how far on it is to the next ones, and how many numbers on those are."""
    place = (place_m / pitch_m + (count - 1) / 2).clamp(0, count - 1)
    before = place.detach().floor().clamp(max=max(count - 2, 0))
    return before.long(), place - before, min(count - 1, 1)


def _rows(table: Float[Tensor, " n"], index: Tensor) -> Tensor:
    """`table[index]`, whose gradient is summed in the same order in every run."""
    if table.is_cuda:
        return table[index]
    return table.index_select(0, index.reshape(-1)).view(index.shape)  # twenty times as fast on a CPU
