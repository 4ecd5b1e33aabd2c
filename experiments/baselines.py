"""Our method and its baselines on the same data: the same images, the same scores, this machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiment import Experiment, Options, Row, scene

from sarsplat.evaluation.paper import paper_scores

RENDERED = ("psnr_db", "psnr_target_db", "ssim", "lpips", "cd_m", "f1@0.3", "f1@0.1", "time_s")
MEASURED = ("registered_nats_per_pixel", "registered_log_correlation", "nats_per_pixel", "cd_m", "f1@0.3", "time_s")

_PAPER_SAR_NERF = {
    "t72": {"psnr_db": 34.29, "ssim": 0.9894, "lpips": 0.0262, "time_s": 5599},
    "btr70": {"psnr_db": 34.54, "ssim": 0.9911, "lpips": 0.0224, "time_s": 5666},
    "kraz": {"psnr_db": 36.65, "ssim": 0.9953, "lpips": 0.0178, "time_s": 5432},
}
"""Table II, rendered sets; times on an RTX 3060 Ti."""

_PAPER_CHIPS = {"sar-gs": {"cd_m": 0.179, "f1@0.3": 0.904}, "dsr": {"cd_m": 0.196, "f1@0.3": 0.845, "time_s": 596}}
"""Table V, the measured T72 against another model; the time on an RTX 2080 Ti."""


def _rows(group: str, dataset: Options, paper: Mapping[str, Mapping[str, Any]], everything: bool) -> list[Row]:
    """Ours, and every baseline in our time and to its end; `everything`: also those that were worse or take long."""
    grid, perceptron = "SAR-NeRF on a grid", "SAR-NeRF"
    kinds: list[tuple[str, str, dict[str, Any]]] = [(f"{grid}, sound", "sar-nerf-grid", {})]
    if everything:
        kinds.append((f"{grid}, published equations", "sar-nerf-grid", {"mode": "published"}))
    kinds.append(("DSR", "dsr", {}))
    rows = [Row("sarsplat", (dataset,), group=group, preset="auto", paper=paper.get("sar-gs", {}))]
    for name, method, changes in kinds:
        common: dict[str, Any] = {"datasets": (dataset,), "preset": "auto", "group": group, "method": method}
        rows.append(Row(f"{name}, in our time", **common, changes=changes, full=f"{name}, full"))
        rows.append(Row(f"{name}, full", **common, changes=changes, paper=paper.get(method, {})))
    # as many steps as ten minutes of a core of an AMD EPYC hold
    for name, steps in (("published", 22), ("sound", 2991)) if everything and "target" in dataset else ():
        common = {"datasets": (dataset,), "preset": "auto", "group": group, "method": "sar-nerf", "once": True}
        label, changes = f"{perceptron}, {name}, stopped after 10 min", {"mode": name, "iterations": steps}
        rows.append(Row(f"{perceptron}, {name}, in our time", **common, changes=changes, full=label))
        rows.append(Row(label, **common, changes=changes, paper=paper.get("sar-nerf", {})))
    return rows


_SIMULATED = [
    row
    for source, words in (("raycast", "by ray casting"), ("splat", "by our own renderer"))
    for target in _PAPER_SAR_NERF
    for row in _rows(
        f"{target}, {words}",
        scene(target, source=source, masks=True),
        {"sar-gs": paper_scores(target).values, "sar-nerf": _PAPER_SAR_NERF[target]},
        (target, source) == ("t72", "raycast"),
    )
]
_CHIPS = [
    row
    for views in (8, 36)
    for row in _rows(
        f"T72, {views} measured chips", {"target_class": "T72", "train_views": views}, _PAPER_CHIPS, views == 36
    )
]

_ABOUT = """SAR-NeRF and DSR, written afresh ([other methods](../concepts/baselines.md)), beside sarsplat on the same
images, scored the same way, one training at a time, on one thread. *In our time*: as many iterations
as fit into the time that sarsplat takes, the learning rate falling within them; *full*: as long as the settings
say. The perceptron's training would take months: it gets ten minutes, and is left out where hundreds of chips
would have to be rendered, each of which takes it ten seconds. Points of measured chips are held against a procedural
model of the target, brought onto it by a small motion; its paper's figures are of another model."""

BASELINES = Experiment(
    "baselines", "Baselines", _ABOUT, tuple(_SIMULATED), (RENDERED,),
    judged=("psnr_target_db", "cd_m", "f1@0.1"), alone=True, contest=True, pictured=True,
)  # fmt: skip
BASELINES_ON_CHIPS = Experiment(
    "baselines-chips", "Baselines on measured chips", _ABOUT, tuple(_CHIPS), (MEASURED,),
    judged=("registered_nats_per_pixel", "cd_m"), alone=True, contest=True, pictured=True,
)  # fmt: skip
