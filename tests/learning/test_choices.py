"""Choices by trying: the quicker device, and settings by evidence."""

import re
import time
import warnings
from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from made import boxes, dataset_of
from sarsplat import PRESETS, Dataset, ImageGrid, Run, SarsplatError, View, reconstruct, render
from sarsplat.learning import evidence, scene_frame
from sarsplat.learning.device_choice import quicker_device
from sarsplat.learning.evidence import chosen, differences
from sarsplat.learning.method_sar_gs import METHOD
from sarsplat.renderer.engines import cpu
from sarsplat.runs import reconstruction
from sarsplat.scenes import add_speckle
from sarsplat.scenes.simulate import simulate_images

GPU = torch.device("cuda", 0)


class Taking:
    """A training whose steps take so many seconds, or fail."""

    def __init__(self, seconds: float | None) -> None:
        self.seconds, self.steps = seconds, 0
        warnings.warn("as ever", UserWarning, stacklevel=1)

    def step(self) -> None:
        if self.seconds is None:
            raise SarsplatError("the memory of cuda:0 is not enough\nfor it")
        self.steps += 1
        time.sleep(self.seconds)

    def check(self) -> None:
        pass


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("on_gpu", "on_cpu", "chosen", "words"),
    [
        (0.001, 0.02, "cuda", ""),
        (0.02, 0.001, "cpu", r"a step takes 1\..* ms there, and 2.*; device cuda takes the GPU nevertheless"),
        (None, 0.001, "cpu", "on the GPU, the memory of cuda:0 is not enough"),
        (0.001, None, "cuda", ""),
    ],
)
def test_the_quicker_one(on_gpu: float | None, on_cpu: float | None, chosen: str, words: str) -> None:
    """A device on which a step fails is not taken, and the slower one is not waited for."""
    made: dict[str, Taking] = {}

    def make(where: torch.device) -> Taking:
        return made.setdefault(where.type, Taking(on_gpu if where == GPU else on_cpu))

    where, said = quicker_device(make, GPU, 1000)  # type: ignore[arg-type]
    assert where.type == chosen
    assert re.fullmatch(f"training on the CPU: {words}" if words else "", said)
    if on_gpu is not None:
        assert [*made] == ["cuda", "cpu"]
    if chosen == "cuda":
        assert made["cpu"].steps < 5


def test_what_is_said_once_of_the_cpu_engine_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu, "torch_pool", lambda: None)
    monkeypatch.setattr(cpu, "library", cache(cpu.library.__wrapped__))
    with pytest.warns(UserWarning, match="runs on one thread"):
        quicker_device(lambda _: Taking(0.001), GPU, 1000)  # type: ignore[arg-type, return-value]
    monkeypatch.undo()
    cpu.library.cache_clear()
    cpu.library()  # with torch's threads again


