"""What is seen by a way in and another way out: √(seen one way · seen the other way).

What Gaussians of one surface take from each other is the same either way, and counts once: of equal ways it is what one
radar sees.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def both_ways(there: Float[Tensor, "*n"], back: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """√(there · back); its slope is infinite where one of them is 0, and taken as 0."""
    both = there * back
    some = both > 0
    return both.where(some, 1.0).sqrt() * some
