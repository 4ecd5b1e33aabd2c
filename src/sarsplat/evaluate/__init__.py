"""Scores: images against unseen views, points against the true surface, and what both are to be compared with."""

from sarsplat.evaluate.evaluation import IMAGE_METRICS, POINT_METRICS, evaluate_run
from sarsplat.evaluate.images import log_correlation, nats_per_pixel, psnr_db, psnr_target_db, ssim
from sarsplat.evaluate.lpips import Lpips, lpips
from sarsplat.evaluate.points import PointMetrics, point_metrics
from sarsplat.evaluate.surface import VisibleSurface, visible_surface
from sarsplat.evaluate.tables import PaperRow, metrics_table, paper_row
from sarsplat.evaluate.yardsticks import nearest_chip, rotated_average, yardstick_scores

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
