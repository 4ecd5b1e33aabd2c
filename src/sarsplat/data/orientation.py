"""Turn pictures of any origin so that they lie as ours do: row 0 near, as seen from above."""

from __future__ import annotations

from typing import get_args

import numpy as np
from jaxtyping import Shaped

from sarsplat.errors import SarsplatError
from sarsplat.names import Side


def oriented(
    image: Shaped[np.ndarray, "rows columns"], near: Side, mirrored: bool = False
) -> Shaped[np.ndarray, "m n"]:
    """The picture with its side `near` at the top, and its columns flipped if it is then a mirror image.

    Raises
    ------
    SarsplatError
        If there is no such side.
    """
    if near not in get_args(Side):
        raise SarsplatError(f"near is {near!r}; it must be one of {', '.join(get_args(Side))}")
    turned = np.rot90(image, get_args(Side).index(near))
    return np.ascontiguousarray(turned[:, ::-1] if mirrored else turned)
