"""Scores of images against unseen views, and LPIPS."""

import math
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from made import small_dataset, small_mask
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import (
    Lpips,
    MaskPair,
    log_correlation,
    lpips,
    nats_per_pixel,
    predicted_masks,
    psnr_db,
    psnr_target_db,
    register,
    registered_log_correlation,
    ssim,
)
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.evaluation.lpips import WEIGHTS_VARIABLE, lpips_weights


def stack(*levels: float, size: int = 64) -> np.ndarray:
    """One uniform image per level of power."""
    return np.stack([np.full((size, size), level, np.float32) for level in levels])


@pytest.mark.parametrize(
    ("truth", "rendered", "expected"),
    [
        ([9.0], [4.0], 20.0),  # amplitudes 3 and 2, reference 10: error .1; power would give something else
        ([4.0, 4.0], [9.0, 4.41], 30.0),  # averaged in decibels, of 20 and 40; pooled squares would give 22.97
        ([400.0], [100.0], 0.0),  # not clipped above the training maximum
        ([1.0], [1.0], -20 * math.log10(np.finfo(np.float32).eps)),  # perfect, and finite
    ],
)
def test_psnr_compares_amplitudes_divided_by_the_training_maximum(truth, rendered, expected):
    assert psnr_db(stack(*truth), stack(*rendered), 10.0) == pytest.approx(expected, abs=1e-3)


def test_target_psnr_counts_only_pixels_above_minus_30_db_of_the_set():
    truth, rendered = np.zeros((3, 64, 64), np.float32), np.zeros((3, 64, 64), np.float32)
    truth[0, :8, :8], rendered[0, :8, :8] = 1.0, 0.81  # error .1 on the target
    truth[1, :2, :2], rendered[1, :2, :2] = 0.0011, 0.0  # above 0.001 of the *set's* maximum: a target pixel
    truth[1, 4:, 4:], rendered[1, 4:, 4:] = 0.0009, 0.5  # below: not scored, however wrong
    rendered[2] = 1.0  # an image without a target
    expected = (20.0 - 10 * math.log10(0.0011)) / 2
    assert psnr_target_db(truth, rendered, 1.0) == pytest.approx(expected, abs=1e-3)
    assert psnr_db(truth[:1], rendered[:1], 1.0) == pytest.approx(20.0 + 10 * math.log10(64), abs=1e-3)


def test_ssim_matches_a_direct_gaussian_window():
    from scipy.ndimage import correlate1d

    generator = np.random.default_rng(0)
    truth, rendered = generator.random((2, 1, 40, 40), dtype=np.float32)
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window /= window.sum()

    def mean(a: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(a, window, axis=0, mode="mirror"), window, axis=1, mode="mirror")

    a, b = np.sqrt(truth[0].astype(float)), np.sqrt(rendered[0].astype(float))
    covariance, va, vb = mean(a * b) - mean(a) * mean(b), mean(a * a) - mean(a) ** 2, mean(b * b) - mean(b) ** 2
    score = (2 * mean(a) * mean(b) + 1e-4) * (2 * covariance + 9e-4)
    score /= (mean(a) ** 2 + mean(b) ** 2 + 1e-4) * (va + vb + 9e-4)
    assert ssim(truth, rendered, 1.0) == pytest.approx(score.mean(), abs=1e-6)


def test_nats_are_log_s_plus_ratio_inside_the_margin_only():
    truth, rendered = stack(6.0, size=128), stack(3.0, size=128)
    for chips in (truth, rendered):
        chips[:, :24], chips[:, 104:], chips[:, :, :24], chips[:, :, 104:] = 1e6, 1e-6, 1e6, 1e-6
    rendered[:, 0, 0] = 0.0  # outside the margin: no matter
    assert nats_per_pixel(truth, rendered, 24) == pytest.approx(math.log(3) + 2, rel=1e-6)
    truth[:, 24, 24] += 80 * 80  # the first pixel inside
    assert nats_per_pixel(truth, rendered, 24) == pytest.approx(math.log(3) + 2 + 1 / 3, rel=1e-6)


