"""`sarsplat doctor`: show the installation."""

import os
import platform
from importlib.util import find_spec
from pathlib import Path

from sarsplat import extras
from sarsplat.cli import console
from sarsplat.errors import SarsplatError
from sarsplat.extras import installed_version


def doctor() -> None:
    """Show installed version, engines, extras and weights, and how to install missing ones."""
    console.facts(f"sarsplat {installed_version('sarsplat') or '(running from source)'}", _core())
    console.facts("engines", {"reference": "plain torch, any dtype", "cpu": _cpu_engine(), "cuda": _cuda_engine()})
    console.facts("extras", {extra: _extra(extra) for extra in extras.EXTRAS})
    console.facts("LPIPS weights", {"found": _lpips_weights()})


def _core() -> dict[str, str]:
    import torch

    return {
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads of {os.cpu_count()} processors",
        **{name: installed_version(name) or "missing" for name in ("numpy", "scipy", "tyro", "rich")},
    }


def _cpu_engine() -> str:
    import torch

    from sarsplat.renderer.engines.cpu import best_instruction_set, torch_pool

    try:
        loaded = f"loaded, instruction set {best_instruction_set()}"
    except SarsplatError as error:
        return str(error)
    if torch_pool() is None:
        return f"{loaded}, on one thread, because PyTorch {torch.__version__} has no torch_parallel_for"
    return f"{loaded}, on the threads of PyTorch"


def _cuda_engine() -> str:
    import torch

    from sarsplat.renderer.engines.cuda_device import require_cuda
    from sarsplat.renderer.engines.nvrtc import Nvrtc
    from sarsplat.renderer.engines.trial import objection

    try:
        require_cuda()
        gpu = f"{torch.cuda.get_device_name()}, compiled at first use by NVRTC {Nvrtc().version}"
    except SarsplatError as error:
        return f"not usable: {error}"
    reason = objection(torch.device("cuda:0"))
    return f"{gpu}; not used unless asked for by name: {reason}" if reason else f"{gpu}; agrees with the CPU engine"


def _extra(extra: str) -> str:
    modules = extras.EXTRAS[extra]
    missing = [name for module, name in modules.items() if find_spec(module) is None]
    if missing:
        return f"missing {', '.join(missing)}; {extras.install_command(extra)}"
    return ", ".join(f"{name} {installed_version(name)}" for name in modules.values())


def _lpips_weights() -> str:
    from sarsplat.evaluation.lpips import WEIGHTS_VARIABLE, Lpips, lpips_weights

    folder: Path | None = lpips_weights(None)
    if folder is None:
        return f"no; set {WEIGHTS_VARIABLE} to their folder or use --lpips-weights (without them LPIPS is skipped)"
    try:
        Lpips(folder)
    except SarsplatError as error:
        return f"no; {error}"
    return f"yes, {folder} (from {WEIGHTS_VARIABLE})"
