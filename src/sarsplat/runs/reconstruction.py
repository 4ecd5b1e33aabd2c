"""From a dataset to a run, by any method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatError, shown
from sarsplat.examination.plausible import suspicions, warn
from sarsplat.executors.executor import Means, executor_named
from sarsplat.learning.device_choice import device_named, quicker_device
from sarsplat.learning.losses import Loss
from sarsplat.learning.method import Inputs
from sarsplat.learning.trainer import Trainer
from sarsplat.progress import progress
from sarsplat.runs.methods import method_named
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import RunFolder
from sarsplat.runs.tiled_training import Others, TiledTraining, steps_of
from sarsplat.runs.training_loop import Step, Training, train
from sarsplat.settings.config import DEFAULT_METHOD, AnyConfig, Config


def _as_setting(name: str, value: object) -> str | None:
    """How to give a setting of ours, which is no argument of `reconstruct`."""
    if name not in Config.__dataclass_fields__:
        return None
    return (
        f"it is a setting, and settings are given as the preset: from dataclasses import replace; reconstruct(…, "
        f'replace(preset("quick"), {name}={shown(value)}))'
    )


@checks_arguments(instead=_as_setting)
def reconstruct(
    dataset: Dataset | str | Path,
    preset: str | AnyConfig = "auto",
    out: str | Path | None = None,
    *,
    method: str = DEFAULT_METHOD,
    masks: str | Path | None = None,
    scattering: str | None = None,
    loss: Loss | None = None,
    strategies: Sequence[Any] = (),
    device: str = "auto",
    executor: str | None = None,
    means: Means | None = None,
    on_step: Callable[[Step[Any]], object] | None = None,
    quiet: bool = False,
    resume: bool = False,
    overwrite: bool = False,
) -> Run:
    """Reconstruct a target from the training images of a dataset.

    Parameters
    ----------
    dataset : Dataset, str or Path
        The images, or the folder that holds them.
    preset : str or AnyConfig
        How: a name in `PRESETS`, settings of your own, or "auto": of `sar-gs`, "scene" or "measured", by a short
        trial, where images show speckle on ground, "speckled" where there is only speckle, "default" elsewhere; of
        other methods, their defaults. To resume, "auto" is what the run was begun with.
    out : str or Path, optional
        Folder of the run; it appears, or replaces an earlier run, with the first checkpoint. Without it everything
        stays in memory.
    method : str
        Name of the method, one of `METHODS`.
    masks : str or Path, optional
        Folder of masks of the training images (`read_masks`), for methods that learn from them. The run keeps them.
    scattering : str, optional
        For `sar-gs`, instead of the configuration's: the kind of a law of scattering, of ours ("harmonics",
        "normal-lobes") or registered (`sarsplat.gaussians.register_scattering`).
    loss : callable, optional
        For `sar-gs`, instead of the configuration's: `loss(rendered, truth)` is given two float32 stacks
        [V, rows, columns] of β⁰, linear power, and returns one number that torch can differentiate. It is first asked
        for the loss of black images, the unit of `scattering_penalty`. The run's configuration has its name; to
        resume, give it again.
    strategies : sequence
        For `sar-gs`: what else happens between steps, besides what the configuration says.
    device : {"auto", "cpu", "cuda"}
        Where to train; "auto" is a GPU if there is one that passes the CUDA engine's check, unless steps are quicker
        on the CPU or fail on the GPU, which is tried and said.
    executor : str, optional
        Who learns the tiles, if the settings ask for some (`tiles`): a name in `sarsplat.executors.EXECUTORS`, such as
        "local" or "ray"; unless given, this process, one after the other. `on_step` is not called for others' steps.
    means : Means, optional
        What the executor may use.
    on_step : callable, optional
        Called after every step (`Step`). If it returns True, the training ends there, and the run
        is what has been learned so far. An exception ends it too; what has been learned is then kept in `out`.
    quiet : bool
        Show no progress.
    resume : bool
        Go on from the newest checkpoint in `out`, exactly as if the training had never stopped. The settings must be
        those the run was started with, except `iterations`, `checkpoint_every` and, of `sar-gs`, `points`: more
        iterations extend a run, even a finished one, and its points are extracted anew.
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
        If there is no such method, the dataset lacks what it learns from, it does not use what was given, `out` exists
        (to resume: does not), another process is writing it, or dataset, method or settings are not those the run was
        started with.
    """
    chosen = method_named(method)
    inputs = Inputs(None if masks is None else Path(masks), scattering, loss, tuple(strategies))
    chosen.refuse_others(inputs)
    on = device_named(device)
    dataset = dataset if isinstance(dataset, Dataset) else read_dataset(Path(dataset))
    begun = Run.load(out) if resume and out is not None else None
    if begun is not None and begun.method != method:
        raise SarsplatError(f"{out} was started with the method {begun.method}, not {method}; resume it with that")
    if isinstance(preset, str):
        config = begun.config if begun is not None and preset == "auto" else chosen.preset(preset, dataset)
    else:
        config = chosen.checked(preset)
    warn(suspicions(dataset))
    saved = begun if begun is not None and RunFolder(begun.folder).checkpoint_path is not None else None
    learned = None if saved is None else lambda: saved.reconstruction
    if device == "auto" and begun is not None and begun.trained_on == "cpu":
        on = device_named("cpu")  # as it was begun
    note = ""
    if device == "auto" and on.type == "cuda" and begun is None and not (loss or strategies):
        on, note = quicker_device(lambda d: chosen.trainer(dataset, config, inputs, d, None), on, config.iterations)
    trainer = chosen.trainer(dataset, config, inputs, on, learned)
    heading, about = chosen.about(trainer.config, dataset.grid)
    by_tiles = chosen.by_tiles(config)
    others = None if executor is None else _others(executor, means or Means(), by_tiles, dataset, out, inputs)
    steps = steps_of(cast(Trainer, trainer)) if by_tiles else config.iterations
    with progress(f"reconstruct ({heading})", steps, quiet) as shown:
        for said in filter(None, (about, note)):
            shown.note(said)
        where = None if dataset.path is None else dataset.path.resolve()
        known: dict[str, Any] = {"dataset_path": where, "trained_on": on.type, "place": dataset.place}
        new = Run(method, trainer.config, dataset.fingerprint(), **known)
        folder = None if out is None else Path(out)
        training: Training[Any]
        if by_tiles:
            training = TiledTraining(cast(Trainer, trainer), on_step, shown, dataset, inputs, others)
        else:
            training = Training(trainer, on_step, shown)
        return train(training, new, dataset, folder, resume=resume, overwrite=overwrite)


def _others(
    executor: str, means: Means, by_tiles: bool, dataset: Dataset, out: str | Path | None, inputs: Inputs
) -> Others:
    """Who learns tiles instead of this process; refused if there are none, or they cannot be handed over."""
    if not by_tiles:
        raise SarsplatError(
            f"the executor is {executor}, which learns tiles, and the settings have none; give tiles, or no executor"
        )
    if dataset.path is None or out is None:
        raise SarsplatError(
            "other processes read the dataset and write the tiles that they learn; give the dataset's folder and "
            "`out`, or no executor"
        )
    if inputs.loss is not None:
        raise SarsplatError("other processes do not have a loss of one's own; leave it out, or give no executor")
    chosen = executor_named(executor)
    return lambda jobs, folder: chosen(jobs, folder, means)