def test_correlation_filters_the_full_chip_then_crops():
    generator = np.random.default_rng(2)
    truth, rendered = generator.exponential(size=(2, 3, 60, 60))
    expected = []
    for a, b in zip(truth, rendered):
        means = [
            [np.log(image[r - 1 : r + 2, c - 1 : c + 2].mean()) for r in range(24, 36) for c in range(24, 36)]
            for image in (a, b)
        ]
        expected.append(np.corrcoef(means)[0, 1])
    assert log_correlation(truth, rendered, 24) == pytest.approx(np.mean(expected), abs=1e-12)


def test_correlation_ignores_scale_and_constant_predictions_score_nothing():
    chips = np.random.default_rng(3).exponential(size=(2, 64, 64))
    assert log_correlation(chips, 7 * chips) == pytest.approx(1.0)
    assert log_correlation(chips, np.ones_like(chips)) == 0.0


CHIPS = np.random.default_rng(4).exponential(size=(1, 64, 64))
HOLED = CHIPS.copy()
HOLED[0, 30:34, 30:34] = 0


@pytest.mark.parametrize(
    ("score", "words"),
    [
        (lambda: psnr_target_db(stack(0.0), stack(1.0), 1.0), "true images are black everywhere"),
        (lambda: ssim(stack(1.0, size=10), stack(1.0, size=10), 1.0), "11×11"),
        (lambda: nats_per_pixel(stack(1.0, size=48), stack(1.0, size=48), 24), "48 × 48"),
        (lambda: register(CHIPS, CHIPS, 32), "64 × 64 pixels has nothing left"),
        (lambda: registered_log_correlation(CHIPS, CHIPS, 32), "64 × 64 pixels has nothing left"),
        (lambda: nats_per_pixel(CHIPS, HOLED, 24), r"zero at 16 of 256 .* noise floor"),
        (lambda: log_correlation(HOLED, CHIPS, 24), r"true power is zero at 4 of 256 .* raise zeros"),
    ],
)
def test_what_has_no_score(score, words):
    with pytest.raises(UndefinedScore, match=words):
        score()


SCORES = (lambda t, r: psnr_db(t, r, 1.0), nats_per_pixel, log_correlation, register, registered_log_correlation)


@pytest.mark.parametrize("score", SCORES)
def test_unsound_images_are_refused_not_scored(score):
    bad = stack(1.0)
    bad[0, 3, 3] = np.nan
    for truth, rendered, message in (
        (stack(1.0), bad, "rendered images hold"),
        (-stack(1.0), stack(1.0), "true images hold"),
        (stack(1.0), stack(1.0, 1.0), "equal"),
        (np.empty((0, 64, 64)), np.empty((0, 64, 64)), "non-empty"),
    ):
        with pytest.raises(SarsplatError, match=message) as caught:
            score(truth, rendered)
        assert not isinstance(caught.value, UndefinedScore)
    with pytest.raises(SarsplatError, match=r"0\.0"):
        psnr_db(stack(1.0), stack(1.0), 0.0)  # the reference


# ---- registered scores: every prediction is shifted and scaled to fit its chip best ----
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


@pytest.mark.parametrize(
    ("score", "of_black"), [(register, "black inside the margin"), (registered_log_correlation, "true power is zero")]
)
def test_zeros_and_black_chips_have_no_score(predicted, score, of_black):
    holed, black = predicted.copy(), predicted.copy()
    holed[0, :3, :3] = 0  # farther outside than any move
    score(predicted, holed, 6)
    holed[0, :5, :5] = 0  # outside the margin, but three pixels move it inside, even what is zero after 3×3 means
    black[1, 6:-6, 6:-6] = 0
    for truth, rendered, words in ((predicted, holed, "the predicted power is zero at"), (black, predicted, of_black)):
        with pytest.raises(UndefinedScore, match=words):
            score(truth, rendered, 6)


# ---- masks ----
def test_iou_is_averaged_over_images():
    truth = np.stack([small_mask(), small_mask(), np.zeros_like(small_mask())])
    half = small_mask()
    half[5:8, 4:6] = 0
    pair = MaskPair(truth, np.stack([half, small_mask(), np.zeros_like(small_mask())]))
    assert pair.iou(1) == pytest.approx((0.5 + 1) / 2)  # the empty image does not count
    assert pair.iou(2) == 1
    with pytest.raises(UndefinedScore, match="neither"):
        MaskPair(truth[2:], truth[2:]).iou(1)


