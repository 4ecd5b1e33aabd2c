"""The CPU engine against the float64 reference: every output, every gradient, every instruction set.

The reference itself against finite differences, cuts off.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from compared import check_gradients, relative, without_cuts
from named_scenes import GRADCHECK, GRID, MATRIX, VIEWS, Scene, cloud, with_scales

from sarsplat import Gaussians, SarsplatError, radar_frame
from sarsplat.renderer import Footprints, Waves, project, reference, render
from sarsplat.renderer.engines import cpu
from sarsplat.renderer.reference import render_reference, splat_reference

AVAILABLE = cpu.instruction_sets()
OUTPUTS = ("images", "cross_sections", "lit_area", "transmittance", "first_return")
DIFFERENTIABLE = ("images", "cross_sections", "transmittance")
NOTHING_TO_SEE = {"none"}
NO_IMAGE = {"none", "all outside"}


def outputs_of(rendering) -> dict[str, torch.Tensor]:
    """Every output as one tensor; rays of all views one after the other."""
    assert rendering.ray_maps is not None
    found = {name: getattr(rendering, name) for name in OUTPUTS[:3]}
    if rendering.echoes:
        (found["ground"],) = rendering.echoes
    return found | {name: torch.cat([getattr(m, name).flatten() for m in rendering.ray_maps]) for name in OUTPUTS[3:]}


def loss_of(outputs: dict[str, torch.Tensor], norms: dict[str, float]) -> torch.Tensor:
    """Random cotangents on all differentiable outputs at once, each with the same weight."""
    generator = torch.Generator().manual_seed(99)
    total = torch.zeros((), dtype=torch.float64)
    for name in [name for name in DIFFERENTIABLE if name in outputs]:
        cotangent = torch.randn(outputs[name].shape, generator=generator)
        total = total + (outputs[name].double() * cotangent / norms.get(name, 1.0)).sum()
    return total


def everything(scene: Scene, renderer, norms: dict[str, float], of=(*OUTPUTS, "ground"), **options):
    """Outputs of a renderer in float32 and all gradients of such a loss, by name."""
    leaves = scene.leaves(torch.float32)
    outputs = {name: t for name, t in outputs_of(scene.call(renderer, leaves, **options)).items() if name in of}
    gradients = torch.autograd.grad(loss_of(outputs, norms), list(leaves.values()), allow_unused=True)
    return {name: t.detach() for name, t in outputs.items()} | dict(zip(leaves, gradients, strict=True))


@cache
def judged(name: str) -> tuple[Scene, dict[str, torch.Tensor], dict[str, float], dict[str, torch.Tensor], list]:
    """The reference's outputs, their norms and its gradients."""
    scene = MATRIX[name]()
    leaves = scene.leaves(torch.float64)
    rendering = scene.call(render_reference, leaves)
    outputs = outputs_of(rendering)
    norms = {k: float(outputs[k].detach().norm()) or 1.0 for k in DIFFERENTIABLE}
    loss = loss_of(outputs, norms)
    gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)))
    return scene, {k: t.detach() for k, t in outputs.items()}, norms, gradients, list(rendering.ray_maps)


def traced(maps: list, renderer=render):
    """A renderer whose rays must be those of the reference."""

    def rendered(*arguments, **options):
        rendering = renderer(*arguments, **options)
        for mine, theirs in zip(rendering.ray_maps, maps, strict=True):
            assert mine.transmittance.shape == theirs.transmittance.shape
            assert mine.transmittance.numel() == 0 or mine.origin == pytest.approx(theirs.origin)
        return rendering

    return rendered


def check(name: str, found: dict[str, torch.Tensor | None]) -> None:
    """Outputs within 1e-5 and gradients within 1e-4 of the reference's."""
    _, expected, _, expected_gradients, _ = judged(name)
    for output, value in expected.items():
        missing = torch.isnan(value)
        assert torch.equal(torch.isnan(found[output]), missing), output
        assert relative(found[output][~missing], value[~missing]) <= 1e-5, output
        assert name in NO_IMAGE or float(value[~missing].norm()) > 0, output
    for argument, value in expected_gradients.items():
        if value is None or name in NOTHING_TO_SEE:
            assert found[argument] is None or not found[argument].any(), argument
            continue
        assert float(value.norm()) > 0, argument
        assert relative(found[argument], value) <= 1e-4, argument


