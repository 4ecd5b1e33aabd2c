"""A village of any size: houses with gabled and flat roofs, chimneys and cars on a raster of lots."""

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.scenes._shapes import assembled

LOT_M = 18.0
"""Side of a lot."""
FITTING = 0.64
"""Maximum side of a village that images show whole from all sides, relative to the image's side."""
_EMPTY = 0.12  # share of empty lots
_LARGEST_M = 10_000.0  # maximum side of a village


@checks_arguments
def village(side_m: float = 123.0, seed: int = 0, edge_m: float = 1.0) -> Trimesh:
    """Build a village of any size, the same for the same seed: m, z up, ground at z = 0, centred on the origin.

    `side_m` is the side of its square, with one house on each lot of 18 m × 18 m, of which some are empty; faces are
    divided until no edge is longer than `edge_m`. Raise if a length is not positive, the side exceeds 10 km, or the
    seed is negative.
    """
    import trimesh

    if not (0 < side_m <= _LARGEST_M and edge_m > 0 and seed >= 0):
        raise SarsplatError(
            f"side_m is {side_m:g}, edge_m {edge_m:g} and seed {seed}; give a side of at most {_LARGEST_M:g} m, a "
            "positive edge_m and a seed of at least 0"
        )
    chance, lots = np.random.default_rng(seed), max(1, round(side_m / LOT_M))
    parts = []
    for place in np.ndindex(lots, lots):
        house = _house(chance)
        turn, shift = chance.choice([0, 30, 65, 90, 120]) + chance.normal(0, 3), chance.uniform(-1, 1, 2)
        if chance.random() < _EMPTY and lots > 1:
            continue
        house.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn), (0, 0, 1)))
        house.apply_translation([*((np.array(place) + 0.5) * side_m / lots - side_m / 2 + shift), 0])
        parts.append(house)
    divided = assembled(parts).subdivide_to_size(edge_m)
    assert isinstance(divided, trimesh.Trimesh)  # no indices are asked for
    return divided


def _house(chance: np.random.Generator) -> Trimesh:
    import trimesh

    width, depth, height = chance.uniform(7, 11), chance.uniform(6, 9), chance.uniform(3, 7)
    if chance.random() < 0.65:
        ridge = height + chance.uniform(1.5, 3.5)
        corners = [(x, y, z) for x in (-width / 2, width / 2) for y in (-depth / 2, depth / 2) for z in (0, height)]
        body = trimesh.convex.convex_hull(np.array([*corners, (-width / 2, 0, ridge), (width / 2, 0, ridge)]))
        parts = [body, _box(0.8, 0.8, ridge + 0.7, (width / 4, depth / 8))]
    else:
        parts = [_box(width, depth, height, (0, 0)), _box(width / 3, depth / 3, height + 1.5, (0, 0))]
    if chance.random() < 0.5:
        parts.append(_box(4.2, 1.8, 1.4, (width / 2 + 1.6, -depth / 4)))
    return assembled(parts)


def _box(width: float, depth: float, height: float, at: tuple[float, float]) -> Trimesh:
    import trimesh

    box = trimesh.creation.box((width, depth, height))
    box.apply_translation([*at, height / 2])
    return box
