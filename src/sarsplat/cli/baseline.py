"""`sarsplat reconstruct --method`: a dataset in, a run by a method that is not ours out."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sarsplat.cli import console
from sarsplat.cli.arguments import refuse_existing
from sarsplat.cli.watch import watched
from sarsplat.errors import SarsplatError, shown
from sarsplat.reconstruction.config import OURS

if TYPE_CHECKING:
    from sarsplat.baselines import BaselineConfig
    from sarsplat.cli.reconstruct import Options

MethodName = Literal["sar-gs", "sar-nerf", "sar-nerf-grid", "dsr"]

_SETTINGS = ("iterations", "views_per_step", "checkpoint_every", "seed")
"""Those that all methods have, and that are options."""

_OTHERS = (
    *("out", "method", "masks", "config", "print_config", "device"),
    *("view", "port", "resume", "tensorboard", "overwrite"),
)


def asked_method(asked: MethodName | None, resume: bool, out: Path) -> str:
    """The method that is meant: without a word, the one that the run was begun with, or ours."""
    if asked is not None or not resume:
        return asked or OURS
    from sarsplat.reconstruction.any_run import read_header

    return read_header(out).method


def settings_in(file: Path, method: str) -> Any:
    """The settings in a file that --print-config wrote, or in a run's `config.json`.

    Raises
    ------
    SarsplatError
        If they are another method's.
    """
    from sarsplat.data import read_json

    content = read_json(file, dict[str, Any])
    if (whose := content.get("method", OURS)) != method:
        raise SarsplatError(f"{file} holds settings of {shown(whose)}, not of {method}; give that as --method")
    return content.get("config", content)


def reconstruct_by(method: str, options: Options, words: Sequence[str]) -> None:
    """Do what `sarsplat reconstruct` does, by another method.

    Raises
    ------
    SarsplatError
        If the options are not for it.
    """
    from sarsplat.reconstruction.any_run import HEADER

    dataset, out = options.dataset, options.out
    if options.view:
        raise SarsplatError(f"--view shows trainings by {OURS} only, not by {method}; leave it out, and view the run")
    config = _config(method, options, words)
    if options.print_config:
        json.dump({"method": method, "config": config.as_dict()}, sys.stdout, indent=2)
        sys.stdout.write("\n")
        return
    if not options.resume:
        refuse_existing(out, options.overwrite, marker=HEADER)
    from sarsplat.baselines import reconstruct_with
    from sarsplat.data import read_dataset

    images = read_dataset(dataset)
    with watched(options, images) as on_step:
        run = reconstruct_with(
            method,
            images,
            config,
            out,
            masks=options.masks,
            device=options.device,
            on_step=on_step,
            resume=options.resume,
            overwrite=options.overwrite,
        )
    console.finish(
        f"{out}: {run.learned} and {len(run.points)} points in {run.time_s:.0f} s (seed {run.seed})",
        f"sarsplat evaluate {shlex.quote(str(out))}",
    )


def _config(method: str, options: Options, words: Sequence[str]) -> BaselineConfig:
    """The method's defaults, the run's settings or those of a file, with the options that override them."""
    from sarsplat.baselines import BaselineRun
    from sarsplat.baselines.methods import method_named

    given = [word[2:].partition("=")[0].replace("-", "_") for word in words if word.startswith("--")]
    if (foreign := next((name for name in given if name not in (*_SETTINGS, *_OTHERS)), None)) is not None:
        raise SarsplatError(
            f"--{foreign.replace('_', '-')} is a setting of {OURS} and has no effect with {method}; see its settings "
            "with --print-config, and give changed ones with --config FILE"
        )
    chosen = method_named(method)
    if options.config is not None:
        base = chosen.read_settings(settings_in(options.config, method), str(options.config))
    else:
        base = BaselineRun.load(options.out).config if options.resume else chosen.settings
    return replace(base, **{name: getattr(options.settings, name) for name in _SETTINGS if name in given})
