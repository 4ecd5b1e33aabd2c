"""Draw the four vehicles and their SAR images, and hold the T-72's outlines against measured MSTAR chips.

Run as `python docs/draw_vehicles.py`, or with the other figures as `make figures`. Writes figures/vehicles.png and
docs/images/vehicles.png. Where the measured chips are at hand (../shared/data/mstar) it also writes
figures/t72-beside-mstar.png, prints the tables and fills them into docs/reference/vehicles.md.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from fill_block import fill_block
from matplotlib.axes import Axes
from outlines import FILTERS, RULE, Outline, Rule, despeckled, iou, outline

from sarsplat import ScatteringLaw, View, radar_frame
from sarsplat.colours import POWER, SHADOW, TARGET, colormap
from sarsplat.importers import import_mstar
from sarsplat.radiometry import to_db
from sarsplat.scenes import add_speckle, mstar_grid, simulate_raycast, target_mesh

HERE = Path(__file__).parent
FIGURES, PICTURE, PAGE = HERE.parent / "figures", HERE / "images" / "vehicles.png", HERE / "reference" / "vehicles.md"
CHIPS = HERE.parents[1] / "shared" / "data" / "mstar"

NAMES = {"t72": "T-72", "btr70": "BTR-70", "2s1": "2S1", "kraz": "KrAZ-255B"}
GRAZING = 17.0
GROUND = 0.04  # γ⁰: −14 dB, grass at X-band near grazing; see docs/reference/vehicles.md
OBLIQUE = View(320.0, 22.0)
AZIMUTHS = (0, 45, 90, 135, 180, 225, 270, 315)
COUNT = 36  # measured chips that are compared, evenly around the vehicle
SHARES = (0.01, 0.0005)  # of the measured ground beyond the thresholds of other rules
RIGHT, TURNED = "T-72, simulated", "T-72, simulated at azimuth + 180°"
CROP = (slice(24, 118), slice(17, 111))  # rows and columns shown: the shadow is on the far side


def simulated(mesh: trimesh.Trimesh, views: list[View], looks: float | None = 1.0) -> np.ndarray:
    """β⁰ on MSTAR's grid, on ground, with speckle, [views, rows, columns]."""
    rng = np.random.default_rng(0)
    images = [simulate_raycast(mesh, view, mstar_grid(), ScatteringLaw(), ground_gamma0=GROUND) for view in views]
    return np.stack(images if looks is None else [add_speckle(image, looks, rng) for image in images])


def show_power(ax: Axes, power: np.ndarray, found: Outline | None = None) -> None:
    """Decibels over the ground's median, and outlines of target (orange) and shadow (blue)."""
    decibels = to_db(power, np.median(power))
    ax.imshow(decibels[CROP], cmap=colormap(POWER), vmin=-15, vmax=25, interpolation="nearest")
    if found is not None:
        for mask, colour in ((found.target, TARGET), (found.shadow, SHADOW)):
            ax.contour(mask[CROP], [0.5], colors=colour, linewidths=1)
    ax.set(xticks=[], yticks=[])


def show_mesh(ax: Axes, mesh: trimesh.Trimesh, view: View, step: float = 0.012) -> None:
    """A mesh as the radar sees it, in parallel projection, facets shaded by their normals and outlines darkened."""
    seen = trimesh.Trimesh(mesh.vertices @ radar_frame(view).T, mesh.faces, process=False)
    (left, low, near), (right, high, _) = seen.bounds + np.array([[-0.1], [0.1]])
    x, y = np.meshgrid(np.arange(left, right, step), np.arange(low, high, step))
    origins = np.stack([x, y, np.full(x.shape, near)], axis=-1).reshape(-1, 3)
    face = seen.ray.intersects_first(origins, np.broadcast_to([0.0, 0.0, 1.0], origins.shape))
    normal = seen.face_normals[face]
    normal = np.where(normal[:, 2:] > 0, -normal, normal)  # towards the onlooker
    shade = 0.25 + 0.75 * np.clip(normal @ (0.45, 0.6, -0.66), 0, 1)
    level = np.where(face >= 0, shade, 1.0).reshape(x.shape)
    corner = seen.triangles[face, 0]
    slope = normal[:, :2] / np.minimum(normal[:, 2:], -1e-3)
    depth = corner[:, 2] - (slope * (origins - corner)[:, :2]).sum(axis=1)
    depth = np.where(face >= 0, depth, 1e3).reshape(x.shape)
    jump = [np.abs(np.diff(depth, axis=axis, append=1e3)) > 5 * step for axis in (0, 1)]
    level[(jump[0] | jump[1]) & (level < 1)] *= 0.4
    ax.imshow(level, cmap=colormap(POWER), vmin=0, vmax=1, origin="lower", extent=(left, right, low, high))
    # x_r, y_r and z_r = away are right-handed: for the onlooker, with y_r up, x_r points to the left
    ax.set(xlim=(4.7, -4.7), ylim=(-2.4, 3.6))
    ax.axis("off")


