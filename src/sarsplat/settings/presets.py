"""Presets of settings."""

from dataclasses import replace

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, advised, shown
from sarsplat.settings.config import Config
from sarsplat.settings.sections import (
    Densification,
    FlatGround,
    Passes,
    PointExtraction,
    Rates,
    Relocation,
    Surroundings,
)

PRESETS: dict[str, Config] = {
    # best scores on noise-free images
    "default": Config(),
    # rough result in a quarter of the time
    "quick": Config(
        preset="quick",
        iterations=400,
        gaussians_per_cell=24.0,
        scale_bounds=(0.067, 0.6),
        fine_from=1.0,
        rates=Rates(means=0.33),
        points=PointExtraction(rays_per_pixel=7.0, voxel=0.083),
    ),
    # speckle without ground: averaged by larger Gaussians with more uniform scattering, and learned by long trainings
    "speckled": Config(
        preset="speckled",
        iterations=300,
        views_per_step=8,
        gaussians_per_cell=18.0,
        loss="speckle",
        total_power=0.05,
        scattering_penalty=0.3,
        law_penalty=3e-4,
        dropout=0.1,
        initial_scale=0.27,
        scale_bounds=(0.2, 0.83),
        fine_from=1.0,
        rates=Rates(means=0.33),
        relocation=Relocation(idle_share=0.01),
        points=PointExtraction(optical_depth=0.5, voxel=0.067, behind=0.25),
    ),
    # speckle on ground, any number of objects: few, large Gaussians, most of them dropped at each step, do not learn
    # single speckles; learning/evidence.py switches on further parts that the images need
    "scene": Config(
        preset="scene",
        iterations=300,
        views_per_step=8,
        gaussians_per_cell=18.0,
        loss="speckle",
        unit="target",
        scattering_penalty=3.0,
        law_penalty=3e-4,
        dropout=0.7,
        initial_scale=0.27,
        scale_bounds=(0.2, 0.83),
        fine_from=1.0,
        rates=Rates(means=0.33, nuisance=0.03),
        points=PointExtraction(
            voxel=0.067, seen_through=0.4, behind=0.7, seen_by=5, clusters="bright", cluster_radius=0.7
        ),
        relocation=Relocation(idle_share=0.01, alike_from=10.0),
        ground=FlatGround(from_images=True),
        surroundings=Surroundings(noise_floor=0.01, shift_std=0.0, gain_std=0.0, side_lobes=0.0, texture_looks=0.0),
    ),
    # the paper's training, as far as it is stated (docs/concepts/paper-map.md)
    "paper": Config(
        preset="paper",
        iterations=30_000,
        views_per_step=1,
        gaussians=15_000,
        coarsest=1,
        initialisation="hemisphere",
        initial_scale=0.27,
        ssim_weight=0.2,
        scattering="harmonics",
        p_min=0.0,
        scattering_penalty=0.0,
        initial_optical_depth=0.1,
        scale_bounds=(0.033, 1.0),
        harmonics_every=2500,
        few_views=0.0,
        fine_from=1.0,
        rates=Rates(
            means=0.033,
            means_end=0.0017,
            log_scales=0.005,
            quaternions=0.001,
            scattering=0.01,
            directional_scattering=0.0005,
        ),
        densification=Densification(),
        relocation=Relocation(rounds=0),
        points=PointExtraction("centres", optical_depth=0.01, voxel=0.067),
        checkpoint_every=2500,
    ),
    # real chips: ground, noise floor, shift and gain of each chip, speckle likelihood. Gaussians of about a cell
    # average speckle; edges of larger opaque ones would be visible; glints are 20 dB above the ground, so rates of the
    # harmonics are high
    "measured": Config(
        preset="measured",
        iterations=800,
        views_per_step=8,
        gaussians_per_cell=18.0,
        fewest_gaussians=12_000,
        coarsest=1,
        loss="speckle",
        scattering="harmonics",
        p_min=0.2,
        scattering_penalty=0.0,
        initial_scale=0.8,
        initial_optical_depth=0.1,
        initial_scattering=1.0,
        scale_bounds=(0.65, 1.0),
        harmonics_every=50,
        views_per_coefficient=2.0,
        directional_std=2.0,
        sparsity=0.1,
        dropout=0.25,
        few_views=0.0,
        fine_from=1.0,
        rates=Rates(
            means=0.16, quaternions=0.01, log_scales=0.02, scattering=0.4, directional_scattering=0.1, shift=0.1
        ),
        relocation=Relocation(rounds=0),
        points=PointExtraction(
            optical_depth=1.25,
            voxel=0.32,
            min_height=0.3,
            rays_per_pixel=4.0,
            seen_through=0.5,
            behind=1.0,
            seen_by=5,
            cluster_radius=0.7,
        ),
        ground=FlatGround(std=0.3),
        surroundings=Surroundings(),
    ),
    # interferometric stacks: the whole scene, ground included, is Gaussians of one size, which move in elevation
    "stack": Config(
        preset="stack",
        iterations=250,
        views_per_step=8,
        coarsest=1,
        loss="passes",
        scattering="harmonics",
        p_min=1e-3,
        scattering_penalty=0.1,
        initial_scale=0.42,
        initial_optical_depth=0.15,
        scale_bounds=(0.42, 0.42),
        harmonics_degree=0,
        few_views=0.0,
        fine_from=1.0,
        rates=Rates(means=0.083, means_end=0.004, quaternions=0.0, log_optical_depth=0.08, scattering=0.05),
        relocation=Relocation(rounds=4, idle_share=0.01),
        points=PointExtraction("centres", optical_depth=0.0, power_share=0.97, voxel=0.1, min_height=-1e6),
        passes=Passes(),
    ),
}
"""Known presets by name."""

# several polarisations: a matrix for each Gaussian. Materials differ, and sparsity and dropout keep faint Gaussians
# from mixing those that share pixels.
PRESETS["polarimetric"] = replace(
    PRESETS["stack"],
    preset="polarimetric",
    scattering="polarimetric",
    scattering_penalty=0.0,
    sparsity=0.2,
    dropout=0.2,
)


@checks_arguments
def preset(name: str) -> Config:
    """Return a preset by name; raise if it is unknown."""
    if name not in PRESETS:
        raise SarsplatError(f"preset {shown(name)} is unknown; {advised(name, PRESETS)}")
    return PRESETS[name]
