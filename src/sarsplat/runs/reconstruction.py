"""`reconstruct`: train any method on a dataset."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatError, shown
from sarsplat.examination.plausible import suspicions, warn
from sarsplat.executors.executor import Means, executor_named
from sarsplat.learning import Inputs, Trainer
from sarsplat.learning.device_choice import device_named, quicker_device
from sarsplat.learning.losses import Loss
from sarsplat.progress import progress
from sarsplat.runs.methods import method_named
from sarsplat.runs.run import Run
from sarsplat.runs.tiled_training import TiledTraining, TileExecutor, steps_of
from sarsplat.runs.training_loop import Step, Training, train
from sarsplat.settings.config import DEFAULT_METHOD, AnyConfig, Config


def _as_setting(name: str, value: object) -> str | None:
    """Return the remedy for a setting given as an argument of `reconstruct`; None for other names."""
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
        The images or their folder.
    preset : str or AnyConfig
        A name in `PRESETS`, settings, or "auto". For `sar-gs`, "auto" is "scene" or "measured", by a short trial, for
        images with speckle on ground, "speckled" for speckle alone, otherwise "default"; for other methods, their
        defaults; to resume, the settings of the run.
    out : str or Path, optional
        Folder of the run; it appears, or replaces an earlier run, with the first checkpoint. None: in memory.
    method : str
        Name of the method, one of `METHODS`.
    masks : str or Path, optional
        Folder of masks of the training images (`read_masks`), for methods that learn from them; stored in the run.
    loss : callable, optional
        For `sar-gs`, instead of the configuration's: `loss(rendered, truth)` takes two float32 tensors
        [V, rows, columns] of β⁰, linear power, and returns a differentiable scalar. The first call is for black images,
        the unit of `scattering_penalty`. The run stores its name; to resume, give it again.
    strategies : sequence
        For `sar-gs`: strategies between steps in addition to the configuration's.
    device : {"auto", "cpu", "cuda"}
        Where to train; "auto" is a GPU that passes the CUDA engine's check, unless a trial of steps is quicker on the
        CPU or fails on the GPU.
    executor : str, optional
        Executor of tiles, if the settings have some (`tiles`): a name in `sarsplat.executors.EXECUTORS`, such as
        "local" or "ray"; by default this process, one after the other. Other processes do not call `on_step`.
    means : Means, optional
        Resources of the executor.
    on_step : callable, optional
        Called after every step (`Step`). If it returns True, the training ends with the state so far; on an exception,
        that state stays in `out`.
    quiet : bool
        Show no progress.
    resume : bool
        Continue from the newest checkpoint in `out`, bit for bit as without the interruption. Settings must equal the
        run's except `iterations`, `checkpoint_every` and, for `sar-gs`, `points`: more iterations extend even a
        finished run, whose points are extracted anew.
    overwrite : bool
        Replace an existing run.

    Returns
    -------
    Run
        The finished run. After KeyboardInterrupt or another exception, `out` has the newest checkpoint, or still the
        earlier run if there is no checkpoint yet.

    Raises
    ------
    SarsplatError
        If the method is unknown or does not support the dataset or an argument, `out` exists (to resume: does not),
        another process is writing it, or dataset, method or settings differ from those of the run to resume.
    """
    chosen = method_named(method)
    inputs = Inputs(None if masks is None else Path(masks), loss, tuple(strategies))
    chosen.refuse_others(inputs)
    target_device = device_named(device)
    dataset = dataset if isinstance(dataset, Dataset) else read_dataset(Path(dataset))
    earlier = Run.load(out) if resume and out is not None else None
    if earlier is not None and earlier.method != method:
        raise SarsplatError(f"{out} was started with the method {earlier.method}, not {method}; resume it with that")
    if isinstance(preset, str):
        config = earlier.config if earlier is not None and preset == "auto" else chosen.preset(preset, dataset)
    else:
        config = chosen.checked(preset)
    warn(suspicions(dataset))
    saved = earlier if earlier is not None and earlier.store.checkpoint_path is not None else None
    learned = None if saved is None else lambda: saved.reconstruction
    if device == "auto" and earlier is not None and earlier.trained_on == "cpu":
        target_device = device_named("cpu")  # as before
    note = ""
    if device == "auto" and target_device.type == "cuda" and earlier is None and not (loss or strategies):
        target_device, note = quicker_device(
            lambda where: chosen.trainer(dataset, config, inputs, where, None), target_device, config.iterations
        )
    trainer = chosen.trainer(dataset, config, inputs, target_device, learned)
    heading, about = chosen.about(trainer.config, dataset.grid)
    by_tiles = chosen.by_tiles(config)
    tile_executor = (
        None if executor is None else _tile_executor(executor, means or Means(), by_tiles, dataset, out, inputs)
    )
    steps = steps_of(cast(Trainer, trainer)) if by_tiles else config.iterations
    with progress(f"reconstruct ({heading})", steps, quiet) as shown:
        for line in filter(None, (about, note)):
            shown.note(line)
        where = None if dataset.path is None else dataset.path.resolve()
        provenance: dict[str, Any] = {"dataset_path": where, "trained_on": target_device.type, "place": dataset.place}
        run = Run(method, trainer.config, dataset.fingerprint(), **provenance)
        folder = None if out is None else Path(out)
        training: Training[Any]
        if by_tiles:
            training = TiledTraining(cast(Trainer, trainer), on_step, shown, dataset, inputs, tile_executor)
        else:
            training = Training(trainer, on_step, shown)
        return train(training, run, dataset, folder, resume=resume, overwrite=overwrite)


def _tile_executor(
    executor: str, means: Means, by_tiles: bool, dataset: Dataset, out: str | Path | None, inputs: Inputs
) -> TileExecutor:
    """Return the function that has tiles trained by an executor; raise without tiles, or if they cannot be sent."""
    if not by_tiles or dataset.path is None or out is None or inputs.loss is not None:
        raise SarsplatError(
            f"executor is {executor}, which needs tiles above 1, the dataset's folder, out and no custom loss; give "
            "these, or no executor"
        )
    chosen = executor_named(executor)
    return lambda jobs, folder: chosen(jobs, folder, means)