def draw_meshes() -> None:
    """The committed picture: each vehicle from one oblique side, and its SAR image from there, with speckle."""
    figure, axes = plt.subplots(2, 4, figsize=(10, 4.3), height_ratios=(0.64, 1), layout="constrained")
    for (name, title), (above, below) in zip(NAMES.items(), axes.T, strict=True):
        mesh = target_mesh(name)
        show_mesh(above, mesh, OBLIQUE)
        show_power(below, simulated(mesh, [View(OBLIQUE.azimuth_deg, GRAZING)])[0])
        above.set_title(title, fontsize=11)
    figure.savefig(PICTURE, dpi=75, facecolor="white", pil_kwargs={"optimize": True})
    plt.close(figure)


def draw_around() -> None:
    """Every vehicle from eight azimuths."""
    figure, axes = plt.subplots(4, len(AZIMUTHS), figsize=(16, 8.4), layout="constrained")
    views = [View(float(azimuth), GRAZING) for azimuth in AZIMUTHS]
    for (name, title), row in zip(NAMES.items(), axes, strict=True):
        for ax, power in zip(row, simulated(target_mesh(name), views), strict=True):
            show_power(ax, power)
        row[0].set_ylabel(title, fontsize=12)
    for ax, azimuth in zip(axes[0], AZIMUTHS, strict=True):
        ax.set_title(f"φ = {azimuth}°", fontsize=11)
    figure.savefig(FIGURES / "vehicles.png", dpi=110, facecolor="white")
    plt.close(figure)


def measured_chips() -> tuple[list[View], np.ndarray, np.ndarray]:
    """Views and powers of `COUNT` T-72 chips at 17°, and the power of each one's neighbour in azimuth."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = import_mstar(
            CHIPS, Path(folder) / "t72", labels=CHIPS / "labels.csv", target_class="T72", train_views=COUNT
        )
        views = dataset.select("train").views
        others = np.array([view.azimuth_deg for view in dataset.select("test-17").views])
        nearest = [np.abs((others - view.azimuth_deg + 180) % 360 - 180).argmin() for view in views]
        return list(views), dataset.images("train"), dataset.images("test-17")[nearest]


def compare() -> str:
    """Outlines of simulated images against those of the measured chips, as Markdown; draws some of them."""
    views, measured, neighbours = measured_chips()
    rows = {f"{title}, simulated": simulated(target_mesh(name), views) for name, title in NAMES.items()}
    for turn in (90, 180):
        turned = [View((view.azimuth_deg + turn) % 360, view.grazing_deg) for view in views]
        rows[f"T-72, simulated at azimuth + {turn}°"] = simulated(target_mesh("t72"), turned)
    rows["the measured chip next in azimuth"] = neighbours
    scores = agreement(measured, rows, RULE)
    draw_beside(views, measured, rows[RIGHT], scores[RIGHT])
    bright = {
        title: np.mean([np.sort(despeckled(power), axis=None)[-900:].mean() for power in images])
        for title, images in (("measured", measured), ("simulated", rows[RIGHT]))
    }
    print(
        "brightest 900 despeckled pixels over the ground's median:", {k: round(float(v), 1) for k, v in bright.items()}
    )
    return f"{score_table(scores)}\n{rule_table(measured, rows)}"


def agreement(measured: np.ndarray, rows: dict[str, np.ndarray], rule: Rule) -> dict[str, np.ndarray]:
    """IoU of target and of shadow [chips, 2] of each row's images with the measured ones."""
    ours = [outline(power, rule).centred() for power in measured]
    scores = {}
    for title, images in rows.items():
        theirs = [outline(power, rule).centred() for power in images]
        pairs = zip(ours, theirs, strict=True)
        scores[title] = np.array([(iou(a.target, b.target), iou(a.shadow, b.shadow)) for a, b in pairs])
    return scores


