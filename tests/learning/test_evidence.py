"""Settings chosen by evidence: images with gains of their own are measured ones, others are a scene."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from made import dataset_of
from sarsplat import Dataset, ImageGrid, View, reconstruct
from sarsplat.learning import evidence
from sarsplat.learning.evidence import chosen, differences
from sarsplat.learning.method_sar_gs import METHOD
from sarsplat.scenes.simulate import simulate_images
from sarsplat.settings.presets import PRESETS

GRID = ImageGrid(56, 56, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (35.0, 50.0)]
GAIN_DB = 2.0


@pytest.fixture(scope="module")
def scene() -> Dataset:
    """A box on speckled ground."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    mesh = trimesh.creation.box((4.0, 2.5, 1.5))
    mesh.apply_translation([0.5, 0, 0.75])
    power = simulate_images(mesh, VIEWS, GRID, ground_gamma0=0.05, looks=1, ray_spacing=0.05)
    return dataset_of(GRID, [(view, "train") for view in VIEWS], power, looks=1.0, ground=True)


def gained(scene: Dataset) -> Dataset:
    signs = np.random.default_rng(3).permutation([-1, 1] * (len(scene) // 2))
    gains = 10 ** (GAIN_DB * signs / 10)
    return replace(scene, power=(scene.power * gains[:, None, None]).astype(np.float32))


def test_images_of_one_scale_and_place_need_no_nuisances(scene: Dataset) -> None:
    config = chosen(scene)
    assert replace(config, evidence="") == PRESETS["scene"]
    assert "0 of 16 images displaced; too little, so neither gains nor shifts are learned" in config.evidence
    assert METHOD.preset("auto", scene) == config


def test_chips_with_gains_of_their_own_are_measured_ones(scene: Dataset) -> None:
    config = chosen(gained(scene))
    assert replace(config, evidence="") == PRESETS["measured"]
    told_db = float(config.evidence.split("differ by ")[1].split()[0])
    assert told_db == pytest.approx(GAIN_DB, rel=0.3)


class Rendered:
    """In place of a trial: what images without speckle show."""

    def __init__(self, power: np.ndarray) -> None:
        self.images = dict(zip(VIEWS, power, strict=True))

    def rendered(self, views: list[View]) -> np.ndarray:
        return np.stack([self.images[view] for view in views])


@pytest.mark.parametrize(
    ("gain_db", "rolls", "displaced", "needed"),
    [
        (0.15, [0, 0, 0, 0], 0, False),
        (0.5, [0, 0, 0, 0], 0, True),
        (0.0, [1, 1, 1, 1], 0, False),
        (0.0, [0, 0, 0, 1], 4, False),
        (0.0, [0, 1, -1, 1], 12, True),
    ],
)
def test_gains_count_from_a_quarter_decibel_and_displacements_that_images_do_not_share(
    scene: Dataset, gain_db: float, rolls: list[int], displaced: int, needed: bool
) -> None:
    signs = np.random.default_rng(3).permutation([-1, 1] * 8)
    clean = gaussian_filter(scene.power.astype(float), (0, 1.5, 1.5))
    images = [
        10 ** (gain_db * k / 10) * np.roll(image, roll, 0)
        for image, k, roll in zip(clean, signs, 4 * rolls, strict=True)
    ]
    found = differences(replace(scene, power=np.array(images, np.float32)), cast(Any, Rendered(clean)))
    assert found.displaced == displaced and (found.nats < 0) == needed


def test_the_scale_of_all_images_changes_no_choice(scene: Dataset) -> None:
    louder = replace(scene, power=1000 * scene.power)
    assert chosen(louder).evidence == chosen(scene).evidence


def test_a_small_target_in_large_images_is_still_small(scene: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "_PIXELS", 28)  # so that the trial sees multilooked images
    assert replace(chosen(scene), evidence="") == PRESETS["scene"]
    assert chosen(gained(scene)).preset == "measured"


def test_points_and_their_gamma0_follow_the_scale_of_all_images(scene: Dataset) -> None:
    short = replace(PRESETS["scene"], iterations=30, points=replace(PRESETS["scene"].points, voxel=0.3))
    quiet, loud = (
        reconstruct(replace(scene, power=scale * scene.power), short, quiet=True).reconstruction
        for scale in (np.float32(1), np.float32(1024))
    )
    points = quiet.points()
    assert len(points) > 100
    assert len(loud.points()) == pytest.approx(len(points), rel=0.02)
    assert np.median(loud.gamma0_at(points)) == pytest.approx(1024 * np.median(quiet.gamma0_at(points)), rel=0.05)


def test_too_few_images_are_a_scene(scene: Dataset) -> None:
    few = replace(scene, entries=scene.entries[:3], power=scene.power[:3])
    assert chosen(few).preset == "scene"
