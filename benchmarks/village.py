"""A village of any size: houses with gabled and flat roofs, chimneys and cars, one lot beside the other."""

from __future__ import annotations

from typing import cast

import numpy as np
import trimesh

LOT_M = 18.0
_EMPTY = 0.12  # share of the lots


def village(side_m: float, seed: int = 0, edge_m: float = 1.0) -> trimesh.Trimesh:
    """Houses on a square, their faces divided until no edge is longer than `edge_m`; the same for the same seed."""
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
    divided = _together(parts).subdivide_to_size(edge_m)
    assert isinstance(divided, trimesh.Trimesh)  # no indices are asked for
    return divided


def _house(chance: np.random.Generator) -> trimesh.Trimesh:
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
    return _together(parts)


def _together(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return cast("trimesh.Trimesh", trimesh.util.concatenate(parts))


def _box(width: float, depth: float, height: float, at: tuple[float, float]) -> trimesh.Trimesh:
    box = trimesh.creation.box((width, depth, height))
    box.apply_translation([*at, height / 2])
    return box
