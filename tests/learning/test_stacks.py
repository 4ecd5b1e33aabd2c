"""Reconstruction from interferometric stacks: heights in layover, the same bits again, and what is refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from made import small_dataset
from sarsplat import Run, ScatteringLaw, Stack, View, evaluate_run, reconstruct, render_covariances, simulate_stack
from sarsplat.data import Dataset, DatasetEntry, read_dataset, write_dataset
from sarsplat.errors import SarsplatError
from sarsplat.examination.plausible import suspicions
from sarsplat.geometry import ImageGrid
from sarsplat.learning.model import SceneModel
from sarsplat.learning.strategies import Strategy
from sarsplat.regions.stack_region import stack_region
from sarsplat.settings import PRESETS, Config, preset
from sarsplat.settings.sections import FlatGround, Surroundings

GRID = ImageGrid(28, 20, (0.5, 0.5), (0.6, 0.6))
VIEW = View(0.0, 45.0)
NOISE = 0.05
OFFSETS = tuple(0.0052 * (k / 5 - 0.5) for k in range(6))  # 3 m of resolution in elevation
LAW = ScatteringLaw(floor=1.0, lobe=0.0, exponent=1.0)
FEW = replace(preset("speckled"), iterations=1, fewest_gaussians=10)


def block(height: float) -> trimesh.Trimesh:
    return trimesh.creation.box((4.0, 6.0, height)).apply_translation((0.0, 0.0, height / 2))


@cache
def dataset(noise: bool = True, views: tuple[View, ...] = (VIEW,)) -> Dataset:
    stack = Stack(0.031, OFFSETS, noise=(NOISE,) * len(OFFSETS))
    signals = [
        simulate_stack(block(5.0), view, GRID, stack, LAW, ground_gamma0=0.5, noise=NOISE, seed=k)
        for k, view in enumerate(views)
    ]
    stack = stack if noise else replace(stack, noise=None)
    entries = tuple(DatasetEntry(view, "train", f"{k}", stack=stack) for k, view in enumerate(views))
    return Dataset.of_complex(GRID, entries, np.stack(signals), looks=1.0, ground=True, target="block")


@pytest.fixture(scope="module")
def stacks(tmp_path_factory) -> Dataset:
    return write_dataset(tmp_path_factory.mktemp("stacks") / "data", dataset(), truth_mesh=block(5.0))


@pytest.fixture(scope="module")
def run(stacks, tmp_path_factory) -> Run:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "stack", replace(preset("stack"), iterations=180))
        return reconstruct(stacks, out=tmp_path_factory.mktemp("run") / "run", quiet=True)


def test_a_dataset_of_stacks_is_read_as_written(stacks):
    read = read_dataset(stacks.path)
    assert read.fingerprint() == stacks.fingerprint()
    assert (read.passes, read.stacks) == (6, stacks.stacks)
    assert np.array_equal(read.signal, stacks.signal)
    np.testing.assert_allclose(read.power, (np.abs(stacks.signal) ** 2).mean(1), rtol=1e-5)


def test_heights_are_those_of_roof_and_ground(run):
    """Roof, wall and ground share pixels; single looks at 10 dB."""
    assert run.config.preset == "stack"
    scores = evaluate_run(run, quiet=True)
    own, capon = scores["points"]["visible"], scores["capon"]["visible"]
    assert own["f1@0.6"] > 0.95
    assert own["f1@0.4"] > capon["f1@0.4"]
    assert roof_m(run) == pytest.approx(5.0, abs=0.25)


def roof_m(run: Run) -> float:
    """Median height of the points in the middle of the roof."""
    roof = run.points[(np.abs(run.points[:, :2]) < (1.5, 2.5)).all(1) & (run.points[:, 2] > 3.5)]
    return float(np.median(roof[:, 2]))


def test_a_run_renders_its_covariances_with_noise(run, stacks):
    found = run.render_covariances(stacks.views, stacks.stacks)
    assert found.shape == (1, 6, 6, GRID.rows, GRID.columns)
    np.testing.assert_allclose(found[:, 2, 2].real, run.render(stacks.views), rtol=0.03, atol=0.002)
    without = run.snapshot.unit * render_covariances(run.gaussians, [VIEW], GRID, stacks.stacks[0]).numpy()
    noise = (found - without)[0].mean((2, 3))
    np.testing.assert_allclose(noise, NOISE * np.eye(6), atol=5e-3)
    measured = stacks.signal[0, 4] * stacks.signal[0, 3].conj()
    assert abs(np.angle((measured * found[0, 4, 3].conj()).sum())) < 0.3
    other = run.render_covariances([View(20.0, 40.0)] * 2, Stack(0.031, (0.0, 0.001)), ImageGrid(9, 8, (1, 1), (1, 1)))
    assert other.shape == (2, 2, 2, 9, 8)
    with pytest.raises(SarsplatError, match=r"2 stacks of .* passes for 1 view"):
        run.render_covariances([VIEW], [stacks.stacks[0]] * 2)


@pytest.mark.filterwarnings("ignore:there is one training view")
def test_a_run_of_power_alone_has_no_covariances(stacks):
    alone = reconstruct(stacks, FEW, quiet=True)
    with pytest.raises(SarsplatError, match="has not learned phases, so it has no covariances"):
        alone.render_covariances([VIEW], stacks.stacks)
    own = Run.from_gaussians(alone.gaussians, GRID)
    np.testing.assert_allclose(
        own.render_covariances([VIEW], stacks.stacks)[:, 0, 0].real, own.render([VIEW]), rtol=5e-3, atol=1e-4
    )


def test_centres_move_in_elevation_alone(run, stacks):
    still = replace(run.config, relocation=replace(run.config.relocation, rounds=0))
    started, moved = (
        reconstruct(stacks, replace(still, iterations=count), quiet=True).gaussians.means for count in (1, 40)
    )
    plane = torch.tensor([[0.0, -1.0, 0.0], [-(0.5**0.5), 0.0, -(0.5**0.5)]])  # azimuth and range
    aside = ((moved - started) @ plane.T).abs().amax(1)
    assert float((aside > 1e-4).float().mean()) < 0.02  # those that the region's edges stop
    assert float((moved - started).abs().max()) > 0.3


def test_heights_are_found_without_known_noise():
    """It is learned with them: low, for single looks can be explained by Gaussians as well."""
    learned = reconstruct(dataset(noise=False), replace(preset("stack"), iterations=80, gaussians=1500), quiet=True)
    noise = learned.snapshot.tensors["model/pass_noise"].exp() * learned.snapshot.unit
    assert noise.shape == (1, 6)
    assert bool((noise < NOISE).all())
    assert roof_m(learned) == pytest.approx(5.0, abs=0.3)


@pytest.mark.filterwarnings("error")
def test_two_headings_share_a_scene():
    """Both are learned from, and nothing is warned of: phases determine the shape."""
    images = dataset(views=(VIEW, View(180.0, 45.0)))
    both = reconstruct(images, replace(preset("stack"), iterations=40, gaussians=1500), quiet=True)
    assert both.history[-1].loss < both.history[0].loss - 3
    for view in both.snapshot.views:  # each wall is seen by one of them
        wall = both.points @ view.direction
        assert ((np.abs(both.points[:, 2] - 2.5) < 1.5) & (wall > 1.0)).any()


class Watching(Strategy):
    name = "watching"

    def wants_plane_gradients(self, step: int) -> bool:
        return True

    def step_post_backward(self, *_: Any) -> None:
        return


def test_images_that_are_no_stacks_are_none():
    images = dataset()
    entries = (*images.entries, replace(images.entries[0], stack=None))
    with pytest.raises(SarsplatError, match="some images are of 0 passes and others of 6"):
        Dataset.of_complex(GRID, entries, np.repeat(images.signal, 2, axis=0))
    with pytest.raises(SarsplatError, match=r"must be complex64 \(1, 6, 28, 20\); make it with of_complex"):
        Dataset(GRID, images.entries, images.power, signal=images.signal[:, 0])


def test_a_box_higher_than_an_ambiguity_a_wavelength_in_millimetres_and_noise_in_another_unit_are_warned_of():
    images = dataset()
    assert not suspicions(images)
    high = replace(images, target_box_m=((-5.0, -5.0, 0.0), (5.0, 5.0, 40.0)))
    assert any("repeat every 10.5 m of height, and the target's box is 40 m high" in text for text in suspicions(high))
    for changes, words in (
        ({"wavelength_m": 31.0}, "resolve elevations of 2.98e.03 m at best, and images show 14 m, .* wavelength, 31 m"),
        ({"noise": (100.0,) * 6}, "the stack 0 states noise of 100 and has a mean power of 0"),
    ):
        stacks = replace(images.stacks[0], **changes)
        odd = suspicions(replace(images, entries=(replace(images.entries[0], stack=stacks),)))
        assert len(odd) == 1 and re.search(words, odd[0]), odd


@pytest.mark.filterwarnings("ignore:there is one training view")
def test_polarisations_may_be_learned_from_by_power_alone():
    images = dataset()
    pair = Stack(0.031, (0.0, 0.0), polarisations=("HH", "VV"))
    entries = (replace(images.entries[0], stack=pair),)
    polarimetric = Dataset.of_complex(GRID, entries, images.signal[:, :2], looks=1.0)
    with pytest.raises(SarsplatError, match=r"equal in all polarisations, but .* has HH, VV"):
        reconstruct(polarimetric, "stack", quiet=True)
    learned = reconstruct(polarimetric, FEW, quiet=True)
    assert learned.snapshot.stacks == ()
    with pytest.raises(SarsplatError, match="polarisations HH, VV, and the Gaussians' scattering has one alone"):
        render_covariances(learned.gaussians, [VIEW], GRID, pair)


def test_without_a_box_all_that_images_show_is_looked_at_wherever_they_lie():
    moved, images = replace(GRID, center_m=(40.0, -30.0)), dataset()
    far = Dataset.of_complex(moved, images.entries, images.signal, looks=1.0)
    region = stack_region(far)
    corners = np.array([[x, y, 0.0] for x in (moved.extent_m[:2]) for y in (moved.extent_m[2:])])
    ground = np.column_stack([-corners[:, 1] / 0.5**0.5, -corners[:, 0], corners[:, 2]])  # φ = 0: ranges at z = 0
    inside = ground * (1 - 1e-6) + ground.mean(0) * 1e-6
    assert (inside @ region.normals.T <= region.offsets).all()


def test_stacks_that_do_not_fit_into_memory(monkeypatch):
    monkeypatch.setattr("sarsplat.memory.free_bytes", lambda: 1e5)
    with pytest.raises(SarsplatError, match=r"learning from these stacks takes about .* GiB .* fewer passes"):
        reconstruct(dataset(), quiet=True)


def of_stacks(*stacks: Stack) -> Dataset:
    """Noise, the same direction for each of the stacks."""
    signal = (np.random.default_rng(0).standard_normal((len(stacks), 2, 24, 20, 2)) @ [1, 1j]).astype(np.complex64)
    entries = tuple(DatasetEntry(View(90.0 * k, 45.0), "train", f"v{k}", stack=one) for k, one in enumerate(stacks))
    return Dataset.of_complex(ImageGrid(24, 20, (0.5, 0.5), (0.6, 0.6)), entries, signal, looks=1.0, ground=True)


def of_two(**fields: object) -> Dataset:
    """Two passes of 24 × 20 pixels."""
    return of_stacks(Stack(0.031, (0.0, 0.001), **fields))


PAIRS = [Stack(0.24, (0.0, 0.0), polarisations=("HH", other)) for other in ("VV", "HV")]
PASSES = preset("stack").passes


def changed(**settings: object) -> dict[str, Config]:
    return {"preset": replace(preset("stack"), **settings)}


AWAY = ((100.0, 100.0, 0.0), (110.0, 110.0, 5.0))


@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        *(
            (dataset, changed(**changes), f"{next(iter(changes))} is .*, which cannot be combined with passes on")
            for changes in ({"coarsest": 8}, {"tiles": 2}, {"ground": FlatGround()}, {"surroundings": Surroundings()})
        ),
        (lambda: replace(dataset(), target_box_m=AWAY), {}, "no training image shows the box"),
        (lambda: of_stacks(*PAIRS), {}, r"v0 has the polarisations HH, VV and v1 has HH, HV; give all views"),
        (partial(of_two, noise=(1e-7, 0.1)), {}, r"v0 states noise of 1e-07 where .* state at least .*, or none"),
        (of_two, changed(passes=replace(PASSES, window=25)), "passes.window is 25, more than the 24 × 20 pixels of"),
        (of_two, changed(passes=None), "the loss passes needs passes on"),
        (dataset, {"loss": lambda a, b: a.mean()}, "loss is .*, which cannot be combined with passes on; give"),
        (dataset, {"strategies": [Watching()]}, "plane gradients, which cannot be combined with passes on; omit it"),
        (small_dataset, {"preset": "stack"}, r"passes is on .preset stack., .* has single images; give passes off"),
    ],
)
def test_refusals(images: Callable[[], Dataset], options: dict[str, Any], message: str):
    with pytest.raises(SarsplatError, match=message):
        reconstruct(images(), **options, quiet=True)


# ---- phases that atmosphere adds, learned beside the scene -----------------------------------------------------------
def screened(constants: np.ndarray, slopes: np.ndarray) -> Dataset:
    """A block's stack, with phases that are constant and those that rise from the near to the far edge, rad."""
    clear = dataset()
    down = np.linspace(-1, 1, GRID.rows)[:, None]
    turned = np.exp(1j * (constants[:, None, None] + slopes[:, None, None] * down))
    return Dataset.of_complex(GRID, clear.entries, clear.signal * turned, looks=1.0, ground=True, target="block")


