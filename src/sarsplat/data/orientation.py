"""Orientation of imported pictures: rotate and flip them so that row 0 is near range, as seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self, get_args

import msgspec
import numpy as np
from jaxtyping import Shaped

from sarsplat.names import Side
from sarsplat.threads import convert

SIDES: tuple[Side, ...] = get_args(Side)


def oriented(
    images: Shaped[np.ndarray, "*v rows columns"], near: Side, mirrored: bool = False
) -> Shaped[np.ndarray, "*v m n"]:
    """Rotate pictures until their side `near` is at the top, then flip their columns if they are `mirrored`."""
    turned = np.rot90(images, SIDES.index(near), axes=(-2, -1))
    return np.ascontiguousarray(turned[..., ::-1] if mirrored else turned)


@dataclass(frozen=True)
class Layout:
    """Orientation of pictures and sense of azimuths, as options of `import folder`."""

    near: Side = "top"
    """Side of the pictures that is near the radar."""
    mirrored: bool = False
    """True if the pictures, rotated with the near side up, are mirror images."""
    counter_clockwise: bool = False
    """True if azimuths run counter-clockwise."""
    looks_left: bool = False
    """True if the table has a radar that looks to the left, which mirrors the pictures once more."""

    @classmethod
    def of(cls, source: Mapping[str, Any]) -> Self | None:
        """Read the layout from a dataset's `source`; None if it was imported by another command."""
        try:
            return convert(source.get("layout"), cls)
        except msgspec.ValidationError:
            return None

    def corrected(self, near: Side, opposite: bool) -> Self:
        """Return the unmirrored layout if in truth the side `near` of the dataset's images is near range.

        `opposite`: the dataset's azimuths run the other way, or its images are mirrored.
        """
        flipped = self.mirrored != self.looks_left
        turns = SIDES.index(self.near) + (-1 if flipped else 1) * SIDES.index(near)
        return type(self)(
            SIDES[turns % 4],
            False,
            self.counter_clockwise ^ opposite ^ self.mirrored,  # the opposite sense replaces a mirror
            self.looks_left,
        )

    @property
    def twin(self) -> Self:
        """The layout that images cannot distinguish from this one: mirrored, with azimuths in the opposite sense."""
        return type(self)(self.near, not self.mirrored, not self.counter_clockwise, self.looks_left)

    def __str__(self) -> str:
        """The layout as options of the command line."""
        words = [f"--near {self.near}", "--mirrored" * self.mirrored, "--counter-clockwise" * self.counter_clockwise]
        return " ".join(word for word in words if word)
