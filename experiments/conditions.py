"""Real conditions: speckle on ground, several objects, few views; settings chosen by the images, and two presets."""

from __future__ import annotations

from typing import Any

from experiment import Experiment, Options, Row
from made_scenes import SCENES

POINTS = ("cd_m", "accuracy_m", "completeness_m", "f1@0.3", "f1@0.1", "psnr_target_db", "time_s")
ALL_AROUND: Options = {"azimuth": ("0:360:30",), "grazing": ("35", "50"), "test_azimuth": ("15:360:60",)}
CONDITIONS: dict[str, Options] = {
    "1 look": {**ALL_AROUND, "looks": 1},
    "4 looks": {**ALL_AROUND, "looks": 4},
    "16 looks": {**ALL_AROUND, "looks": 16},
    "12 views": {**ALL_AROUND, "azimuth": ("0:360:60",), "looks": 1},
    "120° of azimuth": {**ALL_AROUND, "azimuth": ("-60:61:10",), "test_azimuth": ("-55:60:22",), "looks": 1},
    "between hills": {**ALL_AROUND, "looks": 1, "hills": True},
}
"""Views and looks; ground of γ⁰ = 0.05."""

COMPARED_PRESETS = ("auto", "speckled", "measured")
COMPARED_SCENES = (
    "T-72",
    "three vehicles",
    "vaulted halls, a tank, a truck",
    "a street of boxes and vehicles",
    "a village",
)


def _rows() -> tuple[Row, ...]:
    rows = []
    for name in COMPARED_SCENES:
        for condition, views in CONDITIONS.items():
            if "hills" in views and name != "T-72":  # other objects would be buried
                continue
            options: dict[str, Any] = {
                "scene": name,
                **views,
                "pixels": SCENES[name][:1],
                "ground": 0.05,
                "clean_tests": True,
            }
            rows += [
                Row(preset, (options,), preset, group=f"{name}, {condition}", random=True)
                for preset in COMPARED_PRESETS
            ]
    return tuple(rows)


CONDITIONS_GRID = Experiment(
    "conditions",
    "Real conditions",
    "Simulated single images of speckled ground of γ⁰ = 0.05, level unless said, with one or more objects, 24 views "
    "(12 azimuths at 35 and 50°; 26 within 120°) unless said, clean test images: settings that `reconstruct` chooses "
    "by the images, beside presets by hand, of which `measured` keeps the largest object alone, as in single chips. "
    "Points against the visible surface. The paper has no figures for these.",
    _rows(),
    (POINTS,),
    judged=("cd_m", "f1@0.3"),
    contest=True,
    seeds=(0,),
)