@pytest.mark.parametrize(("shift", "looks"), [((2, -1), 1.0), ((-2, 1), 1.0), ((2, -1), None)])
def test_masks_lie_where_speckled_images_fit_best_and_else_where_they_are_rendered(shift, looks):
    mean = np.where(small_mask() == 1, 30.0, 1.0)
    chip = np.roll(mean, shift, (0, 1)) * np.random.default_rng(1).exponential(size=mean.shape)
    power = np.stack([chip] * 3).astype(np.float32)
    images = replace(small_dataset(), power=power, looks=looks, score_margin=1).select("test")
    run = SimpleNamespace(masks=lambda views: np.stack([small_mask()] * len(views)))
    predicted_classes = predicted_masks(run, images, np.stack([mean] * 2))
    np.testing.assert_array_equal(predicted_classes[0], np.roll(small_mask(), shift, (0, 1)) if looks else small_mask())
    run = SimpleNamespace(masks=lambda views: np.full((len(views), *mean.shape), 2, np.uint8))
    shadow = predicted_masks(run, images, np.stack([mean] * 2))[0] == 2  # clutter comes in where it is moved away
    assert shadow.sum() == np.prod(np.subtract(mean.shape, np.abs(shift) if looks else 0))


# ---- LPIPS -----------------------------------------------------------------------------------------------------------
WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "weights"
needs_weights = pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"the LPIPS weights are not in {WEIGHTS}")


@pytest.fixture(scope="module")
def network() -> Lpips:
    return Lpips(WEIGHTS)


def read(name: str) -> torch.Tensor:
    image = pytest.importorskip("PIL.Image").open(WEIGHTS / "lpips_check_imgs" / f"{name}.png").convert("RGB")
    return torch.from_numpy(np.asarray(image).astype(np.float32) / 127.5 - 1).permute(2, 0, 1)[None]


@needs_weights
@pytest.mark.parametrize(("name", "expected"), [("ex_p0", 0.7219), ("ex_p1", 0.1376)])
def test_published_pairs(network, name, expected):
    assert float(network(read("ex_ref"), read(name))) == pytest.approx(expected, abs=1e-4)


@needs_weights
def test_sets_are_averaged_and_grey_amplitudes_fill_minus_one_to_one(network):
    amplitude = np.random.default_rng(0).random((2, 2, 64, 64), dtype=np.float32)
    truth, rendered = (25 * amplitude**2).astype(np.float32)  # reference amplitude 5
    grey = [torch.from_numpy(a * 2 - 1)[:, None].repeat(1, 3, 1, 1) for a in amplitude]
    assert lpips(truth, rendered, 5.0, network) == pytest.approx(float(network(*grey).mean()), abs=1e-5)
    assert lpips(truth, truth, 5.0, network) == 0.0


@needs_weights
def test_small_images_have_no_lpips(network):
    smallest = np.ones((1, 31, 31), np.float32)
    assert lpips(smallest, smallest, 1.0, network) == 0.0
    with pytest.raises(UndefinedScore, match="30 × 40"):
        lpips(np.ones((1, 30, 40), np.float32), np.ones((1, 30, 40), np.float32), 1.0, network)


class _Exploit:
    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self):
        return Path.touch, (self.victim,)


@needs_weights
@pytest.mark.parametrize("name", ["alexnet_features_torchvision.npz", "lpips_v0.1_lin_alex.pth"])
def test_nothing_is_unpickled_freely(tmp_path, name):
    shutil.copytree(WEIGHTS, tmp_path / "weights", copy_function=shutil.copyfile)
    (tmp_path / "weights" / name).write_bytes(pickle.dumps(_Exploit(tmp_path / "victim"), protocol=2))
    with pytest.raises(SarsplatError, match="no usable LPIPS weights"):
        Lpips(tmp_path / "weights")
    assert not (tmp_path / "victim").exists()


def test_the_argument_goes_before_the_environment(monkeypatch):
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    assert lpips_weights(None) is None
    monkeypatch.setenv(WEIGHTS_VARIABLE, "named")
    assert lpips_weights(None) == Path("named")
    assert lpips_weights(Path("given")) == Path("given")
