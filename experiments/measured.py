"""Measured chips: how well unseen ones are predicted, beside simpler methods, and what each term is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiment import Experiment, Options, Row

SCORES = ("registered_nats_per_pixel", "registered_log_correlation", "nats_per_pixel", "log_correlation")
SHAPE = ("cd_m", "accuracy_m", "completeness_m", "f1@0.3")
SIMPLER = ("rotated_average", "nearest_chip")

TERMS: Mapping[str, Mapping[str, Any]] = {
    "everything": {},
    "no ground": {"ground": None},
    "ground of one γ⁰ only": {"ground.pitch": 0.0},
    "nothing shared by neighbouring chips": {"surroundings.texture_looks": 0.0},
    "no side lobes": {"surroundings.side_lobes": 0.0},
    "every chip in its place": {"surroundings.shift_std": 0.0},
    "every chip of the same gain": {"surroundings.gain_std": 0.0},
    "no Gaussian left out": {"dropout": 0.0},
    "Gaussians as often full as empty": {"sparsity": 0.0},
    "directions free of each other": {"directional_std": None},
    "γ⁰ the same in all directions": {"harmonics_degree": 0},
}
"""What is switched off, and the settings that do it."""


def chips(target: str, views: int, *depressions: int, **more: Any) -> Options:
    """Options of `import_mstar`: training views of these depressions, by default 17°; all other chips are predicted."""
    return {"target_class": target, "train_views": views, "train_depression": depressions or (17,), **more}


def _predicted(datasets: Sequence[Options], predicted: Sequence[int]) -> tuple[Row, ...]:
    """Chips that were not trained on, of every depression."""
    rows = []
    for dataset in datasets:
        for depression in predicted:
            group = f"{dataset['target_class']}, {dataset['train_views']} chips → {depression}°"
            common: dict[str, Any] = {"datasets": (dataset,), "preset": "measured", "group": group}
            rows.append(Row("sarsplat", **common, scored=f"images.test-{depression}."))
            for method in SIMPLER:
                where = f"baselines.test-{depression}.{method}."
                rows.append(Row(method.replace("_", " "), **common, scored=where, once=True))
    return tuple(rows)


def _terms(*datasets: Options) -> tuple[Row, ...]:
    """Of every four training chips three are trained on and one is predicted: no test chip is looked at."""
    return tuple(
        Row(label, ({**dataset, "folded": True},), "measured", changes, f"{dataset['target_class']}")
        for dataset in datasets
        for label, changes in TERMS.items()
    )


_PREDICTED = (
    "Chips that were not trained on, and points against a procedural model of the target where there is one, brought "
    "onto it by a small motion."
)
_LEFT_OUT = "Of every four training chips three are trained on and one is predicted, without one term of the model."
_T72 = chips("T72", 36)
_AT_MANY = (chips("T72-A64", 36, 15, 17, 30, 45), chips("SLICY", 36, 15, 30, 45))

MEASURED = (
    Experiment(
        "measured",
        "Measured chips of T72 and BMP2",
        _PREDICTED,
        _predicted((_T72, chips("BMP2", 36), chips("T72", 8), chips("BMP2", 8)), (17, 15)),
        (SCORES, SHAPE),
        judged=SCORES[:2],
    ),
    Experiment(
        "measured-multi",
        "Measured chips of T72-A64 and SLICY",
        _PREDICTED,
        _predicted(_AT_MANY, (15, 17, 30, 45)),
        (SCORES, SHAPE),
        judged=SCORES[:2],
    ),
    Experiment("measured-terms", "Effect of each term: T72", _LEFT_OUT, _terms(_T72), (SCORES,), judged=SCORES[:2]),
    Experiment(
        "measured-multi-terms",
        "Effect of each term: T72-A64 and SLICY",
        _LEFT_OUT,
        _terms(chips("T72-A64", 36), _AT_MANY[1]),
        (SCORES,),
        judged=SCORES[:2],
    ),
)
