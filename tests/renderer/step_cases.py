"""Each step of a rendering alone, on the named scenes: an engine's values and gradients against its float64 twin's."""

from collections.abc import Callable
from functools import cache, partial

import torch
from named_scenes import MATRIX
from torch import Tensor

from sarsplat.geometry import RayGrid
from sarsplat.renderer import Footprints, Projection, Waves
from sarsplat.renderer.operations import attenuate_with, project_with, splat_with
from sarsplat.renderer.reference import attenuate_reference, project_reference, splat_reference

Tensors = dict[str, Tensor]
CHANNELS = 3


def tensors_of(p: Projection) -> Tensors:
    """Every tensor of a projection by name."""
    own = {"optical_depth": p.optical_depth, "range_m": p.range_m, "tilt": p.tilt, "amplitudes": p.amplitudes}
    planes = {"rays": p.rays, "pixels": p.pixels}
    return own | {f"{n}.{part}": getattr(plane, part) for n, plane in planes.items() for part in ("centers", "roots")}


def projection_of(tensors: Tensors) -> Projection:
    """The other way round."""
    planes = {n: Footprints(tensors[f"{n}.centers"], tensors[f"{n}.roots"]) for n in ("rays", "pixels")}
    return Projection(**planes, **{n: tensors[n] for n in ("optical_depth", "range_m", "tilt", "amplitudes")})


def _leaves(tensors: Tensors, dtype: torch.dtype) -> Tensors:
    return {name: tensor.detach().to(dtype, copy=True).requires_grad_() for name, tensor in tensors.items()}


def _run(outputs: Tensors, leaves: Tensors, norms: dict[str, float]) -> Tensors:
    """Outputs, and gradients of all that are differentiable under random cotangents of equal weight."""
    generator, loss = torch.Generator().manual_seed(98), torch.zeros((), dtype=torch.float64)
    for name, output in outputs.items():
        if output.requires_grad:
            cotangent = torch.randn(output.shape, generator=generator)
            norm = norms.setdefault(name, float(output.detach().norm()) or 1.0)
            loss = loss + (output.double() * cotangent / norm).sum()
    gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True) if loss.requires_grad else ()
    found = {f"d {name}": g for name, g in zip(leaves, gradients) if g is not None}
    return {name: output.detach() for name, output in outputs.items()} | found


@cache
def _projected(name: str) -> Tensors:
    """The scene's footprints, rounded to the engines' dtype."""
    scene = MATRIX[name]()
    rays = scene.rays or RayGrid.for_image(scene.grid)
    double = scene.gaussians.to(torch.float64)
    p = project_reference(double, scene.views, scene.grid, rays=rays, shift=_double(scene.shift))
    return {key: tensor.float() for key, tensor in tensors_of(p).items()}


