"""Axes and rates by which the frames of a pass were made, known to within degrees and per cent: refined with the scene.

Of each pass three numbers are looked for, in standard deviations: the axis turned in two directions across it, and the
rate of rotation. They are stepped as Gauss and Newton do, by how the rendered images change with each of them, towards
where the images' differences and the deviations are least likely to be chance together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.geometry import Turn, View
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, State, at_round
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Turns

_MOVED = 0.25
"""By how much places at the edge of the target move in images that are compared to find slopes, resolution cells."""

_FRACTIONS = (1.0, 0.5, 0.25, 0.1, 0.03)
"""Of a step, until shorter ones make what is minimised no less."""

_BEYOND = 1.7
"""How far a step goes, of what it finds best: a scene that has learned to show frames from where they were taken to be
stands up for that, and follows."""

_REACH = 3.0
"""How far from what was assumed axis and rate are looked for, standard deviations."""

_FAINT = 1e-3
"""Of the brightest pixel of an image: fainter ones do not count as samples."""

TURN_CORRECTIONS = "strategy/turns/correction"
"""In a snapshot: float64 [passes, 3]; of each pass, in the order of their first frames, by how much its axis is turned
in either direction, degrees, and by which share its rate is faster."""

Differences = Callable[[Sequence[View], Int64[np.ndarray, " n"]], Float64[np.ndarray, "n pixels"]]
"""From views and the numbers of training images to how much the images as seen from there differ, in amplitude."""


class TurnRefinement(Configured):
    """Estimates axes and rates of the passes that training frames are of, given what was assumed and how well."""

    order = 31
    name = "turns"

    def __init__(self, train: Dataset, settings: Turns, iterations: int) -> None:
        self._entries, self._settings, self._iterations = train.entries, settings, iterations
        self._passes = uncertain_passes(train)
        self._pass = np.array([-1 if (of := _number(self._passes, one)) is None else of for one in self._entries])

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        return cls(train, config.turns, config.iterations) if uncertain_passes(train) else None

    def initial_state(self, params: dict[str, Tensor]) -> State:
        """Corrections, zero at first: of each pass, of the axis in two directions, degrees, and of the rate."""
        return State(whole={"correction": torch.zeros(len(self._passes), 3, dtype=torch.float64, device="cpu")})

    def due(self, step: int) -> bool:
        s = self._settings
        return s.rounds > 0 and at_round(step, s.begin * self._iterations, s.until * self._iterations, s.rounds - 1)

    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        if not self.due(step):
            return
        info.check()

        def differences(views: Sequence[View], numbers: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n pixels"]:
            each = [
                measured.sqrt() - rendered.clamp(min=0).sqrt() for measured, rendered in info.compared(views, numbers)
            ]
            return torch.cat(each).flatten(1).double().cpu().numpy()

        truth, grid = info.images.truth, info.images.grid
        samples = (truth > _FAINT * truth.amax((1, 2), keepdim=True)).sum((1, 2)).double().cpu().numpy()
        samples *= grid.independent_samples / (grid.rows * grid.columns)
        radius_m = float(params["means"].detach().square().sum(1).max().sqrt())
        correction = self.stepped(state.whole["correction"].numpy(), differences, samples, grid.cell_m / radius_m)
        state.whole["correction"] = torch.from_numpy(correction)
        info.images.views = corrected_views(self._entries, self._passes, correction)

    def stepped(
        self,
        correction: Float64[np.ndarray, "passes 3"],
        differences: Differences,
        samples: Float64[np.ndarray, " k"],
        cell_rad: float,
    ) -> Float64[np.ndarray, "passes 3"]:
        """Corrections after one step from these.

        `samples` are the independent ones of each image, and `cell_rad` the angle of a resolution cell as seen from the
        middle of the target, at its edge.
        """
        changed = correction.copy()
        for of, turn in enumerate(self._passes):
            frames = np.flatnonzero(self._pass == of)
            own = Pass(turn, [self._entries[k] for k in frames], frames, differences, samples[frames])
            changed[of] = own.stepped(correction[of], cell_rad)
        return changed


@dataclass(frozen=True)
class Pass:
    """What frames of one pass say of its axis and its rate."""

    turn: Turn
    entries: Sequence[DatasetEntry]
    numbers: Int64[np.ndarray, " frames"]
    differences: Differences
    samples: Float64[np.ndarray, " frames"]

    def stepped(self, correction: Float64[np.ndarray, " 3"], cell_rad: float) -> Float64[np.ndarray, " 3"]:
        """The correction after one step; see `TurnRefinement.stepped`."""
        std = np.array([self.turn.axis_std_deg, self.turn.axis_std_deg, self.turn.rate_std])
        free, scale = np.flatnonzero(std), np.where(std > 0, std, 1.0)
        here = correction / scale
        angles = [math.radians(abs(entry.turn.angle_deg)) for entry in self.entries if entry.turn is not None]
        cell = cell_rad * np.array([math.degrees(1), math.degrees(1), 1 / max(1.0, *angles)])
        moves = np.diag(np.minimum(_MOVED * cell / scale, 1.0))[free]
        at, *around = self._seen([here, *(here + sign * move for move in moves for sign in (1, -1))], scale)
        slopes = np.zeros((3, *at.shape))
        for axis, ahead, behind in zip(free, around[::2], around[1::2], strict=True):
            slopes[axis] = (ahead - behind) / (2 * moves.sum(0)[axis])
        weights = self.samples / _squares(at)
        normal = np.einsum("ikp,jkp,k->ij", slopes, slopes, weights) + np.eye(3)
        step = -np.linalg.solve(normal, np.einsum("ikp,kp,k->i", slopes, at, weights) + here)
        best, lowest = here, self._cost(at, here)
        for fraction in _FRACTIONS:
            place = here + fraction * step
            cost = self._cost(self._seen([place], scale)[0], place)
            if cost < lowest:
                best, lowest = place, cost
            elif best is not here:
                break
        found: Float64[np.ndarray, " 3"] = (here + _BEYOND * (best - here)).clip(-_REACH, _REACH) * scale
        return found

    def _cost(self, seen: Float64[np.ndarray, "frames pixels"], place: Float64[np.ndarray, " 3"]) -> float:
        """Twice the negative logarithm of the probability of differences and corrections, but for a constant."""
        return float(self.samples @ np.log(_squares(seen)) + place @ place)

    def _seen(
        self, places: Sequence[Float64[np.ndarray, " 3"]], scale: Float64[np.ndarray, " 3"]
    ) -> Float64[np.ndarray, "places frames pixels"]:
        """How much the frames differ with each of these corrections, in standard deviations."""
        views = [view for place in places for view in corrected_views(self.entries, [self.turn], (place * scale)[None])]
        return self.differences(views, np.tile(self.numbers, len(places))).reshape(len(places), len(self.numbers), -1)


def _squares(differences: Float64[np.ndarray, "frames pixels"]) -> Float64[np.ndarray, " frames"]:
    return np.maximum((differences**2).sum(1), np.finfo(float).tiny)


def uncertain_passes(train: Dataset) -> tuple[Turn, ...]:
    """Of each pass whose axis or rate is uncertain, the turn of its first training frame."""
    turns = [entry.turn for entry in train.entries if entry.turn is not None and entry.turn.uncertain]
    return tuple({turn.of_pass: turn for turn in reversed(turns)}.values())[::-1]


def corrected_views(
    entries: Sequence[DatasetEntry], passes: Sequence[Turn], correction: Float64[np.ndarray, "passes 3"]
) -> tuple[View, ...]:
    """Views of any images, with the corrections of those that are of one of the passes; others stay as they are."""
    views = []
    for entry in entries:
        of = _number(passes, entry)
        if entry.turn is None or of is None:
            views.append(entry.view)
        else:
            first, second, faster = correction[of].tolist()
            views.append(entry.turn.corrected(entry.view, (first, second), faster))
    return tuple(views)


def _number(passes: Sequence[Turn], entry: DatasetEntry) -> int | None:
    """Of which pass an image is."""
    alike = (k for k, one in enumerate(passes) if entry.turn is not None and one.of_pass == entry.turn.of_pass)
    return next(alike, None)
