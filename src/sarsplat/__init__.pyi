"""What `sarsplat` offers, by the folder that defines it: read by type checkers, and when the package is imported."""
# ruff: isort: skip_file

__all__: list[str]

from .data import (
    Dataset as Dataset,
    DatasetEntry as DatasetEntry,
    SarImage as SarImage,
    read_dataset as read_dataset,
    read_gaussians_ply as read_gaussians_ply,
    read_points_ply as read_points_ply,
    read_terrain as read_terrain,
    write_dataset as write_dataset,
    write_gaussians_ply as write_gaussians_ply,
    write_points_ply as write_points_ply,
    write_terrain as write_terrain,
)
from .errors import SarsplatError as SarsplatError, SarsplatWarning as SarsplatWarning
from .evaluation import evaluate_run as evaluate_run, point_metrics as point_metrics, visible_surface as visible_surface
from .examination import examine as examine
from .exports import export as export
from .gaussians import (
    MAX_OPTICAL_DEPTH as MAX_OPTICAL_DEPTH,
    MIN_SCALE as MIN_SCALE,
    Gaussians as Gaussians,
    Ground as Ground,
    Harmonics as Harmonics,
    NormalLobes as NormalLobes,
    Polarimetric as Polarimetric,
    Scattering as Scattering,
)
from .geometry import (
    ImageGrid as ImageGrid,
    Place as Place,
    RayGrid as RayGrid,
    Stack as Stack,
    Terrain as Terrain,
    Turn as Turn,
    View as View,
    radar_frame as radar_frame,
)
from .importers import (
    PhoenixChip as PhoenixChip,
    import_folder as import_folder,
    import_mstar as import_mstar,
    import_phase_history as import_phase_history,
    import_rslc as import_rslc,
    import_sample as import_sample,
    import_sicd as import_sicd,
    import_stack as import_stack,
    read_phoenix as read_phoenix,
)
from .learning import LOSSES as LOSSES, Trainer as Trainer, stack_nats as stack_nats
from .recognition import locate as locate
from .renderer import (
    Attenuation as Attenuation,
    Footprints as Footprints,
    GroundBounce as GroundBounce,
    Projection as Projection,
    RayMap as RayMap,
    Rendering as Rendering,
    Waves as Waves,
    attenuate as attenuate,
    project as project,
    render as render,
    render_covariances as render_covariances,
    splat as splat,
)
from .report import write_report as write_report
from .runs import Run as Run, reconstruct as reconstruct
from .samples import chips as chips
from .scenes import (
    Mechanisms as Mechanisms,
    ScatteringLaw as ScatteringLaw,
    add_speckle as add_speckle,
    load_mesh as load_mesh,
    mstar_grid as mstar_grid,
    mstar_views as mstar_views,
    paper_grid as paper_grid,
    paper_views as paper_views,
    simulate_raycast as simulate_raycast,
    simulate_stack as simulate_stack,
    target_mesh as target_mesh,
)
from .scenes.simulate import simulate_images as simulate_images
from .settings import PRESETS as PRESETS, Config as Config, preset as preset
from .surface import extract_points as extract_points
from .sweeps import sweep as sweep
from .viewer import Viewer as Viewer

__version__: str
