"""The figures that SAR-GS published (its Tables I and II)."""

from __future__ import annotations

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.tables import Scores

_PUBLISHED = {
    "T72": {"psnr_db": 35.91, "ssim": 0.9943, "lpips": 0.0165, "cd_m": 0.187, "f1@0.3": 0.925, "time_s": 400},
    "BTR70": {"psnr_db": 34.35, "ssim": 0.9928, "lpips": 0.0176, "cd_m": 0.228, "f1@0.3": 0.846, "time_s": 358},
    "KRAZ": {"psnr_db": 37.33, "ssim": 0.9969, "lpips": 0.0109, "cd_m": 0.207, "f1@0.3": 0.862, "time_s": 376},
}
"""By target and key of the metric. The paper does not state its F1 threshold; 0.3 m is the most lenient of ours."""

NOT_THE_SAME_EXPERIMENT = (
    "The paper's figures are not the same experiment: its targets and images are not published, its truth is rendered "
    "by its own method, and its F1 threshold and Chamfer distance are not defined."
)
"""What must stand wherever the paper's figures stand beside others."""


def paper_scores(target: str) -> Scores:
    """Published scores of one target.

    Parameters
    ----------
    target : str
        T72, BTR70 or KRAZ, in any case.

    Raises
    ------
    SarsplatError
        If the paper has no such target.
    """
    if target.upper() not in _PUBLISHED:
        raise SarsplatError(f"the paper has no row for {target!r}; it has {', '.join(_PUBLISHED)}")
    return Scores(f"paper, {target.upper()}", _PUBLISHED[target.upper()])


def paper_beside(dataset: Dataset) -> Scores | None:
    """What the paper published of this dataset's target, of the T72 where it has none.

    None unless the views are the paper's and the images show the target alone, without speckle, as the paper's do.
    """
    if dataset.protocol != "paper" or dataset.ground or dataset.looks is not None:
        return None
    return paper_scores(dataset.target if dataset.target.upper() in _PUBLISHED else "T72")