def score_table(scores: dict[str, np.ndarray]) -> str:
    """Mean and standard deviation of every score, as Markdown."""
    right = scores[RIGHT]
    lines = ["| against the measured T-72 | IoU of target | IoU of shadow | mean of both | the T-72 is better at |"]
    lines += ["|---|---|---|---|---|"]
    for title, score in scores.items():
        both = np.column_stack([score, score.mean(axis=1)])
        cells = [f"{mean:.3f} ± {sd:.3f}" for mean, sd in zip(both.mean(axis=0), both.std(axis=0, ddof=1), strict=True)]
        wins = int((right.mean(axis=1) > score.mean(axis=1)).sum())
        cells.append("–" if score is right else f"{wins} of {len(score)}")
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def rule_table(measured: np.ndarray, rows: dict[str, np.ndarray]) -> str:
    """Mean scores under other rules, as Markdown."""
    lines = [
        "| filter | of the ground beyond each threshold | thresholds | T-72: target | shadow | mean of both "
        "| best other vehicle | T-72 at + 180° |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, smooth in FILTERS.items():
        for share in SHARES:
            rule = Rule.passing(smooth, share, measured)
            scores = {title: score.mean(axis=0) for title, score in agreement(measured, rows, rule).items()}
            target, shadow = scores[RIGHT]
            others = {title: scores[f"{title}, simulated"].mean() for title in NAMES.values() if title != NAMES["t72"]}
            best = max(others, key=others.__getitem__)
            lines.append(
                f"| {name} | {100 * share:g} % | {rule.bright:.2f}, {rule.dark:.2f} | {target:.3f} | {shadow:.3f} "
                f"| {(target + shadow) / 2:.3f} | {others[best]:.3f} ({best}) | {scores[TURNED].mean():.3f} |"
            )
    return "\n".join(lines) + "\n"


def draw_beside(views: list[View], measured: np.ndarray, ours: np.ndarray, score: np.ndarray) -> None:
    """Measured above simulated, both with their outlines, at every fourth azimuth."""
    shown = range(0, len(views), 4)
    figure, axes = plt.subplots(2, len(shown), figsize=(2.1 * len(shown), 4.9), layout="constrained")
    for k, (above, below) in zip(shown, axes.T, strict=True):
        show_power(above, measured[k], outline(measured[k]))
        show_power(below, ours[k], outline(ours[k]))
        above.set_title(f"φ = {views[k].azimuth_deg:.0f}°", fontsize=11)
        below.set_xlabel(f"IoU {score[k, 0]:.2f}, shadow {score[k, 1]:.2f}", fontsize=9)
    axes[0, 0].set_ylabel("measured", fontsize=12)
    axes[1, 0].set_ylabel("simulated", fontsize=12)
    figure.savefig(FIGURES / "t72-beside-mstar.png", dpi=110, facecolor="white")
    plt.close(figure)


def main() -> None:
    """Draw all, and fill the tables."""
    FIGURES.mkdir(exist_ok=True)
    draw_meshes()
    draw_around()
    if not (CHIPS / "labels.csv").is_file():
        print(
            f"There are no measured chips in {CHIPS}, so the T-72 is not compared and "
            "docs/reference/vehicles.md is not changed."
        )
        return
    text = compare()
    print(text)
    fill_block(PAGE, "vehicles", text)


if __name__ == "__main__":
    main()