@pytest.mark.parametrize("instruction_set", AVAILABLE)
@pytest.mark.parametrize("name", MATRIX)
def test_matches_the_reference(name, instruction_set):
    scene, _, norms, _, maps = judged(name)
    check(name, everything(scene, traced(maps), norms, engine=f"cpu-{instruction_set}"))


@pytest.mark.parametrize("name", [name for name in MATRIX if name not in NOTHING_TO_SEE])
def test_no_pair_lies_on_a_cut(name, monkeypatch):
    """Cuts moved by more than float32 can err change nothing: the comparison above never hangs on a rounding."""
    scene, expected, *_ = judged(name)
    slack = {"MIN_RAY_DEPTH": 2e-5, "MIN_TRANSMITTANCE": 1e-5, "IMAGE_CUT": 3e-6}  # 4e-5 of the exponent on both planes
    for way in (-1, 1):
        with monkeypatch.context() as patch, torch.no_grad():
            for cut, share in slack.items():
                patch.setattr(reference, cut, getattr(reference, cut) * (1 + way * share))
            moved = outputs_of(scene.call(render_reference, scene.leaves(torch.float64)))
        for output in DIFFERENTIABLE:
            assert moved[output].shape == expected[output].shape
            # the image's cut is in its norm too: 1 − e⁻⁸ moves by 8e-9
            assert relative(moved[output], expected[output]) <= 1e-8, output


def test_forced_instruction_sets_differ_in_width():
    """Otherwise the matrix would test one build three times."""
    named = [cpu._functions(cpu.INSTRUCTION_SETS.index(name))["name"].decode() for name in AVAILABLE]
    assert named == AVAILABLE


def test_what_is_not_differentiable_says_so():
    scene = MATRIX["overlap"]()
    rendering = scene.call(render, scene.leaves(torch.float32), engine="cpu")
    assert not rendering.lit_area.requires_grad
    assert not rendering.ray_maps[0].first_return.requires_grad
    leaves = scene.leaves(torch.float32)
    images = scene.call(render, leaves, engine="cpu").images
    with pytest.raises(SarsplatError, match="no second derivatives; leave create_graph=True out"):
        torch.autograd.grad((images**2).sum(), [leaves["means"]], create_graph=True)


def test_plane_gradients_add_up_to_those_of_the_means():
    scene = MATRIX["shift and gain"]()
    leaves = scene.leaves(torch.float32)
    rendering = scene.call(render, leaves, engine="cpu", plane_gradients=True)
    assert not rendering.plane_gradients.any()  # until backward
    (rendering.images**2).sum().backward()
    on_rays_x, on_rays_y, on_image_x, on_image_r = rendering.plane_gradients.double().unbind(-1)
    in_radar_frame = torch.stack([on_rays_x + on_image_x, on_rays_y, on_image_r], dim=-1)
    frames = torch.from_numpy(np.stack([radar_frame(view) for view in scene.views]))
    assert relative(leaves["means"].grad, torch.einsum("vni,vij->nj", in_radar_frame, frames)) <= 1e-5
    on_image = torch.stack([on_image_x, on_image_r], dim=-1).sum(1)
    assert relative(leaves["shift"].grad, on_image) <= 1e-5


# ---- gradients that are small beside others: an optimiser like Adam does not see how small they are -----------------
def gradient(gaussians: Gaussians, name: str, dtype: torch.dtype, **engine: str) -> torch.Tensor:
    scene = Scene(gaussians)
    leaves = scene.leaves(dtype)
    rendering = scene.call(render, leaves, **engine)
    loss = rendering.images.square().sum() + rendering.cross_sections.sum()
    return torch.autograd.grad(loss, leaves[name])[0]


def worst(gaussians: Gaussians, name: str, instruction_set: str) -> float:
    """Largest error of an element, relative to that element."""
    expected = gradient(gaussians, name, torch.float64, engine="reference")
    found = gradient(gaussians, name, torch.float32, engine=f"cpu-{instruction_set}")
    assert (expected != 0).all()
    return float(((found - expected) / expected).abs().max())


