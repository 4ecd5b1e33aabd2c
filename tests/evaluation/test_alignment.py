"""Points brought onto a known surface by a small rigid motion."""

from __future__ import annotations

import numpy as np
import pytest

from sarsplat.evaluation.points import Alignment, align

trimesh = pytest.importorskip("trimesh")


def surface(seed: int, count: int = 600) -> np.ndarray:
    """Samples of a stepped block without symmetry."""
    parts = [trimesh.creation.box(bounds=[[-1.2, -1.4, 0], [1.2, 1.4, 0.5]])]
    parts += [trimesh.creation.box(bounds=[[-1.0, 0.1, 0.5], [0.3, 1.2, 1.5]])]
    return trimesh.sample.sample_surface(trimesh.util.concatenate(parts), count, seed=seed)[0]


@pytest.mark.parametrize(("shift", "heading"), [((0, 0, 0), 0), ((0.5, -0.4, 0.1), 3), ((-0.7, 0.2, -0.2), -4)])
def test_it_undoes_a_motion(shift: tuple[float, float, float], heading: float) -> None:
    truth = Alignment(shift, heading, 0.9)
    moved = surface(0) - np.array(shift)
    turned = Alignment((0, 0, 0), -heading, 0.9).moved(moved)  # what `truth` brings back
    motion = align(turned + np.random.default_rng(0).normal(0, 0.03, turned.shape), surface(1), 0.3)
    np.testing.assert_allclose(motion.shift_m, truth.shift_m, atol=0.03)
    assert motion.heading_deg == pytest.approx(heading, abs=0.7)
    assert not motion.at_limit
    assert str(motion).startswith("moved by ")


def test_it_goes_no_farther_than_it_may() -> None:
    motion = align(surface(0) + np.array([2.0, 0, 0]), surface(1), 0.3)
    assert motion.shift_m[0] == pytest.approx(-0.9, abs=0.02)
    assert motion.at_limit
    assert [Alignment((0, 0, 0), turn, 0.9).at_limit for turn in (-5.0, 4.0)] == [True, False]


def test_it_grows_with_the_cell() -> None:
    small, large = (
        align(surface(0) + np.array([0.3, 0, 0]), surface(1), 0.3),
        align(10 * surface(0) + np.array([3, 0, 0]), 10 * surface(1), 3),
    )
    np.testing.assert_allclose(large.shift_m, 10 * np.array(small.shift_m), atol=0.1)


def test_strays_do_not_pull() -> None:
    strays = np.random.default_rng(0).uniform(3, 6, (600, 3))
    motion = align(np.concatenate([surface(0), strays]), surface(1), 0.3)
    np.testing.assert_allclose(motion.shift_m, 0, atol=0.03)


def test_what_is_aloft_is_turned_about_all_axes() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    for axis, name in enumerate("xyz"):
        about = rotation.from_euler(name, 4.0, degrees=True).apply(surface(0))
        turns = np.zeros(3)
        turns[axis] = 4.0
        np.testing.assert_allclose(Alignment((0, 0, 0), turns[2], tilts_deg=tuple(turns[:2])).moved(surface(0)), about)
    turned = rotation.from_rotvec([2.5, -3.0, 2.0], degrees=True).apply(surface(0)) + np.array([0.1, 0.2, -0.1])
    motion, level = (align(turned, surface(1), 0.3, aloft=aloft) for aloft in (True, False))
    assert level.tilts_deg == (0.0, 0.0)
    left = rotation.from_euler("xyz", [*motion.tilts_deg, motion.heading_deg], degrees=True)
    assert np.degrees((left * rotation.from_rotvec([2.5, -3.0, 2.0], degrees=True)).magnitude()) < 1.0
    assert "about x and y by" in str(motion) and "about x and y by" not in str(level)
    assert Alignment((0, 0, 0), 0.0, 0.9, (0.0, 5.0)).at_limit
