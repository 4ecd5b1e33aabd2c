# ruff: isort: skip_file
from .baselines import (
    baseline_scores as baseline_scores,
    nearest_chip as nearest_chip,
    rotated_average as rotated_average,
)
from .evaluate import evaluate_run as evaluate_run
from .images import (
    MaskPair as MaskPair,
    Registration as Registration,
    UndefinedScore as UndefinedScore,
    log_correlation as log_correlation,
    nats_per_pixel as nats_per_pixel,
    predicted_masks as predicted_masks,
    psnr_db as psnr_db,
    psnr_target_db as psnr_target_db,
    register as register,
    registered_log_correlation as registered_log_correlation,
    ssim as ssim,
)
from .lpips import Lpips as Lpips, lpips as lpips
from .metrics import (
    AZIMUTH_METRICS as AZIMUTH_METRICS,
    IMAGE_METRICS as IMAGE_METRICS,
    MASK_METRICS as MASK_METRICS,
    RUN_METRICS as RUN_METRICS,
    UNSEEN_METRICS as UNSEEN_METRICS,
    Metric as Metric,
    all_metrics as all_metrics,
    metrics_of_points as metrics_of_points,
)
from .paper import (
    NOT_THE_SAME_EXPERIMENT as NOT_THE_SAME_EXPERIMENT,
    PAPER_DENSIFICATION as PAPER_DENSIFICATION,
    PAPER_DENSITY as PAPER_DENSITY,
    paper_beside as paper_beside,
    paper_scores as paper_scores,
)
from .points import (
    Alignment as Alignment,
    PointMetrics as PointMetrics,
    Yardstick as Yardstick,
    align as align,
    point_metrics as point_metrics,
)
from .surface import (
    VisibleSurface as VisibleSurface,
    read_truth_mesh as read_truth_mesh,
    visible_surface as visible_surface,
)
from .tables import (
    Beaten as Beaten,
    Scores as Scores,
    beaten as beaten,
    beaten_by_baselines as beaten_by_baselines,
    comparison as comparison,
    metrics_table as metrics_table,
    summary_metrics as summary_metrics,
)