@pytest.mark.parametrize("instruction_set", AVAILABLE)
def test_the_thin_axis_of_a_disc(instruction_set):
    thin = with_scales(cloud(8, 3, kappa=(0.5, 2.0)), (0.5, 0.4, 2e-4))
    flat = replace(thin, quaternions=torch.tensor([[0.9, 0.3, 0.2, 0.1]]).expand(8, 4).contiguous())
    assert worst(flat, "scales", instruction_set) < 3e-3


@pytest.mark.parametrize("instruction_set", AVAILABLE)
@pytest.mark.parametrize("activation", [-3.0, -10.0, -20.0, -40.0])
def test_harmonics_far_below_the_least_scattering(activation, instruction_set):
    gaussians = cloud(6, 4, degree=0, kappa=(0.5, 2.0))
    faint = gaussians.with_tensors(scattering=torch.full((6, 1), activation / 0.28209479))
    assert worst(faint, "scattering", instruction_set) < 1e-4


@pytest.mark.parametrize("argument", ["means", "quaternions", "scales", "optical_depth", "scattering", "shift", "gain"])
def test_finite_differences_of_the_engine_itself(argument):
    """Independent of the reference; loose, because a gradient holds the cuts constant and a difference moves them."""
    scene = MATRIX["shift and gain"]()
    leaves = scene.leaves(torch.float32)
    tensor = leaves[argument]
    target = 0.5 * scene.call(render, leaves, engine="cpu").images.detach().flip(2)

    def loss(value: torch.Tensor) -> torch.Tensor:
        images = scene.call(render, leaves | {argument: value}, engine="cpu").images
        return ((images - target).double() ** 2).sum()

    (gradient,) = torch.autograd.grad(loss(tensor), [tensor])
    size = {"means": 0.1, "scales": 0.1, "shift": 0.2}.get(argument, 1.0)  # what counts as a large change
    generator = torch.Generator().manual_seed(1)
    for _ in range(4):
        random = torch.randn(tensor.shape, generator=generator) / tensor.numel() ** 0.5
        step = 0.02 * size * (random + gradient / gradient.norm())  # so that the slope is never near zero
        with torch.no_grad():
            difference = float(loss(tensor + step) - loss(tensor - step)) / 2
        assert difference == pytest.approx(float((gradient.double() * step).sum()), rel=0.02)


# ---- gradients of the reference --------------------------------------------------------------------------------------
FEW_SCENES = pytest.mark.parametrize("name", GRADCHECK)


@FEW_SCENES
@without_cuts()
def test_every_argument_of_every_output_of_the_reference(name):
    scene = GRADCHECK[name]()
    leaves = scene.leaves(torch.float64)

    def outputs(*tensors):
        rendering = scene.call(render_reference, dict(zip(leaves, tensors, strict=True)))
        return (rendering.images, rendering.cross_sections, *(m.transmittance for m in rendering.ray_maps))

    check_gradients(outputs, tuple(leaves.values()))


@FEW_SCENES
@without_cuts()
def test_the_scenes_of_these_occlude(name):
    scene = GRADCHECK[name]()
    rendering = scene.call(render_reference, scene.leaves(torch.float64))
    assert min(float(m.transmittance.detach().min()) for m in rendering.ray_maps) < 0.3
    # whoever stands in the shadow of others loses a good part of its lit area
    shares = []
    for i in range(len(scene.gaussians)):
        alone = scene.gaussians[i].to(torch.float64)
        free = render_reference(alone, scene.views, scene.grid, rays=scene.rays).lit_area[:, 0]
        shares.append(float((rendering.lit_area[:, i] / free).min()))
    assert min(shares) < 0.7


@without_cuts()
def test_gradients_of_waves():
    """Phases that turn across footprints, which no rendering of power has."""
    g = torch.Generator().manual_seed(3)
    pixels = project(cloud(3, 3, scale=0.2).to(torch.float64), VIEWS[:2], GRID).pixels
    numbers = torch.tensor([[2.0], [-3.0]], dtype=torch.float64)
    parts, slopes = (torch.randn(2, 3, 2, dtype=torch.float64, generator=g) for _ in range(2))

    def waves(centers, roots, cross_sections, slopes):
        turned = Waves(numbers, slopes)
        return [splat_reference(Footprints(centers, roots), cross_sections, GRID, waves=turned)]

    leaves = pixels.centers, pixels.roots, parts, slopes
    check_gradients(waves, tuple(t.detach().clone().requires_grad_() for t in leaves))
