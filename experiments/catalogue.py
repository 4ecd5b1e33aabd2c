"""Every experiment, as data: datasets, trainings, what is reported, and what the paper printed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from conditions import CONDITIONS_GRID
from experiment import Experiment, Options, Row, scene
from measured import MEASURED
from recognise import RECOGNISE
from surfaces import SURFACES

from baselines import BASELINES, BASELINES_ON_CHIPS
from sarsplat.evaluation.paper import PAPER_DENSIFICATION, PAPER_DENSITY, paper_scores
from sarsplat.settings.presets import PRESETS

VEHICLES = ("t72", "btr70", "2s1", "kraz")
PUBLISHED = ("t72", "btr70", "kraz")
SOURCES = {"raycast": "true images by ray casting", "splat": "true images by our own renderer"}
SHORT_TRAININGS = tuple(name for name in ("default", "quick") if name in PRESETS)

IMAGES = ("psnr_db", "psnr_target_db", "ssim", "lpips")
POINTS = ("accuracy_m", "completeness_m", "cd_m", "precision@0.3", "recall@0.3", "f1@0.3", "f1@0.1")


def _published(target: str) -> dict[str, float]:
    """The paper's scores of a target."""
    return {key: value for key, value in paper_scores(target).values.items() if value is not None}


def _rendered(presets: tuple[str, ...]) -> tuple[Row, ...]:
    """Each vehicle with the paper's row, and the mean of all."""
    rows = []
    for preset in presets:
        for source, words in SOURCES.items():
            group = f"preset `{preset}`, {words}"
            for target in VEHICLES:
                paper = _published(target) if target in PUBLISHED else {}
                rows.append(Row(target, (scene(target, source=source),), preset, group=group, paper=paper))
            every = tuple(scene(target, source=source) for target in VEHICLES)
            rows.append(Row("mean", every, preset, group=group))
    return tuple(rows)


T72 = (scene("t72", source="raycast"),)
NO_DENSIFICATION = {"densification": None}


def _density(preset: str, paper: bool, changes: Mapping[str, Any]) -> tuple[Row, ...]:
    return tuple(
        Row(
            f"{count:,} Gaussians",
            T72,
            preset,
            {**changes, "gaussians": count},
            group=f"preset `{preset}`",
            x=count,
            paper=published if paper else {},
        )
        for count, published in PAPER_DENSITY.items()
    )


_DENSIFICATION = tuple(
    Row(
        f"until {stop:,}" if stop else "none",
        T72,
        "paper",
        {"densification.start": 500, "densification.stop": stop},
        x=stop,
        paper=published,
    )
    for stop, published in PAPER_DENSIFICATION.items()
)

_INITIALISATION = tuple(
    Row(start, T72, preset, {"initialisation": start}, group=f"preset `{preset}`")
    for preset in ("paper", "default")
    for start in ("hemisphere", "box")
)

_HARMONICS = tuple(
    Row(f"every {every:,}" if every > 1 else "all at once", T72, "paper", {"harmonics_every": every}, x=every)
    for every in (1, 500, 1000, 2500, 5000)
)

_LOSS = tuple(
    Row(f"L1 + {weight:g} SSIM" if weight else "L1", T72, preset, {"ssim_weight": weight}, f"preset `{preset}`", weight)
    for preset in ("paper", "default")
    for weight in (0.0, 0.2, 0.5, 0.8)
)


def _everywhere(**options: Any) -> tuple[Options, ...]:
    return tuple(scene(target, source="raycast", **options) for target in VEHICLES)


_HARDER = (
    Row("clean images from 24 views", _everywhere()),
    Row("8 views at one grazing angle (45°)", _everywhere(azimuth=("0:360:45",), grazing=("45",), test_protocol=True)),
    Row("12 random views", _everywhere(random_views=12, test_protocol=True), random=True),
    Row("4-look speckle", _everywhere(looks=4, clean_tests=True), "auto", random=True),
    Row("single-look speckle", _everywhere(looks=1, clean_tests=True), "auto", random=True),
    Row("ground of γ⁰ = 0.05", _everywhere(ground=0.05), "auto"),
    Row("γ⁰ of parts differs by 6 dB", _everywhere(reflectivity=6.0), random=True),
    Row("γ⁰ constant", _everywhere(law=(1.0, 0.0))),
    Row("γ⁰ = cos i (Lambert)", _everywhere(law=(0.0, 1.0, 1.0))),
    Row("γ⁰ = 0.1 + 0.9 cos⁸ i", _everywhere(law=(0.1, 0.9, 8.0))),
)

_SIZES = tuple(
    Row(label, (scene("t72", source="raycast", scale=scale, spacing=(spacing,)),))
    for label, scale, spacing in (
        ("9.6 m with pixels of 0.3 m", 1.0, 0.3),
        ("190 m with pixels of 3 m", 20.0, 3.0),
        ("0.5 m with pixels of 2 cm", 0.5 / 9.56, 0.02),
    )
)

