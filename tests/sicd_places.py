"""Where a scatterer lies in an image: solved from its range and range rate alone, without sarkit's projections."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sicds import Recording


def plane(
    recording: Recording, scp: np.ndarray, arp: np.ndarray, velocity: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors of rows (away from the radar) and columns."""
    sight = (scp - arp) / np.linalg.norm(scp - arp)
    normal = np.cross(velocity, sight)
    normal = (np.sign(normal @ up) * normal) / np.linalg.norm(normal)
    if recording.ground_plane:
        normal = up
    row = sight - (sight @ normal) * normal
    row /= np.linalg.norm(row)
    tilt, turn = np.radians([recording.tilt, recording.turn])
    normal = math.cos(tilt) * normal + math.sin(tilt) * np.cross(row, normal)
    column = np.cross(normal, row)
    return (math.cos(turn) * row + math.sin(turn) * column, math.cos(turn) * column - math.sin(turn) * row)


def rate_along(scp: np.ndarray, arp: np.ndarray, velocity: np.ndarray, column: np.ndarray) -> float:
    """By how much the range rate grows with each metre along the columns."""
    return float(-(velocity - _along(velocity, arp - scp)) @ column / np.linalg.norm(arp - scp))


def _along(vector: np.ndarray, line: np.ndarray) -> np.ndarray:
    return (vector @ line) / (line @ line) * line


def locate(
    kind: str,
    place: np.ndarray,
    scp: np.ndarray,
    arp: np.ndarray,
    velocity: np.ndarray,
    row: np.ndarray,
    column: np.ndarray,
) -> np.ndarray:
    """(xrow, ycol) of a scatterer, metres: where range and range rate are its own."""

    def seen(point: np.ndarray) -> np.ndarray:
        line = arp - point
        distance = np.linalg.norm(line)
        return np.array([distance, velocity @ line / distance])

    wanted = seen(place)
    if kind == "RGAZIM":  # polar format, at the middle of its aperture
        difference = wanted - seen(scp)
        return np.array([difference[0], difference[1] / rate_along(scp, arp, velocity, column)])
    if kind == "RGZERO":  # closest approach of a straight track; its columns grow with time
        speed = float(np.linalg.norm(velocity))
        since = -(velocity @ (arp - place)) / speed**2
        closest = np.linalg.norm(arp + since * velocity - place)
        return np.array([closest - np.linalg.norm(arp - scp), since * math.copysign(speed, velocity @ column)])
    found = np.zeros(2)
    for _ in range(20):
        here = seen(scp + found @ np.array([row, column]))
        steps = np.array([seen(scp + (found + step) @ np.array([row, column])) - here for step in np.eye(2)]).T
        found = found + np.linalg.solve(steps, wanted - here)
    return found