def _double(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.double()


def _cross_sections(name: str) -> Tensor:
    views, n = _projected(name)["range_m"].shape
    cross_sections = torch.randn(views, n, CHANNELS, generator=torch.Generator().manual_seed(97))
    cross_sections[:, 1::5] = 0.0  # a dark Gaussian has a gradient all the same
    return cross_sections


def project_case(name: str, dtype: torch.dtype, project: Callable, norms: dict[str, float]) -> Tensors:
    """The step `project` on a scene."""
    scene = MATRIX[name]()
    rays = scene.rays or RayGrid.for_image(scene.grid)
    shift = torch.zeros(len(scene.views), 2) if scene.shift is None else scene.shift
    leaves = _leaves(scene.gaussians.tensors() | {"shift": shift}, dtype)
    gaussians = scene.gaussians.with_tensors(**{k: t for k, t in leaves.items() if k != "shift"})
    p = project(gaussians, scene.views, scene.grid, rays=rays, shift=leaves["shift"])
    return _run(tensors_of(p), leaves, norms)


def attenuate_case(name: str, dtype: torch.dtype, attenuate: Callable, norms: dict[str, float]) -> Tensors:
    """The step `attenuate` on a scene's footprints."""
    scene = MATRIX[name]()
    leaves = _leaves(_projected(name), dtype)
    rays = scene.rays or RayGrid.for_image(scene.grid)
    found = attenuate(projection_of(leaves), rays, first_return_depth=scene.first_return_depth)
    outputs = {"lit_area": found.lit_area}
    for part in ("transmittance", "first_return"):
        outputs[part] = torch.cat([getattr(ray_map, part).flatten() for ray_map in found.ray_maps])
    return _run(outputs, leaves, norms)


def splat_case(name: str, dtype: torch.dtype, splat: Callable, norms: dict[str, float]) -> Tensors:
    """The step `splat` on a scene's footprints, with random cross-sections."""
    scene = MATRIX[name]()
    footprints = {key: t for key, t in _projected(name).items() if key.startswith("pixels.")}
    leaves = _leaves(footprints | {"cross_sections": _cross_sections(name)}, dtype)
    on_pixels = Footprints(leaves["pixels.centers"], leaves["pixels.roots"])
    images = splat(on_pixels, leaves["cross_sections"], scene.grid, imaging_weight=scene.imaging_weight)
    return _run({"images": images}, leaves, norms)


def waves_case(name: str, dtype: torch.dtype, splat: Callable, norms: dict[str, float]) -> Tensors:
    """The step `splat` with phases that turn across footprints, by up to some turns."""
    scene = MATRIX[name]()
    footprints = {key: t for key, t in _projected(name).items() if key.startswith("pixels.")}
    views, n, _ = footprints["pixels.centers"].shape
    generator = torch.Generator().manual_seed(96)
    width = float(footprints["pixels.roots"].median()) ** -1
    slopes = torch.randn(views, n, 2, generator=generator) / width
    numbers = torch.randn(views, CHANNELS, generator=generator)
    parts = torch.randn(views, n, 2 * CHANNELS, generator=generator)
    leaves = _leaves(footprints | {"cross_sections": parts, "slopes": slopes}, dtype)
    on_pixels, waves = (
        Footprints(leaves["pixels.centers"], leaves["pixels.roots"]),
        Waves(numbers.to(dtype), leaves["slopes"]),
    )
    images = splat(on_pixels, leaves["cross_sections"], scene.grid, waves=waves, imaging_weight=scene.imaging_weight)
    return _run({"images": images}, leaves, norms)


STEPS: dict[str, tuple[Callable, Callable, Callable]] = {
    "project": (project_case, project_reference, project_with),
    "attenuate": (attenuate_case, attenuate_reference, attenuate_with),
    "splat": (splat_case, splat_reference, splat_with),
    "waves": (waves_case, splat_reference, splat_with),
}


@cache
def judged(step: str, name: str) -> tuple[Tensors, dict[str, float]]:
    """The twin's outputs and gradients in float64, and the norms of its outputs."""
    case, twin, _ = STEPS[step]
    norms: dict[str, float] = {}
    return case(name, torch.float64, twin, norms), norms


def found_by(new_pass: Callable, step: str, name: str) -> Tensors:
    """An engine's outputs and gradients."""
    case, _, on_engine = STEPS[step]
    return case(name, torch.float32, partial(on_engine, new_pass), dict(judged(step, name)[1]))


def check(step: str, name: str, found: Tensors) -> None:
    """Outputs agree to 1e-5 and gradients to 1e-4 with the twin's, in the Euclidean norm."""
    expected, _ = judged(step, name)
    assert set(expected) <= set(found)
    for key, value in expected.items():
        missing = torch.isnan(value)
        assert torch.equal(torch.isnan(found[key]), missing), key
        difference = float((found[key].double() - value)[~missing].norm())
        tolerance = 1e-4 if key.startswith("d ") else 1e-5
        assert difference <= tolerance * float(value[~missing].norm()), key
    for key in set(found) - set(expected):  # what the twin does not depend on at all
        assert not found[key].any(), key