_TIMES = (
    *(
        Row(f"preset `{name}`", T72, name, paper={"time_s": _published("t72")["time_s"]} if name == "paper" else {})
        for name in (*SHORT_TRAININGS, "paper")
    ),
    *(replace(row, group="preset `paper`, no densification") for row in _density("paper", True, NO_DENSIFICATION)),
)

EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        "rendered",
        "Rendered sets: Tables II and III",
        "24 training views, 48 unseen views at 15, 45 and 75° incidence, 0.3 m pixels, no ground, no speckle. The "
        "paper's figures are its Tables II (images) and III (points), each beside our vehicle of the same name.",
        _rendered(SHORT_TRAININGS),
        (IMAGES, POINTS),
        judged=("cd_m", "f1@0.3", "psnr_db"),
    ),
    Experiment(
        "paper-training",
        "The same sets with the paper's training",
        "The preset `paper` follows the paper's training as far as published: 30,000 iterations of one view, from a "
        "hemisphere, with densification. The paper's figures are its Tables II and III.",
        _rendered(("paper",)),
        (IMAGES, POINTS),
        judged=("cd_m", "f1@0.3", "psnr_db"),
    ),
    Experiment(
        "densification",
        "When densification stops: Table VI",
        "T-72, true images by ray casting, preset `paper`. Densification starts at iteration 500, as in 3D Gaussian "
        "splatting: from the 10,000 of the paper's rendered sets, stopping at 0 and at 10,000 would be the same. The "
        "paper's figures are its Table VI, of the measured T72.",
        _DENSIFICATION,
        (POINTS,),
        axis="iteration at which densification stops",
    ),
    Experiment(
        "density",
        "How many Gaussians at the start: Table VII",
        "T-72, true images by ray casting, without densification. The paper's figures are its Table VII, of the "
        "measured T72.",
        _density("paper", True, NO_DENSIFICATION) + _density("default", False, {}),
        (POINTS,),
        axis="number of Gaussians at the start",
    ),
    Experiment(
        "initialisation",
        "Where the Gaussians start",
        "T-72, true images by ray casting: on the paper's hemisphere, or in the box derived from the images. The paper "
        "has no figures for this.",
        _INITIALISATION,
        (("psnr_target_db", *POINTS),),
    ),
    Experiment(
        "harmonics",
        "How soon the harmonics grow",
        "T-72, true images by ray casting, preset `paper`: iterations between two degrees of the spherical harmonics. "
        "The paper takes 2,500 and says, without figures, that growing too fast harms the points.",
        _HARMONICS,
        (("psnr_target_db", *POINTS),),
        axis="iterations between two degrees",
        claim={"cd_m": -1, "f1@0.3": 1},
    ),
    Experiment(
        "loss",
        "The loss",
        "T-72, true images by ray casting: L1 of amplitudes with a share of SSIM. The paper does not say which loss it "
        "uses; 0.2 is that of 3D Gaussian splatting.",
        _LOSS,
        (("psnr_target_db", "ssim", *POINTS),),
        axis="weight of SSIM",
    ),
    Experiment(
        "harder",
        "Harder cases",
        "Mean over the four vehicles, true images by ray casting, scored on the same 48 unseen, clean views; preset "
        "`default`, for speckle and ground the one that `reconstruct` takes by itself. Random views lie between 15 and "
        "75° grazing; views, speckle and reflectivities are drawn from the seed. Where there is ground, the PSNR is of "
        "target and ground together, so it does not compare. The paper has no figures for these.",
        _HARDER,
        (("psnr_target_db", *POINTS),),
    ),
    Experiment(
        "sizes",
        "Targets of any size",
        "A T-72 and models of it of other sizes, with pixels that suit them; true images by ray casting, preset "
        "`default`, one training at a time. A cell is the resolution; a target that is larger in cells shows more "
        "detail. The paper has no figures for these.",
        _SIZES,
        (("psnr_target_db", "cd_cells", "f1@cell", "f1@third", "time_s"),),
        judged=("cd_cells", "f1@cell", "time_s"),
        alone=True,
    ),
    Experiment(
        "times",
        "Training times",
        "T-72, true images by ray casting; one training at a time, on one thread. The paper's times are those of "
        "its Table II and of the text above its Table VII, on GPUs: compare their growth, not their values. Seconds "
        "are of the machine that measured them: compare them with each other.",
        _TIMES,
        (("time_s",),),
        judged=("time_s",),
        axis="number of Gaussians at the start",
        alone=True,
    ),
    CONDITIONS_GRID,
    SURFACES,
    BASELINES,
    BASELINES_ON_CHIPS,
    *MEASURED,
    RECOGNISE,
)
