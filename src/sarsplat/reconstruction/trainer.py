"""Training: from a dataset to a run, step by step, resumable bit for bit."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from sarsplat.data import Dataset, new_folder, save_checkpoint, write_bytes
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import only_writer
from sarsplat.data.plausible import suspicions, warn
from sarsplat.errors import SarsplatError
from sarsplat.geometry import RayGrid
from sarsplat.progress import Reporter, progress
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.density import DensityControl
from sarsplat.reconstruction.interrupt import interrupts_held_back
from sarsplat.reconstruction.losses import amplitude_loss, speckle_loss
from sarsplat.reconstruction.model import PER_GAUSSIAN, SceneModel
from sarsplat.reconstruction.optimiser import Optimiser
from sarsplat.reconstruction.run import HEADER, Run, require_replaceable

_LINES_PER_RUN = 200
"""About how many lines `metrics.jsonl` gets."""

_CHECKPOINTS_KEPT = 2

_FAINTEST = 1e-30
"""Largest β⁰ below which images count as black: squares and reciprocals of it would leave float32."""


class Trainer:
    """The state of a training and how it advances by one step.

    Parameters
    ----------
    dataset : Dataset
        Its training images are learned from.
    config : Config
        How.
    device : torch.device or str
        Where everything is computed and stays; a seed starts alike on every device.

    Raises
    ------
    SarsplatError
        If the training images are black.
    """

    def __init__(self, dataset: Dataset, config: Config, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.device = torch.device(device)
        self.grid = dataset.grid
        self.views = [item.view for item in dataset.select("train")]
        power = torch.from_numpy(dataset.images("train"))
        if not float(power.max()) > _FAINTEST:
            raise SarsplatError(
                f"the training images of {dataset.path} are black everywhere (largest β⁰ {float(power.max()):.3g}); "
                "simulate or import again"
            )
        self._reference = math.sqrt(float(power.max()))
        self._truth = (power.sqrt() / self._reference if config.loss == "amplitude" else power).to(self.device)
        self._numbers = torch.arange(len(self.views), device=self.device)
        self._rays = RayGrid.for_image(self.grid, config.rays_per_pixel)
        self._generator = torch.Generator().manual_seed(config.seed)
        self.model = SceneModel.initial(config, dataset, self._generator, self.device)
        self.optimiser = Optimiser(self.model.parameters, self.model.bounds, config)
        self.density = (
            DensityControl(config.densification, len(self.model), self.device) if config.densification else None
        )
        self.iteration = 0
        self._queue: list[int] = []

    def step(self) -> Float32[Tensor, ""]:
        """One step of Adam on a few views; returns the loss, still on the device: nothing waits for a GPU."""
        chosen = self._next_views()
        gather = self.density is not None and self.density.wanted(self.iteration)
        images, rendering = self.model.render(
            [self.views[i] for i in chosen],
            self.grid,
            self.model.degree(self.iteration),
            rays=self._rays,
            chips=torch.stack([self._numbers[i] for i in chosen]),
            plane_gradients=gather,
        )
        truth = torch.stack([self._truth[i] for i in chosen])  # much faster than an index
        if self.config.loss == "amplitude":
            loss = amplitude_loss(images, truth, self._reference, self.config.ssim_weight)
        else:
            loss = speckle_loss(images / self.model.unit, truth / self.model.unit)
        penalty = self.model.penalty()
        (loss if penalty is None else loss + penalty).backward()
        if gather and self.density is not None:
            self.density.gather(rendering, self.grid)
        self.optimiser.step(self.iteration)
        self.iteration += 1
        if self.density is not None and self.density.due(self.iteration):
            self._densify(self.density)
        return loss.detach()

    def _next_views(self) -> list[int]:
        """Every view once in a random order, then again."""
        count = min(self.config.views_per_step, len(self.views))
        while len(self._queue) < count:
            self._queue += torch.randperm(len(self.views), generator=self._generator).tolist()
        chosen, self._queue = self._queue[:count], self._queue[count:]
        return chosen

    def _densify(self, density: DensityControl) -> None:
        with torch.no_grad():
            gaussians = self.model.target(self.model.degree(self.iteration))
            extent = self.grid.rows * self.grid.spacing_m[1]
            source, kept, displacement, shrink = density.decide(gaussians, extent, self._generator)
            parameters = {
                name: tensor[source] if name in PER_GAUSSIAN else tensor
                for name, tensor in self.model.parameters.items()
            }
            parameters["means"] = parameters["means"] + displacement
            parameters["scales"] = parameters["scales"] * shrink[:, None]
        self.model = SceneModel(self.config, self.model.region, self.model.unit, parameters, self.device)
        self.model.constrain()
        self.optimiser = self.optimiser.rebuild(self.model.parameters, torch.where(kept, source, -1))

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything the next step depends on: tensors, on whatever device they are, and JSON."""
        tensors = {f"model/{name}": tensor.detach() for name, tensor in self.model.parameters.items()}
        tensors |= {f"optimiser/{name}": tensor for name, tensor in self.optimiser.state().items()}
        tensors["generator"] = self._generator.get_state()
        if self.density:
            tensors |= {"density/gradient": self.density.gradient, "density/seen": self.density.seen}
        return tensors, {"iteration": self.iteration, "queue": self._queue}

    def load_state(self, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Undo `state`, of a training on any device."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}

        self.model = SceneModel(self.config, self.model.region, self.model.unit, part("model/"), self.device)
        self.optimiser = Optimiser(self.model.parameters, self.model.bounds, self.config)
        self.optimiser.load_state(part("optimiser/"))
        self._generator.set_state(tensors["generator"])
        if self.density:
            self.density.gradient, self.density.seen = (
                tensors[f"density/{name}"].to(self.device) for name in ("gradient", "seen")
            )
        self.iteration, self._queue = int(state["iteration"]), [int(k) for k in state["queue"]]
        if not all(0 <= k < len(self.views) for k in self._queue):
            raise ValueError("it queues views that are not there")


def reconstruct(dataset: Dataset, out: Path, config: Config, *, resume: bool = False, overwrite: bool = False) -> Run:
    """Reconstruct a target from the training images of a dataset.

    Parameters
    ----------
    dataset : Dataset
        Where the images are.
    out : Path
        Folder of the run; it appears, or replaces an earlier run, with the first checkpoint.
    config : Config
        How; see `PRESETS`.
    resume : bool
        Go on from the newest checkpoint in `out`, exactly as if the training had never stopped.
    overwrite : bool
        Replace an existing run.

    Returns
    -------
    Run
        The finished run. On Ctrl-C what has been learned so far is written as well, and KeyboardInterrupt passes on;
        but an earlier run stays if the new one has no checkpoint yet.

    Raises
    ------
    SarsplatError
        If `out` exists (to resume: does not), another process is writing it, or dataset or configuration are not those
        the run was begun with.
    """
    out = Path(out)
    warn(suspicions(dataset))
    trainer = Trainer(dataset, config)
    with (
        ExitStack() as held,
        progress(f"reconstruct ({config.preset})", config.iterations) as shown,
        interrupts_held_back() as interrupted,
    ):
        begun = time.monotonic()
        if resume:
            run = Run.load(out)
            held.enter_context(only_writer(out))
            begun -= _resume(trainer, run, dataset)
            shown.start_at(trainer.iteration)
        else:
            if overwrite:
                require_replaceable(out)
            with new_folder(out, overwrite, marker=HEADER) as folder:
                held.enter_context(only_writer(folder))  # to the end, also under its final name
                run = Run.create(folder, dataset, config)
                _train(trainer, run, min(config.checkpoint_every, config.iterations), begun, shown, interrupted)
                if interrupted() and (out / HEADER).is_file():
                    raise KeyboardInterrupt(f"stopped by Ctrl-C before the first checkpoint; {out} is still as it was")
        try:
            _train(trainer, Run.load(out), config.iterations, begun, shown, interrupted)
        finally:  # the run is usable as far as it has come
            finished = Run.load(out)
            if finished.checkpoint_path is not None:
                finished.write_results()
    if interrupted() and trainer.iteration < config.iterations:
        raise KeyboardInterrupt
    return finished


def _resume(trainer: Trainer, run: Run, dataset: Dataset) -> float:
    """Bring trainer and run to the newest checkpoint; returns the seconds trained until then."""
    if run.fingerprint != dataset.fingerprint():
        raise SarsplatError(f"{run.path} was begun with another dataset ({run.dataset_path}); resume it with that one")
    if run.config != trainer.config:
        raise SarsplatError(
            f"{run.path} was begun with other settings (preset {run.config.preset}, seed {run.config.seed}, "
            f"{run.config.iterations} iterations, init {run.config.initialisation}); resume it with the same"
        )
    run.set_dataset_path(dataset.path)
    seconds = 0.0
    if run.checkpoint_path is not None:
        tensors, state = run.checkpoint
        seconds = run.time_s
        try:
            trainer.load_state(tensors, state)
        except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise SarsplatError(
                f"{run.checkpoint_path} does not fit this version ({error}); start again with --overwrite"
            ) from error
    if trainer.iteration < trainer.config.iterations:
        run.remove_results()
    lines = [line for line in run.history if line["iteration"] <= trainer.iteration]  # a killed process wrote more
    write_bytes(run.log_path, "".join(json.dumps(line) + "\n" for line in lines).encode())
    return seconds


def _train(
    trainer: Trainer,
    run: Run,
    iterations: int,
    begun: float,
    shown: Reporter,
    interrupted: Callable[[], bool],
) -> None:
    """Step until so many iterations are done or Ctrl-C came; log, show and save on the way, and save at the end."""
    config = trainer.config
    every = max(1, config.iterations // _LINES_PER_RUN)
    total, count = torch.zeros((), dtype=torch.float64, device=trainer.device), 0
    stop = trainer.iteration >= iterations or interrupted()
    while not stop:
        total, count = total + trainer.step(), count + 1
        stop = trainer.iteration >= iterations or interrupted()
        if trainer.iteration % every == 0 or trainer.iteration == config.iterations:
            loss = float(total) / count
            _require_finite(loss, trainer.iteration)
            line = {
                "iteration": trainer.iteration,
                "seconds": round(time.monotonic() - begun, 3),
                "loss": loss,
                "gaussians": len(trainer.model),
            }
            with plain_os_errors("write", run.log_path), run.log_path.open("a") as file:
                file.write(json.dumps(line) + "\n")
            shown.update(trainer.iteration, f"loss {loss:.3g}  {len(trainer.model)} Gaussians")
            total, count = torch.zeros_like(total), 0
        if stop or trainer.iteration % config.checkpoint_every == 0:
            _save(trainer, run, time.monotonic() - begun)


def _require_finite(loss: float, iteration: int) -> None:
    if not math.isfinite(loss):
        raise SarsplatError(
            f"the loss became {loss} at iteration {iteration}; lower the rates (checkpoints are from before)"
        )


def _save(trainer: Trainer, run: Run, seconds: float) -> None:
    tensors, state = trainer.state()
    folder = run.path / "checkpoints"
    save_checkpoint(folder / f"{trainer.iteration:08d}.safetensors", tensors, {**state, "seconds": round(seconds, 3)})
    with plain_os_errors("write", folder):
        for old in sorted(folder.glob("*.safetensors"))[:-_CHECKPOINTS_KEPT]:
            old.unlink()
