"""Bilinear interpolation on a lattice around the origin, constant beyond its edges."""

from jaxtyping import Float, Int64
from torch import Tensor


def at_places(
    table: Float[Tensor, "ny nx"], x: Float[Tensor, "*n"], y: Float[Tensor, "*n"], pitch_m: float
) -> Float[Tensor, "*n"]:
    """Interpolate a table at (x, y), m; differentiable by all three, with gradients summed in a fixed order."""
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
    """Return the index of the lattice point before, the share of the step to the next, and the increment to that."""
    place = (place_m / pitch_m + (count - 1) / 2).clamp(0, count - 1)
    before = place.detach().floor().clamp(max=max(count - 2, 0))
    return before.long(), place - before, min(count - 1, 1)


def _rows(table: Float[Tensor, " n"], index: Tensor) -> Tensor:
    """Return `table[index]`, whose gradient is summed in a fixed order."""
    if table.is_cuda:
        return table[index]
    return table.index_select(0, index.reshape(-1)).view(index.shape)  # twenty times as fast on a CPU
