"""Scores: images against unseen views, points against the true surface, and what both are to be compared with."""

from sarsplat.evaluation.evaluation import IMAGE_METRICS, POINT_METRICS, evaluate_run
from sarsplat.evaluation.images import log_correlation, nats_per_pixel, psnr_db, psnr_target_db, ssim
from sarsplat.evaluation.lpips import Lpips, lpips
from sarsplat.evaluation.points import PointMetrics, point_metrics
from sarsplat.evaluation.surface import VisibleSurface, visible_surface
from sarsplat.evaluation.tables import PaperRow, metrics_table, paper_row
from sarsplat.evaluation.yardsticks import nearest_chip, rotated_average, yardstick_scores

__all__ = [
    "IMAGE_METRICS",
    "POINT_METRICS",
    "Lpips",
    "PaperRow",
    "PointMetrics",
    "VisibleSurface",
    "evaluate_run",
    "log_correlation",
    "lpips",
    "metrics_table",
    "nats_per_pixel",
    "nearest_chip",
    "paper_row",
    "point_metrics",
    "psnr_db",
    "psnr_target_db",
    "rotated_average",
    "ssim",
    "visible_surface",
    "yardstick_scores",
]
