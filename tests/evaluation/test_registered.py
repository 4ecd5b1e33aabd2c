"""Registered scores: every prediction is shifted and scaled to fit its chip best."""

from __future__ import annotations

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.evaluation import log_correlation, nats_per_pixel, register, registered_log_correlation
from sarsplat.evaluation.images import UndefinedScore


def speckled(mean: np.ndarray, seed: int = 0) -> np.ndarray:
    return mean * np.random.default_rng(seed).exponential(size=mean.shape)


@pytest.fixture
def predicted() -> np.ndarray:
    """Three smooth, uneven images, 40 × 52."""
    x, y = np.meshgrid(np.arange(52), np.arange(40))
    return np.stack([np.exp(2 * np.sin(x / 4 + k) * np.cos(y / (5 + k))) for k in range(3)])


def test_displacement_and_gain_are_found(predicted):
    shift, gain = [(0, 0), (3, -2), (-1, 3)], np.array([1.0, 40.0, 0.2])
    moved = np.stack([np.roll(image, by, (0, 1)) for image, by in zip(predicted, shift)])
    registration = register(speckled(gain[:, None, None] * moved), predicted, 6)
    assert registration.shift.tolist() == [list(by) for by in shift]
    assert registration.gain == pytest.approx(gain, rel=0.1)
    assert registration.gain != pytest.approx(gain, rel=1e-6)  # it is fitted to the speckle
    faint = register(speckled(gain[:, None, None] * moved), 1e-9 * predicted, 6)  # in another unit
    assert faint.nats == pytest.approx(registration.nats) and faint.gain == pytest.approx(1e9 * registration.gain)


@pytest.mark.parametrize("margin", [0, 2, 6])
def test_it_is_the_best_of_all_that_are_tried(predicted, margin):
    truth = speckled(np.roll(predicted, (1, 2), (1, 2)), 1)
    nats, correlations = [], []
    for down in range(-3, 4):
        for right in range(-3, 4):
            moved = np.roll(predicted, (down, right), (1, 2))
            inside = slice(margin, 40 - margin), slice(margin, 52 - margin)
            gains = (truth / moved)[:, *inside].mean(axis=(1, 2), keepdims=True)
            nats.append([nats_per_pixel(t[None], p[None], margin) for t, p in zip(truth, gains * moved)])
            correlations.append([log_correlation(t[None], p[None], margin) for t, p in zip(truth, moved)])
    assert register(truth, predicted, margin).nats == pytest.approx(np.min(nats, axis=0), abs=1e-12)
    if margin > 3:  # elsewhere the means know of the edges
        expected = np.mean(np.max(correlations, axis=0))
        assert registered_log_correlation(truth, predicted, margin) == pytest.approx(expected)


def test_zeros_and_black_chips_have_no_score(predicted):
    holed = predicted.copy()
    holed[0, :3, :3] = 0  # farther outside than any move
    assert np.isfinite(register(predicted, holed, 6).nats).all()
    assert np.isfinite(registered_log_correlation(predicted, holed, 6))
    holed[0, :5, :5] = 0  # outside the margin, but three pixels move it inside, even what is zero after 3×3 means
    for score in (register, registered_log_correlation):
        with pytest.raises(UndefinedScore, match="the predicted power is zero at"):
            score(predicted, holed, 6)
    black = predicted.copy()
    black[1, 6:-6, 6:-6] = 0
    with pytest.raises(UndefinedScore, match="black inside the margin"):
        register(black, predicted, 6)
    with pytest.raises(UndefinedScore, match="true power is zero"):
        registered_log_correlation(black, predicted, 6)


@pytest.mark.parametrize("score", [register, registered_log_correlation])
def test_what_cannot_be_compared_is_refused(predicted, score):
    with pytest.raises(SarsplatError, match="must be equal"):
        score(predicted, predicted[:2], 6)
    with pytest.raises(UndefinedScore, match="40 × 52 pixels has nothing left"):
        score(predicted, predicted, 20)
