"""Axes and rates by which the frames of a pass were made, known to within degrees and per cent: refined with the scene.

Of each pass three numbers are looked for, in standard deviations: the axis turned in two directions across it, and the
rate of rotation. They are stepped as Gauss and Newton do, by how the rendered images change with each of them, towards
where the images' differences and the deviations are least likely to be chance together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import View
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, State, at_round
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Turns

_MOVED = 0.25
"""By how much places at the edge of the target move in images that are compared to find slopes, resolution cells."""

_FRACTIONS = (1.0, 0.5, 0.25, 0.1, 0.03)
"""Of a step, until one makes what is minimised less."""

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
        self._views, self._settings, self._iterations = train.views, settings, iterations
        self._turns = [entry.turn for entry in train.entries]
        passes = dict.fromkeys(turn.of_pass for turn in self._turns if turn is not None and turn.uncertain)
        order = {of_pass: number for number, of_pass in enumerate(passes)}
        self._pass = np.array([-1 if turn is None else order.get(turn.of_pass, -1) for turn in self._turns])
        firsts = [self._turns[int(np.flatnonzero(self._pass == number)[0])] for number in range(len(order))]
        self._std = np.array([(one.axis_std_deg, one.axis_std_deg, one.rate_std) for one in firsts if one is not None])

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        uncertain = any(entry.turn is not None and entry.turn.uncertain for entry in train.entries)
        return cls(train, config.turns, config.iterations) if uncertain else None

    def initial_state(self, params: dict[str, Tensor]) -> State:
        """Corrections, zero at first: of each pass, of the axis in two directions, degrees, and of the rate."""
        return State(whole={"correction": torch.zeros(self._std.shape, dtype=torch.float64, device="cpu")})

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
            each = [measured.sqrt() - rendered.clamp(min=0).sqrt() for measured, rendered in info.compared(views, numbers)]
            return torch.cat(each).flatten(1).double().cpu().numpy()

        truth, grid = info.images.truth, info.images.grid
        samples = (truth > _FAINT * truth.amax((1, 2), keepdim=True)).sum((1, 2)).double().cpu().numpy()
        samples *= grid.independent_samples / (grid.rows * grid.columns)
        radius_m = float(params["means"].detach().square().sum(1).max().sqrt())
        correction = self.stepped(state.whole["correction"].numpy(), differences, samples, grid.cell_m / radius_m)
        state.whole["correction"] = torch.from_numpy(correction)
        info.images.views = self.views(correction)

    def views(self, correction: Float64[np.ndarray, "passes 3"]) -> tuple[View, ...]:
        """The training views with these corrections; those of passes that are known exactly stay as they are."""
        return tuple(self._corrected(k, correction[of]) if of >= 0 else self._views[k] for k, of in enumerate(self._pass))

    def _corrected(self, frame: int, correction: Float64[np.ndarray, " 3"]) -> View:
        first, second, faster = correction.tolist()
        turn = self._turns[frame]
        assert turn is not None
        return turn.corrected(self._views[frame], (first, second), faster)

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
        for of, std in enumerate(self._std):
            frames = np.flatnonzero(self._pass == of)
            free, scale = std > 0, np.where(std > 0, std, 1.0)
            here = correction[of] / scale
            angles = np.array([abs(turn.angle_deg) for k in frames if (turn := self._turns[k]) is not None])
            widest = max(np.radians(angles).max(), 1.0)
            steps = np.minimum(_MOVED * cell_rad * np.array([np.degrees(1), np.degrees(1), 1 / widest]) / scale, 1.0)

            def seen(places: list[Float64[np.ndarray, " 3"]]) -> Float64[np.ndarray, "places frames pixels"]:
                views = [self._corrected(k, place * scale) for place in places for k in frames]
                return differences(views, np.tile(frames, len(places))).reshape(len(places), len(frames), -1)

            moved = [here + sign * steps[axis] * np.eye(3)[axis] for axis in np.flatnonzero(free) for sign in (1, -1)]
            at, *around = seen([here, *moved])
            slopes = np.zeros((3, *at.shape))
            for axis, ahead, behind in zip(np.flatnonzero(free), around[::2], around[1::2], strict=True):
                slopes[axis] = (ahead - behind) / (2 * steps[axis])
            weights = samples[frames] / np.maximum((at**2).sum(1), np.finfo(float).tiny)
            normal = np.einsum("ikp,jkp,k->ij", slopes, slopes, weights) + np.eye(3)
            step = -np.linalg.solve(normal, np.einsum("ikp,kp,k->i", slopes, at, weights) + here)
            tried = [here, *(here + fraction * step for fraction in _FRACTIONS)]
            costs = [
                float((samples[frames] * np.log(np.maximum((one**2).sum(1), np.finfo(float).tiny))).sum() + place @ place)
                for place, one in zip(tried, seen(tried), strict=True)
            ]
            changed[of] = tried[int(np.argmin(costs))] * scale
        return changed
