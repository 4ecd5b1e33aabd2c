"""`sarsplat view`: a local page in which the radar is dragged around the target."""

import time
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import DEFAULT_PORT, gaussians_around_origin, is_gaussians

_LOOK_AGAIN_S = 0.5


def view(
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|DATASET|PLY")],
    *,
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = DEFAULT_PORT,
) -> None:
    """Look at a run, a dataset or Gaussians in the browser: drag the radar, and see the image that it would take.

    Parameters
    ----------
    path
        Folder of a run or of a dataset, or a PLY or .splat file of Gaussians.
    port
        Port of 127.0.0.1 for the page, which no other machine can open; 0 takes any that is free.
    """
    from sarsplat.runs.run_folder import RunFolder
    from sarsplat.viewer import Viewer, subject_at

    with console.busy(f"reading {path}"):
        viewer = Viewer(
            gaussians_around_origin(path, strays=False)[0] if is_gaussians(path) else subject_at(path), port
        )
    if not is_gaussians(path):
        console.warn_if_beaten(RunFolder(path).metrics)
    try:
        console.say(f"open {viewer.address} in a browser on this machine; Ctrl-C ends it")
        while True:
            time.sleep(_LOOK_AGAIN_S)
    except KeyboardInterrupt:
        console.say(f"\nended; {viewer.address} no longer answers")
    finally:
        viewer.close()
