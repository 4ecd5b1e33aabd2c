"""Trial of the CUDA engine on a GPU: a small scene and its gradients, compared with the CPU engine."""

import hashlib
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Harmonics
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.engines import cpu, cuda, nvrtc
from sarsplat.renderer.engines.cuda_device import Device, device, require_cuda
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.engines.stages import Render

_LARGEST_ERROR = 2e-5  # maximum relative difference in the Euclidean norm; the emulated engine has 6e-7

_VIEWS = (View(20.0, 30.0), View(140.0, 50.0))
_GRID = ImageGrid(40, 56, (0.3, 0.25), (0.4, 0.3))


@cache
def objection(where: torch.device) -> str:
    """Return the reason not to use the CUDA engine on a device; "" if it agrees with the CPU engine.

    The result is cached on disk until the GPU, its driver or the engine changes; failures to compare, such as a missing
    compiler or insufficient memory, are not cached.
    """
    try:
        require_cuda()
        gpu = device(where.index or 0)
    except SarsplatError as error:
        return str(error)
    plan = [path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("cuda*.py"))]
    engine = repr((gpu.description, [*nvrtc.sources().values(), *plan]))
    name = f"trial-{hashlib.sha256(engine.encode()).hexdigest()[:32]}"
    if (verdict := nvrtc.read_cached(name)) is None:
        try:
            verdict = _disagreement(gpu).encode()
        except (SarsplatError, torch.OutOfMemoryError) as error:  # another program may be using the GPU's memory
            return f"it could not be tried ({_first_line(error)})"
        nvrtc.write_cached(name, verdict)
    return verdict.decode()


def _disagreement(launcher: Device) -> str:
    expected = _rendered(partial(cpu.Pass, "auto"), torch.device("cpu"))
    try:
        computed = _rendered(partial(cuda.Pass, launcher), launcher.device)
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:
        return f"it failed when it was tried ({_first_line(error)})"
    for name, value in expected.items():
        difference = float((computed[name] - value).norm() / value.norm())
        if not difference <= _LARGEST_ERROR:  # also of NaN
            return f"its {name} differ from the CPU engine's by a part of {difference:.2g}"
    return ""


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


@torch.inference_mode(False)
@torch.enable_grad()
def _rendered(new_pass: NewPass, where: torch.device) -> dict[str, Tensor]:
    """Return outputs and gradients by name, of several tiles and more Gaussians than a block has threads."""
    n, views = 300, len(_VIEWS)
    shapes = {"means": (n, 3), "quaternions": (n, 4), "scales": (n, 3), "optical_depth": (n,), "harmonics": (n, 4)}
    shapes |= {"amplitudes": (views, n, 5), "shift": (views, 2)}
    draw = partial(torch.rand, generator=torch.Generator().manual_seed(1), dtype=torch.float32, device="cpu")
    leaves = {name: draw(shape).to(where).requires_grad_() for name, shape in shapes.items()}
    law = Harmonics(leaves["harmonics"])
    gaussians = (
        10.0 * (leaves["means"] - 0.5),
        leaves["quaternions"] - 0.5,
        0.05 + 0.4 * leaves["scales"],
        0.01 + 2.0 * leaves["optical_depth"],
    )
    results: dict[str, Tensor] = {}
    loss = torch.zeros((), dtype=torch.float32, device=where)
    for title, amplitudes in (("harmonics", None), ("five channels", leaves["amplitudes"])):
        call = Render(new_pass(), _VIEWS, _GRID, RayGrid.for_image(_GRID), law.p_min)
        harmonics = law.parameters if amplitudes is None else None
        images, cross_sections, *_ = call.of(*gaussians, harmonics, amplitudes, leaves["shift"])
        for output in (images, cross_sections):
            loss = loss + (output * (draw(output.shape) - 0.5).to(where)).sum() / output.detach().norm()
        results |= {f"images of {title}": images, f"cross-sections of {title}": cross_sections}
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    results |= {f"gradients of {name}": gradient for name, gradient in zip(leaves, gradients, strict=True)}
    return {name: tensor.detach().cpu() for name, tensor in results.items()}
