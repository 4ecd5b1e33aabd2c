"""Refinement of views that are known roughly: azimuths of chips, and rotations of the passes of ISAR frames.

Azimuths are searched one by one. Each pass has three unknowns, in standard deviations: rotations of the axis about two
directions across it, and the rate of rotation. Gauss-Newton steps minimise the images' differences and the deviations
together.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.geometry import Turn, View
from sarsplat.learning.losses import speckle_nats
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State, at_round
from sarsplat.settings.config import Config

_AZIMUTH_REACH = 2.5  # largest offset tried, standard deviations of the label
_EACH_WAY = 5  # number of offsets tried on each side of the label

NegativeLogLikelihood = Callable[[Sequence[View], Int64[np.ndarray, " n"]], Float64[np.ndarray, " n"]]
"""Function from views and numbers of training images to each image's negative log-likelihood, nats."""

AZIMUTH_OFFSETS = "strategy/azimuths/offset_deg"
"""Tensor in snapshots: offsets of the K training views' azimuths, degrees, float64; absent if all are certain."""


class AzimuthRefinement(Configured):
    """Estimates the azimuths of training images from their labels and standard deviations."""

    order = 30
    name = "azimuths"
    section = "surroundings"

    def __init__(self, config: Config, train: Dataset) -> None:
        super().__init__(config, train)
        self._labelled = train.views
        self._std_deg = np.array([entry.azimuth_std_deg for entry in train.entries])

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.surroundings is not None and any(entry.azimuth_std_deg for entry in train.entries)

    def initial_state(self, params: Params) -> State:
        """Azimuth corrections, zero at first, degrees."""
        return State(whole={"offset_deg": torch.zeros(len(self._labelled), dtype=torch.float64, device="cpu")})

    def due(self, step: int) -> bool:
        s, iterations = self.settings, self.config.iterations
        first, last = s.azimuth_from * iterations, s.azimuth_until * iterations
        return s.azimuth_rounds > 0 and at_round(step, first, last, s.azimuth_rounds - 1)

    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        def nats(views: Sequence[View], numbers: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
            batches = [speckle_nats(rendered, measured) for measured, rendered in info.compared(views, numbers)]
            return torch.cat(batches).double().cpu().numpy() * info.images.samples

        offset_deg = self.most_likely(nats)
        state.whole["offset_deg"] = torch.from_numpy(offset_deg)
        info.images.views = self.views(offset_deg)

    def views(self, offset_deg: Float64[np.ndarray, " k"]) -> tuple[View, ...]:
        """Training views with these offsets, degrees, where the azimuth is uncertain."""
        known = zip(self._labelled, offset_deg.tolist(), self._std_deg.tolist(), strict=True)
        return tuple(_turned(view, offset) if std else view for view, offset, std in known)

    def most_likely(self, nats: NegativeLogLikelihood) -> Float64[np.ndarray, " k"]:
        """Most likely offset of each azimuth from its label, given label and image, degrees.

        Their mean, weighted by the labels' precision, is 0: a common offset would turn the target relative to the test
        views. Azimuths that are known exactly fix the heading instead.
        """
        uncertain = np.flatnonzero(self._std_deg)
        std = self._std_deg[uncertain]
        tried = std[:, None] * np.linspace(-_AZIMUTH_REACH, _AZIMUTH_REACH, 2 * _EACH_WAY + 1)
        views = [
            _turned(self._labelled[k], offset)
            for k, row in zip(uncertain, tried.tolist(), strict=True)
            for offset in row
        ]
        misfit = nats(views, np.repeat(uncertain, tried.shape[1])).reshape(tried.shape)
        offset = np.zeros(len(self._std_deg))
        offset[uncertain] = lowest(tried, misfit + (tried / std[:, None]) ** 2 / 2)
        if len(uncertain) == len(offset):
            offset -= np.average(offset, weights=std**-2.0)
        return offset


def lowest(places: Float64[np.ndarray, "k n"], values: Float64[np.ndarray, "k n"]) -> Float64[np.ndarray, " k"]:
    """Minimum of each row, sampled at evenly spaced places: by a parabola through the lowest 3, or at an end."""
    rows = np.arange(len(places))
    best = values.argmin(axis=1)
    middle = best.clip(1, places.shape[1] - 2)
    before, at, after = (values[rows, middle + k] for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    slope = (before - after) / 2
    steps = np.divide(slope, curvature, out=(best - middle).astype(float), where=curvature > 0).clip(-1, 1)
    return places[rows, middle] + steps * (places[:, 1] - places[:, 0])


def _turned(view: View, offset_deg: float) -> View:
    return replace(view, azimuth_deg=(view.azimuth_deg + offset_deg) % 360)


# ---- rotations of the passes of ISAR frames ----
_DIFFERENCE = 0.25  # movement of the target's edge in images of the finite differences, resolution cells
_FRACTIONS = (1.0, 0.5, 0.25, 0.1, 0.03)  # lengths of the line search, relative to the Gauss-Newton step

_OVERSHOOT = 1.7
"""Factor on the best step: the scene has adapted to the assumed views, which shortens the step, and follows later."""

_TURN_REACH = 3.0  # largest correction of axis and rate, standard deviations
_FAINT = 1e-3  # minimum power of a pixel that counts as a sample, relative to the brightest of its image

TURN_CORRECTIONS = "strategy/turns/correction"
"""Tensor in snapshots, float64 [passes, 3]: corrections of each pass, in the order of first frames: rotations of the
axis, degrees, and relative change of the rate."""

Differences = Callable[[Sequence[View], Int64[np.ndarray, " n"]], Float64[np.ndarray, "n pixels"]]
"""Function from views and numbers of training images to the images' differences of amplitude."""


class TurnRefinement(Configured):
    """Estimates axes and rates of the training frames' passes from assumed values and standard deviations."""

    order = 31
    name = "turns"
    section = "turns"

    def __init__(self, config: Config, train: Dataset) -> None:
        super().__init__(config, train)
        self._entries, self._passes = train.entries, uncertain_passes(train)
        self._pass = np.array([-1 if (k := _number(self._passes, one)) is None else k for one in train.entries])

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return bool(uncertain_passes(train))

    def initial_state(self, params: Params) -> State:
        """Corrections of each pass, zero at first (`TURN_CORRECTIONS`)."""
        return State(whole={"correction": torch.zeros(len(self._passes), 3, dtype=torch.float64, device="cpu")})

    def due(self, step: int) -> bool:
        s, iterations = self.settings, self.config.iterations
        return s.rounds > 0 and at_round(step, s.begin * iterations, s.until * iterations, s.rounds - 1)

    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        def differences(views: Sequence[View], numbers: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n pixels"]:
            batches = [
                measured.sqrt() - rendered.clamp(min=0).sqrt() for measured, rendered in info.compared(views, numbers)
            ]
            return torch.cat(batches).flatten(1).double().cpu().numpy()

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

        `samples` is the number of independent samples of each image; `cell_rad` the angle of a resolution cell at the
        target's edge, seen from its centre.
        """
        changed = correction.copy()
        for number, turn in enumerate(self._passes):
            frames = np.flatnonzero(self._pass == number)
            own = Pass(turn, [self._entries[k] for k in frames], frames, differences, samples[frames])
            changed[number] = own.stepped(correction[number], cell_rad)
        return changed


@dataclass(frozen=True)
class Pass:
    """Frames of one pass, and the step of its axis and rate."""

    turn: Turn
    entries: Sequence[DatasetEntry]
    numbers: Int64[np.ndarray, " frames"]
    differences: Differences
    samples: Float64[np.ndarray, " frames"]

    def stepped(self, correction: Float64[np.ndarray, " 3"], cell_rad: float) -> Float64[np.ndarray, " 3"]:
        """Correction after one step; see `TurnRefinement.stepped`."""
        std = np.array([self.turn.axis_std_deg, self.turn.axis_std_deg, self.turn.rate_std])
        free, scale = np.flatnonzero(std), np.where(std > 0, std, 1.0)
        start = correction / scale
        angles = [math.radians(abs(entry.turn.angle_deg)) for entry in self.entries if entry.turn is not None]
        # change of each unknown that moves the target's edge by a resolution cell, in the last frame
        cell = cell_rad * np.array([math.degrees(1), math.degrees(1), 1 / max(1.0, *angles)])
        moves = np.diag(np.minimum(_DIFFERENCE * cell / scale, 1.0))[free]
        residual, *moved = self._residuals([start, *(start + sign * move for move in moves for sign in (1, -1))], scale)
        slopes = np.zeros((3, *residual.shape))
        for axis, ahead, behind in zip(free, moved[::2], moved[1::2], strict=True):
            slopes[axis] = (ahead - behind) / (2 * moves.sum(0)[axis])
        weights = self.samples / _squares(residual)
        normal = np.einsum("ikp,jkp,k->ij", slopes, slopes, weights) + np.eye(3)  # the prior's
        step = -np.linalg.solve(normal, np.einsum("ikp,kp,k->i", slopes, residual, weights) + start)
        best, lowest = start, self._cost(residual, start)
        for fraction in _FRACTIONS:
            tried = start + fraction * step
            cost = self._cost(self._residuals([tried], scale)[0], tried)
            if cost < lowest:
                best, lowest = tried, cost
            elif best is not start:
                break
        return (start + _OVERSHOOT * (best - start)).clip(-_TURN_REACH, _TURN_REACH) * scale

    def _cost(self, residual: Float64[np.ndarray, "frames pixels"], deviations: Float64[np.ndarray, " 3"]) -> float:
        """Twice the negative log probability of residuals and deviations, up to a constant."""
        return float(self.samples @ np.log(_squares(residual)) + deviations @ deviations)

    def _residuals(
        self, tried: Sequence[Float64[np.ndarray, " 3"]], scale: Float64[np.ndarray, " 3"]
    ) -> Float64[np.ndarray, "places frames pixels"]:
        """Differences of the frames with each of these corrections, in units of `scale`."""
        views = [view for one in tried for view in corrected_views(self.entries, [self.turn], (one * scale)[None])]
        return self.differences(views, np.tile(self.numbers, len(tried))).reshape(len(tried), len(self.numbers), -1)


def _squares(differences: Float64[np.ndarray, "frames pixels"]) -> Float64[np.ndarray, " frames"]:
    return np.maximum((differences**2).sum(1), np.finfo(float).tiny)


def uncertain_passes(train: Dataset) -> tuple[Turn, ...]:
    """Turn of the first training frame of each pass whose axis or rate is uncertain."""
    turns = [entry.turn for entry in train.entries if entry.turn is not None and entry.turn.uncertain]
    return tuple({turn.of_pass: turn for turn in reversed(turns)}.values())[::-1]


def corrected_views(
    entries: Sequence[DatasetEntry], passes: Sequence[Turn], correction: Float64[np.ndarray, "passes 3"]
) -> tuple[View, ...]:
    """Views of any images; those of one of the passes are corrected."""
    views = []
    for entry in entries:
        number = _number(passes, entry)
        if entry.turn is None or number is None:
            views.append(entry.view)
        else:
            first, second, faster = correction[number].tolist()
            views.append(entry.turn.corrected(entry.view, (first, second), faster))
    return tuple(views)


def _number(passes: Sequence[Turn], entry: DatasetEntry) -> int | None:
    """Index of an image's pass; None if it is not among `passes`."""
    matches = (k for k, one in enumerate(passes) if entry.turn is not None and one.of_pass == entry.turn.of_pass)
    return next(matches, None)
