"""Fill the README's performance section and docs/images/growth.png from the files in benchmarks/results.

Run as the last step of `make bench`, or as `python benchmarks/readme_performance.py`.
"""

from __future__ import annotations

import json
import sys
import textwrap
from typing import Any

from clock import TURN
from draw_growth import draw
from recipes import COUNT
from results import REPOSITORY, RESULTS

sys.path.insert(0, str(REPOSITORY / "docs"))

from fill_block import fill_block

README, PICTURE = REPOSITORY / "README.md", REPOSITORY / "docs" / "images" / "growth.png"


def ms(seconds: float) -> str:
    """Three digits, in milliseconds below a second."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def times(found: dict[str, float]) -> str:
    """A ratio and where 80 % of its samples are."""
    return f"{found['median']:.3g} × ({found['p10']:.3g} … {found['p90']:.3g})"


def cpu_table(parts: dict[str, Any]) -> str:
    """Ratios of the CPU engine and the times behind them, as Markdown; no row for a training that was not run."""
    naive, floor, iteration = parts["naive"], parts["floor"], parts["iteration"]
    growth, alone = parts["growth"], iteration["view_s"]["one view"]["median"]
    few, many = (f"{iteration['gaussians'][size]:,}" for size in ("few", "many"))
    largest = growth["series"]["gaussians"][-1]
    rows = [
        (
            times(naive["ratios"]["plain torch / engine"]),
            "plain PyTorch / engine, forward and backward of one view",
            f"{ms(naive['times']['plain torch']['median'])} / {ms(naive['times']['engine']['median'])}",
        ),
        (
            times(floor["ratios"]["engine / floor of visited blocks"]),
            "engine / its floor, the mere arithmetic of the blocks it visits",
            f"{ms(floor['times']['engine forward + backward']['median'])} / "
            f"{ms(floor['times']['floor of visited blocks']['median'])}",
        ),
        (
            times(floor["ratios"]["pair loops / floor of visited blocks"]),
            "its loops over these blocks alone / the floor; the rest is per Gaussian, seen or not: "
            f"{ms(floor['times']['the same Gaussians unseen']['median'])}",
            "",
        ),
        (
            times(iteration["ratios"]["a view of 8 / a view alone"]),
            f"a view in a training step of 8 / a step of one view, {few} Gaussians, loss and Adam included",
            f"{ms(iteration['view_s']['8 views']['median'])} / {ms(alone)}",
        ),
        (
            times(iteration["ratios"][f"{many} / {few} Gaussians, a view alone"]),
            f"a step of one view with {many} Gaussians / with {few}",
            f"{ms(iteration['view_s_many']['one view']['median'])} / {ms(alone)}",
        ),
        *twin_rows(parts["twins"]),
        *((times(found), name, "") for name, found in parts["degenerate"]["ratios"].items()),
        *((found, name, "") for name, found in parts["determinism"]["ratios"].items()),
        *(
            (f"exponent {growth['slopes'][name.lower()]:.2f}", f"growth of time with {name}; 1 is linear", "")
            for name in ("Gaussians", "pixels")
        ),
        (
            f"{largest['process_bytes'] / 2**30:.2f} GiB",
            f"{largest['gaussians']:,} Gaussians on {largest['side']} × {largest['side']} pixels: the whole process at "
            "its peak; forward and backward",
            ms(largest["seconds"]["median"]),
        ),
    ]
    if "paper" in parts:
        paper = parts["paper"]
        rows.append(
            (
                f"{paper['paper_s'] / paper['training_s']:.1f} ×",
                "the paper's training on an RTX 3060 Ti / "
                f"`--preset paper` on these cores, {paper['iterations']:,} iterations",
                f"{paper['paper_s']:.0f} s / {paper['training_s']:.0f} s",
            )
        )
    return markdown(("ratio (10 … 90 %)", "of what", "times"), rows)


def twin_rows(twins: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Loss and Adam: PyTorch over the engine."""
    rows = []
    for key, found in twins["ratios"].items():
        name = key.removesuffix(": torch / engine")
        rivals = " / ".join(ms(twins["times"][f"{name}: {who}"]["median"]) for who in ("torch", "engine"))
        rows.append((times(found), f"PyTorch / engine: {name}", rivals))
    return rows


