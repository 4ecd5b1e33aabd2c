"""From a dataset to a run by a method that is not ours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sarsplat.baselines.config import BaselineConfig
from sarsplat.baselines.methods import method_named
from sarsplat.baselines.run import BaselineRun
from sarsplat.baselines.trainer import BaselineTrainer, scene_of
from sarsplat.data import Dataset, read_dataset, read_masks
from sarsplat.data.plausible import suspicions, warn
from sarsplat.errors import SarsplatError
from sarsplat.progress import progress
from sarsplat.reconstruction.config import refuse_other_settings
from sarsplat.reconstruction.device import device_named
from sarsplat.reconstruction.loop import Step, Training, train


def reconstruct_with(
    method: str,
    dataset: Dataset | str | Path,
    config: BaselineConfig | None = None,
    out: str | Path | None = None,
    *,
    masks: str | Path | None = None,
    device: str = "auto",
    on_step: Callable[[Step[BaselineTrainer]], object] | None = None,
    quiet: bool = False,
    resume: bool = False,
    overwrite: bool = False,
) -> BaselineRun:
    """Reconstruct a target with one of `METHODS`; everything else is as in `sarsplat.reconstruct`.

    Parameters
    ----------
    method : str
        Its name.
    dataset : Dataset, str or Path
        The images, or the folder that holds them.
    config : BaselineConfig, optional
        Its settings; without, its defaults, or to resume, those the run was begun with.
    out : str or Path, optional
        Folder of the run; without it everything stays in memory.
    masks : str or Path, optional
        Folder of masks of the training images (`read_masks`), for methods that learn from them. The run keeps them.
    device : {"auto", "cpu", "cuda"}
        Where to train.
    on_step : callable, optional
        Called after every step (`Step`); if it returns True, the training ends there.
    quiet, resume, overwrite : bool
        As in `sarsplat.reconstruct`.

    Raises
    ------
    SarsplatError
        If there is no such method, the dataset lacks what it learns from, or as in `sarsplat.reconstruct`.
    """
    chosen = method_named(method)
    dataset = dataset if isinstance(dataset, Dataset) else read_dataset(Path(dataset))
    begun = BaselineRun.load(out) if resume and out is not None else None
    if begun is not None and begun.method != method:
        raise SarsplatError(f"{out} was started with the method {begun.method}, not {method}; resume it with that")
    if masks is not None and not chosen.masks:
        raise SarsplatError(f"{method} does not learn from masks, so leave out the masks {masks}")
    kept = begun is not None and begun.checkpoint_path is not None
    if kept and masks is not None:
        raise SarsplatError(f"{out} keeps the masks it was started with; leave out the masks {masks}")
    settings = config if config is not None else chosen.settings if begun is None else begun.config
    if type(settings) is not type(chosen.settings):
        raise SarsplatError(
            f"the settings are a {type(settings).__name__}; {method} takes a {type(chosen.settings).__name__}"
        )
    if begun is not None:
        refuse_other_settings(begun.folder, begun.config, settings)
    warn(suspicions(dataset))
    if begun is not None and kept:
        scene = begun.model.scene
    else:
        known = None if masks is None else np.stack([*read_masks(Path(masks), dataset, ("train",)).values()])
        scene = scene_of(dataset, known)
    trainer = BaselineTrainer(dataset, chosen, settings, scene, device_named(device))
    with progress(f"reconstruct ({method})", settings.iterations, quiet) as shown:
        new = BaselineRun(settings, dataset.fingerprint(), name=method)
        folder = None if out is None else Path(out)
        return train(Training(trainer, on_step, shown), new, dataset, folder, resume=resume, overwrite=overwrite)
