"""Published scores of SAR-GS: Tables II and III (rendered sets), VI and VII (ablations on the measured T72)."""

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.tables import Scores


def _points(*row: float) -> dict[str, float]:
    """Return a row of Tables III, VI and VII (columns R→G, G→R, CD, P, R, F1) by the keys of `metrics.json`.

    R→G goes with precision and G→R with recall (docs/concepts/paper-map.md). The paper does not state its F1 threshold;
    0.3 m is the largest here.
    """
    keys = ("accuracy_m", "completeness_m", "cd_m", "precision@0.3", "recall@0.3", "f1@0.3")
    return dict(zip(keys, row, strict=True))


_PUBLISHED: dict[str, dict[str, float]] = {
    "T72": {
        **{"psnr_db": 35.91, "ssim": 0.9943, "lpips": 0.0165, "time_s": 400},
        **_points(0.198, 0.175, 0.187, 0.957, 0.896, 0.925),
    },
    "BTR70": {
        **{"psnr_db": 34.35, "ssim": 0.9928, "lpips": 0.0176, "time_s": 358},
        **_points(0.236, 0.220, 0.228, 0.876, 0.819, 0.846),
    },
    "KRAZ": {
        **{"psnr_db": 37.33, "ssim": 0.9969, "lpips": 0.0109, "time_s": 376},
        **_points(0.206, 0.208, 0.207, 0.934, 0.800, 0.862),
    },
}
"""Tables II and III (rendered sets): scores by target. Times are those of an RTX 3060 Ti."""

PAPER_DENSIFICATION: dict[int, dict[str, float]] = {
    0: _points(0.125, 0.181, 0.153, 0.984, 0.906, 0.944),
    10_000: _points(0.129, 0.184, 0.157, 0.987, 0.905, 0.944),
    12_000: _points(0.127, 0.190, 0.159, 0.989, 0.892, 0.938),
    15_000: _points(0.132, 0.187, 0.160, 0.981, 0.900, 0.939),
    18_000: _points(0.130, 0.199, 0.165, 0.987, 0.890, 0.936),
    20_000: _points(0.136, 0.193, 0.164, 0.984, 0.895, 0.938),
}
"""Table VI (measured T72): scores by the iteration at which densification stops; 0 is without densification."""

PAPER_DENSITY: dict[int, dict[str, float]] = {
    30_000: _points(0.131, 0.207, 0.169, 0.990, 0.865, 0.924) | {"time_s": 560},
    50_000: _points(0.125, 0.181, 0.153, 0.983, 0.907, 0.944),
    70_000: _points(0.119, 0.189, 0.154, 0.986, 0.907, 0.945),
    90_000: _points(0.117, 0.184, 0.151, 0.985, 0.920, 0.951),
    110_000: _points(0.112, 0.185, 0.148, 0.987, 0.918, 0.952) | {"time_s": 1485},
}
"""Table VII (measured T72): scores by the number of Gaussians at the start; the two times are in the text above it."""

NOT_THE_SAME_EXPERIMENT = (
    "The paper's figures are not the same experiment: its targets and images are not published, its truth is rendered "
    "by its own method, and its F1 threshold and Chamfer distance are not defined."
)
"""Caveat, shown wherever the paper's figures are compared with others."""


def paper_scores(target: str) -> Scores:
    """Published scores of one target: T72, BTR70 or KRAZ, in any case; others raise `SarsplatError`."""
    if target.upper() not in _PUBLISHED:
        raise SarsplatError(f"the paper has no row for {target!r}; it has {', '.join(_PUBLISHED)}")
    return Scores(f"paper, {target.upper()}", _PUBLISHED[target.upper()])


def paper_beside(dataset: Dataset) -> Scores | None:
    """The paper's scores of this dataset's target, if it published any.

    None unless the views are the paper's and the images show the target alone, without speckle, as the paper's do.
    """
    same = dataset.protocol == "paper" and not dataset.ground and dataset.looks is None
    return paper_scores(dataset.target) if same and dataset.target.upper() in _PUBLISHED else None
