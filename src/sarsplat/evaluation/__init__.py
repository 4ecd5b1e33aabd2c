"""Scores of images against unseen views and of points against the true surface, and baselines for both."""

from sarsplat.evaluation.baselines import baseline_scores, nearest_chip, rotated_average
from sarsplat.evaluation.evaluate import evaluate_run
from sarsplat.evaluation.images import (
    MaskPair,
    Registration,
    UndefinedScore,
    log_correlation,
    nats_per_pixel,
    predicted_masks,
    psnr_db,
    psnr_target_db,
    register,
    registered_log_correlation,
    ssim,
)
from sarsplat.evaluation.lpips import Lpips, lpips
from sarsplat.evaluation.metrics import (
    AZIMUTH_METRICS,
    IMAGE_METRICS,
    MASK_METRICS,
    RUN_METRICS,
    UNSEEN_METRICS,
    Metric,
    all_metrics,
    metrics_of_points,
)
from sarsplat.evaluation.paper import (
    NOT_THE_SAME_EXPERIMENT,
    PAPER_DENSIFICATION,
    PAPER_DENSITY,
    paper_beside,
    paper_scores,
)
from sarsplat.evaluation.points import Alignment, PointMetrics, Yardstick, align, point_metrics
from sarsplat.evaluation.surface import VisibleSurface, read_truth_mesh, visible_surface
from sarsplat.evaluation.tables import (
    Beaten,
    Scores,
    beaten,
    beaten_by_baselines,
    comparison,
    metrics_table,
    summary_metrics,
)

__all__ = [
    "AZIMUTH_METRICS",
    "IMAGE_METRICS",
    "MASK_METRICS",
    "NOT_THE_SAME_EXPERIMENT",
    "PAPER_DENSIFICATION",
    "PAPER_DENSITY",
    "RUN_METRICS",
    "UNSEEN_METRICS",
    "Alignment",
    "Beaten",
    "Lpips",
    "MaskPair",
    "Metric",
    "PointMetrics",
    "Registration",
    "Scores",
    "UndefinedScore",
    "VisibleSurface",
    "Yardstick",
    "align",
    "all_metrics",
    "baseline_scores",
    "beaten",
    "beaten_by_baselines",
    "comparison",
    "evaluate_run",
    "log_correlation",
    "lpips",
    "metrics_of_points",
    "metrics_table",
    "nats_per_pixel",
    "nearest_chip",
    "paper_beside",
    "paper_scores",
    "point_metrics",
    "predicted_masks",
    "psnr_db",
    "psnr_target_db",
    "read_truth_mesh",
    "register",
    "registered_log_correlation",
    "rotated_average",
    "ssim",
    "summary_metrics",
    "visible_surface",
]
