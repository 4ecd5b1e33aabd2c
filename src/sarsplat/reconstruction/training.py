"""From a dataset to a run of Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sarsplat.data import Dataset, read_dataset
from sarsplat.data.plausible import suspicions, warn
from sarsplat.progress import progress
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.device import device_named
from sarsplat.reconstruction.lengths import lengths
from sarsplat.reconstruction.loop import Step, Training, train
from sarsplat.reconstruction.losses import LOSSES, Loss
from sarsplat.reconstruction.presets import preset
from sarsplat.reconstruction.run import Run
from sarsplat.reconstruction.trainer import Trainer


def reconstruct(
    dataset: Dataset | str | Path,
    preset: str | Config = "auto",
    out: str | Path | None = None,
    *,
    device: str = "auto",
    loss: Loss | None = None,
    on_step: Callable[[Step[Trainer]], object] | None = None,
    quiet: bool = False,
    resume: bool = False,
    overwrite: bool = False,
) -> Run:
    """Reconstruct a target from the training images of a dataset.

    Parameters
    ----------
    dataset : Dataset, str or Path
        The images, or the folder that holds them.
    preset : str or Config
        How: a name in `PRESETS`, a configuration of your own, or "auto": "measured" where the images show ground,
        "speckled" where there is only speckle, "default" elsewhere. To resume, "auto" is what the run was begun with.
    out : str or Path, optional
        Folder of the run; it appears, or replaces an earlier run, with the first checkpoint. Without it everything
        stays in memory.
    device : {"auto", "cpu", "cuda"}
        Where to train; "auto" is a GPU if there is one that can be used.
    loss : callable, optional
        Instead of the configuration's: `loss(rendered, truth)` is given two float32 stacks [V, rows, columns] of
        β⁰, linear power, and returns one number that torch can differentiate. It is first asked for the loss of black
        images, the unit of `scattering_penalty`. The run's configuration has its name; to resume, give it again.
    on_step : callable, optional
        Called after every step (`Step`). If it returns True, the training ends there, and the run is what has been
        learned so far. An exception ends it too; what has been learned is then kept in `out`.
    quiet : bool
        Show no progress.
    resume : bool
        Go on from the newest checkpoint in `out`, exactly as if the training had never stopped. The settings must be
        those the run was started with, except `iterations`, `checkpoint_every` and `points`: more iterations extend
        a run, even a finished one, and its points are extracted anew.
    overwrite : bool
        Replace an existing run.

    Returns
    -------
    Run
        The finished run. If KeyboardInterrupt or another exception ends the training, what was saved stays usable; but
        an earlier run stays if the new one has no checkpoint yet.

    Raises
    ------
    SarsplatError
        If `out` exists (to resume: does not), another process is writing it, or dataset or configuration are not those
        the run was started with.
    """
    dataset = dataset if isinstance(dataset, Dataset) else read_dataset(Path(dataset))
    begun = Run.load(out).config if resume and preset == "auto" and out is not None else None
    config = begun or fitting(preset, dataset)
    if loss is not None:
        name = getattr(loss, "__name__", type(loss).__name__)
        config = replace(config, loss=f"own {name}" if name in LOSSES else name)
    warn(suspicions(dataset))
    trainer = Trainer(dataset, config, loss, device_named(device))
    with progress(f"reconstruct ({config.preset})", config.iterations, quiet) as shown:
        shown.note(lengths(config, dataset.grid))
        folder = None if out is None else Path(out)
        training = Training(trainer, on_step, shown)
        new = Run(config, dataset.fingerprint())
        return train(training, new, dataset, folder, resume=resume, overwrite=overwrite)


def fitting(choice: str | Config, dataset: Dataset) -> Config:
    """The configuration that is meant: where there is ground or speckle, it must be modelled."""
    if isinstance(choice, Config):
        return choice
    if choice != "auto":
        return preset(choice)
    return preset("measured" if dataset.ground else "default" if dataset.looks is None else "speckled")