def how(results: dict[str, Any]) -> str:
    """What was measured where, and what memory it takes."""
    machine, parts = results["machine"], results["parts"]
    each, live = parts["growth"]["bytes_each"], parts["floor"]["ratios"]
    text = (
        f"Measured by `make bench` on {machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, "
        f"{machine['instruction_set']}, PyTorch {machine['torch']}, {machine['date']}: {COUNT:,} Gaussians as they "
        "are halfway through a T-72, 128 × 128 pixels, four rays to a pixel, unless said otherwise; rivals in turns of "
        f"{TURN} calls in one process, medians, and the 10th and 90th percentile of the ratios of neighbours in time. "
        "The floor takes "
        "the rate at which these cores multiply matrices in the same minute, "
        f"{parts['floor']['rate_flop_s'] / 1e9:.0f} GFlop/s; of the visited lanes "
        f"{100 * live['live lanes, attenuation']:.0f} % are live on the computation plane and "
        f"{100 * live['live lanes, imaging']:.0f} % on the imaging plane. A pass takes at its peak "
        f"{each['gaussian']:.0f} bytes a Gaussian and {each['pixel']:.0f} a pixel with its rays, gradients included."
    )
    return textwrap.fill(text, 120) + "\n"


def cuda_table(devices: list[dict[str, Any]]) -> str:
    """What `cuda_check.py` found on every device, as Markdown, or that there was none."""
    if not devices:
        return "CUDA: not run on a GPU.\n"
    rows = []
    for found in devices:
        for work in found["workloads"].values():
            count = work["views"]
            scene = f"{work['gaussians']:,} Gaussians, {work['side']} × {work['side']} pixels"
            views = f"{count} view{'s' * (count > 1)}"
            share = f"{100 * work['share_of_peak']:.1f} %"
            rows.append(
                (share, f"{found['device']}, forward and backward: {scene}, {views}", ms(work["view_s"]["median"]))
            )
        step, beside = found["training_step"], found["gsplat"]
        rows.append(("", "the first as a training step, L1 and Adam included", ms(step["view_s"]["median"])))
        if beside:
            rivals = " / ".join(ms(beside["view_s"][who]["median"]) for who in ("gsplat", "engine"))
            rows.append((f"{beside['gsplat / engine']:.2f} ×", "gsplat, orthographic / engine, the first", rivals))
    return markdown(("share of the device's multiply-add rate", "CUDA", "a view"), rows)


def markdown(head: tuple[str, str, str], rows: list[tuple[str, str, str]]) -> str:
    """A table of three columns."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|---:|---|---:|", *lines[1:]]) + "\n"


def section(results: dict[str, Any], devices: list[dict[str, Any]]) -> str:
    """All of it, as Markdown."""
    picture = "![Time of forward and backward against Gaussians and against pixels](docs/images/growth.png)\n"
    return "\n".join([cpu_table(results["parts"]), how(results), picture, cuda_table(devices)])


def main() -> None:
    """Rewrite the README's block and the picture."""
    path = RESULTS / "cpu.json"
    if not path.is_file():
        sys.exit(f"{path} does not exist; run `make bench`")
    results = json.loads(path.read_text(encoding="utf-8"))
    if results["machine"]["quick"]:
        sys.exit(f"{path} is from a quick run, whose numbers mean nothing; run `make bench`")
    devices = [json.loads(found.read_text(encoding="utf-8")) for found in sorted(RESULTS.glob("cuda-*.json"))]
    fill_block(README, "performance", section(results, devices))
    draw(results["parts"]["growth"], PICTURE)


if __name__ == "__main__":
    main()