def test_a_reconstruction_says_so(
    dataset: Dataset, config, tmp_path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    named, asked = reconstruction.device_named, []
    monkeypatch.setattr(reconstruction, "device_named", lambda name: GPU if name == "auto" else named(name))
    monkeypatch.setattr(
        reconstruction,
        "quicker_device",
        lambda make, gpu, _: asked.append(gpu) or (torch.device("cpu"), "on the CPU: said"),
    )
    run = reconstruct(dataset, config, tmp_path / "run", on_step=lambda step: step.iteration == 21)
    assert "on the CPU: said" in capsys.readouterr().out
    assert (asked, run.trained_on, Run.load(tmp_path / "run").trained_on) == ([GPU], "cpu", "cpu")
    reconstruct(dataset, config, tmp_path / "run", resume=True)  # on the CPU again, without a question
    assert len(asked) == 1


def test_a_loss_of_ones_own_is_on_the_gpu_untried(dataset: Dataset, config, monkeypatch: pytest.MonkeyPatch) -> None:
    class ReachedError(Exception):
        pass

    def trainer(self: object, dataset: object, config: object, inputs: object, device: object, begun: object) -> None:
        assert device == GPU
        raise ReachedError

    monkeypatch.setattr(reconstruction, "device_named", lambda name: GPU)
    monkeypatch.setattr(reconstruction, "quicker_device", lambda *_: pytest.fail("is tried"))
    monkeypatch.setattr(type(METHOD), "trainer", trainer)
    with pytest.raises(ReachedError):
        reconstruct(dataset, replace(config, iterations=1000), loss=lambda a, b: (a - b).abs().mean())
    assert quicker_device(lambda where: pytest.fail("is tried"), GPU, 100) == (GPU, "")  # nor are few iterations


# ---- settings: images with gains of their own are measured ones, others are a scene ----------------------------------
GRID = ImageGrid(56, 56, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (35.0, 50.0)]
GAIN_DB = 2.0


@pytest.fixture(scope="module")
def scene() -> Dataset:
    """A box on speckled ground."""
    pytest.importorskip("embreex")
    mesh = boxes(((4.0, 2.5, 1.5), (0.5, 0, 0.75)))
    power = simulate_images(mesh, VIEWS, GRID, ground_gamma0=0.05, ray_spacing=0.05)
    power = add_speckle(power, 1, np.random.default_rng(0))
    return dataset_of(GRID, [(view, "train") for view in VIEWS], power, looks=1.0, ground=True)


def gained(scene: Dataset) -> Dataset:
    signs = np.random.default_rng(3).permutation([-1, 1] * (len(scene) // 2))
    gains = 10 ** (GAIN_DB * signs / 10)
    return replace(scene, power=(scene.power * gains[:, None, None]).astype(np.float32))


def test_images_of_one_scale_and_place_need_no_nuisances_at_any_scale_of_all(scene: Dataset) -> None:
    config = METHOD.preset("auto", scene)
    assert replace(config, evidence="") == PRESETS["scene"]
    assert "0 of 16 images displaced; too little, so neither gains nor shifts are learned" in config.evidence
    assert chosen(replace(scene, entries=scene.entries[:3], power=scene.power[:3])).preset == "scene"  # by no trial
    louder = replace(scene, power=1024 * scene.power)  # without rounding, which changes digits of the evidence
    assert chosen(louder) == config


def test_large_scenes_have_settings_of_their_own(scene: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_frame, "_MIN_ACROSS", 3)  # so that the box is large
    for images, around in ((16, True), (6, False)):
        part = replace(scene, entries=scene.entries[:images], power=scene.power[:images])
        assert cast(Any, chosen(part).ground).from_images is around
    of = [cast(Any, chosen(images).surroundings) for images in (scene, gained(scene))]
    assert [(one.gain_std > 0, one.speckle_floor) for one in of] == [(False, 0.01), (True, 0.01)]


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


def test_a_small_target_in_large_images_is_still_small(scene: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "_PIXELS", 28)  # so that the trial sees multilooked images
    assert replace(chosen(scene), evidence="") == PRESETS["scene"]
    assert chosen(gained(scene)).preset == "measured"


@pytest.mark.parametrize("name", ["scene", "speckled"])
def test_points_and_their_gamma0_follow_the_scale_of_all_images(scene: Dataset, name: str) -> None:
    # so few steps that the rounding of the scale, which grows from step to step, changes few points
    short = replace(PRESETS[name], iterations=4, points=replace(PRESETS[name].points, voxel=0.1, rays_per_pixel=4.0))
    quiet, loud = (
        reconstruct(replace(scene, power=scale * scene.power), short, quiet=True).reconstruction
        for scale in (np.float32(1), np.float32(1000))
    )
    points = quiet.points()
    assert len(points) > 100
    assert len(loud.points()) == pytest.approx(len(points), rel=0.05)
    assert np.median(loud.gamma0_at(points)) == pytest.approx(1000 * np.median(quiet.gamma0_at(points)), rel=0.05)


def test_gaussians_have_the_gamma0_of_the_images(scene: Dataset) -> None:
    """Also where the training had another unit."""
    run = reconstruct(replace(scene, power=1000 * scene.power), replace(PRESETS["speckled"], iterations=10), quiet=True)
    assert run.gaussians is not None and run.snapshot.unit > 10
    expected = run.render(scene.views[:2])
    images = render(run.gaussians, scene.views[:2], scene.grid).images[:, 0]
    np.testing.assert_allclose(images.numpy(), expected, rtol=0.05, atol=1e-3 * float(expected.max()))