def without_heights(phases: np.ndarray) -> np.ndarray:
    """What is left of the phases of passes when heights have explained what they can."""
    numbers = np.stack([dataset().stacks[0].elevation_numbers(VIEW), np.ones(len(phases))], axis=1)
    return phases - numbers @ np.linalg.lstsq(numbers, phases, rcond=None)[0]


def test_screens_are_found():
    constants = np.array([0.0, 0.9, -0.7, 0.5, -0.9, 0.3])
    slopes = np.array([0.0, 0.3, -0.4, 0.4, 0.0, -0.3])
    data = screened(constants, slopes)
    config = replace(preset("stack"), iterations=80, gaussians=1500)
    learned = reconstruct(data, replace(config, passes=replace(config.passes, screen_std=0.7)), quiet=True)
    found = learned.snapshot.tensors["model/phase_screen"].numpy().reshape(6, 3)
    assert np.abs(without_heights(found[:, 0]) - without_heights(constants)).max() < 0.2
    assert np.abs(without_heights(found[:, 2]) - without_heights(slopes)).max() < 0.25
    assert np.abs(without_heights(found[:, 1])).max() < 0.2
    untold = reconstruct(data, config, quiet=True)
    assert "model/phase_screen" not in untold.snapshot.tensors
    assert learned.history[-1].loss < untold.history[-1].loss - 0.3


def test_gradients_and_unseen_images():
    data, config = screened(np.zeros(6), np.zeros(6)), preset("stack")
    config = replace(config, gaussians=60, passes=replace(config.passes, screen_std=0.7))
    model = SceneModel.initial(config, data, torch.Generator().manual_seed(0))
    screen = model.parameters["phase_screen"]
    with torch.no_grad():
        screen += 0.3 * torch.randn(screen.shape, generator=torch.Generator().manual_seed(1))
    (part,) = [part for part in model.parts if type(part).__name__ == "PhaseScreen"]
    shot = model.shot([VIEW], GRID, torch.tensor([0]))
    double = screen.detach().double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: part.phases(shot, {"phase_screen": p}), double, fast_mode=True)
    constant, along, away = screen.detach()[0].unflatten(0, (-1, 3)).unbind(-1)
    phases = part.phases(shot, {"phase_screen": screen.detach()})[0]
    torch.testing.assert_close(phases[:, 0, -1], constant + along - away)  # near range is row 0
    torch.testing.assert_close(phases.mean((1, 2)), constant, atol=1e-5, rtol=0)
    assert part.phases(model.shot([VIEW], GRID), {"phase_screen": double}) is None
