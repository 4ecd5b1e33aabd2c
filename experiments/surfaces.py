"""Surfaces of other kinds than those by which settings are chosen: curved, tall, leaning, many, and one size up."""

from __future__ import annotations

from typing import Any

from conditions import ALL_AROUND, POINTS
from experiment import Experiment, Row
from made_scenes import SCENES

KINDS = ("domed tanks and pipes", "vaulted hangars", "a ship", "a courtyard of tall blocks", "trees", "flat roofs")
ALSO: dict[str, dict[str, Any]] = {
    "γ⁰ of parts differs by 4 dB": {"reflectivity": 4.0},
    "4 looks": {"looks": 4, "clean_tests": True},
    "4 looks, ground of γ⁰ = 0.05": {"looks": 4, "ground": 0.05, "clean_tests": True},
}
"""What else is tried with hangars."""


def _row(scene: str, label: str, **options: Any) -> Row:
    dataset = {"scene": scene, **ALL_AROUND, "pixels": SCENES[scene][:1], **options}
    return Row(label, (dataset,), "auto", random=bool(options))


SURFACES = Experiment(
    "surfaces",
    "Surfaces of any kind",
    "Clean images without ground unless said, 24 views (12 azimuths at 35 and 50°), images of 352 × 352 pixels of "
    "0.3 m, flat roofs 640 × 640; with the settings that `reconstruct` takes by itself. Points against the visible "
    "surface. Settings were chosen by other scenes; the tanks, the ship and trees were seen meanwhile, and hangars "
    "with 4 looks helped to choose when the law is learned, the floor of `speckled` and, on ground, that `scene` keeps "
    "hidden Gaussians. Times are not of a quiet machine. The paper has no figures for these.",
    (
        *(_row(scene, scene) for scene in KINDS),
        *(_row("vaulted hangars", f"vaulted hangars: {label}", **options) for label, options in ALSO.items()),
    ),
    (POINTS,),
    judged=("cd_m", "f1@0.3"),
    seeds=(0,),
)
