"""Fill the README's performance section and docs/images/growth.png from the files in benchmarks/results.

Run as the last step of `make bench`, or as `python benchmarks/readme_performance.py`.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

from clock import TURN
from draw_growth import draw
from recipes import COUNT
from results import REPOSITORY, RESULTS

from sarsplat.evaluation import Yardstick, all_metrics, paper_scores
from sarsplat.scenes import paper_grid

sys.path.insert(0, str(REPOSITORY / "docs"))

from fill_block import fill_block

README, PICTURE = REPOSITORY / "README.md", REPOSITORY / "docs" / "images" / "growth.png"
GOOD_HIGH, GOOD_LOW = "↑", "↓"


def ms(seconds: float) -> str:
    """Three digits, in milliseconds below a second."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def row(good: str, found: dict[str, float], what: str, *rivals: dict[str, float] | float) -> tuple[str, str, str]:
    """A ratio and where 80 % of its samples are, what it is of, and the times of both."""
    spread = f"{found['median']:.3g} × {good} ({found['p10']:.3g} … {found['p90']:.3g})"
    return spread, what, " / ".join(ms(each if isinstance(each, float) else each["median"]) for each in rivals)


def ratio_table(parts: dict[str, Any]) -> str:
    """Ratios and the times behind them, as Markdown; no row for a training that was not run."""
    naive, floor, iteration = parts["naive"], parts["floor"], parts["iteration"]
    few, many = (f"{iteration['gaussians'][size]:,}" for size in ("few", "many"))
    alone, bound = iteration["view_s"]["one view"], floor["times"]["floor of visited blocks"]
    rows = [
        row(
            GOOD_HIGH,
            naive["ratios"]["plain torch / engine"],
            "plain PyTorch / engine: forward and backward together",
            naive["times"]["plain torch"],
            naive["times"]["engine"],
        ),
        *(
            row(GOOD_HIGH, found, f"PyTorch / engine: {name}", *rivals)
            for name, found, *rivals in against_twins(parts["twins"])
        ),
        *(
            row(GOOD_LOW, found, name, *parts["steps"]["rivals_s"][name])
            for name, found in parts["steps"]["ratios"].items()
        ),
        row(
            GOOD_LOW,
            floor["ratios"]["engine / floor of visited blocks"],
            "engine / the floor: forward and backward together",
            floor["times"]["engine forward + backward"],
            bound,
        ),
        row(
            GOOD_LOW,
            floor["ratios"]["engine less the same Gaussians unseen / floor of visited blocks"],
            "forward and backward, minus the cost of the same Gaussians out of view / the floor",
            floor["times"]["engine less the same Gaussians unseen"],
            bound,
        ),
        row(
            GOOD_LOW,
            iteration["ratios"]["a view of 8 / a view alone"],
            f"time per view, {few} Gaussians: a training step of 8 views / of one view, loss and Adam included",
            iteration["view_s"]["8 views"],
            alone,
        ),
        row(
            GOOD_LOW,
            iteration["ratios"][f"{many} / {few} Gaussians, a view alone"],
            f"a training step of one view: {many} Gaussians / {few}",
            iteration["view_s_many"]["one view"],
            alone,
        ),
        *(
            row(GOOD_LOW, found, load, *parts["degenerate"]["rivals_s"][load])
            for load, found in parts["degenerate"]["ratios"].items()
        ),
    ]
    if "paper" in parts:
        rows.append(paper_training(parts["paper"]))
    return markdown(("ratio (10 … 90 %)", "A / B", "time of A / time of B"), rows)


def against_twins(twins: dict[str, Any]) -> list[tuple[str, dict, dict, dict]]:
    """Loss and Adam: what, the ratio, PyTorch's time and the engine's."""
    names = {key.removesuffix(": torch / engine"): found for key, found in twins["ratios"].items()}
    return [(n, found, twins["times"][f"{n}: torch"], twins["times"][f"{n}: engine"]) for n, found in names.items()]


def paper_training(paper: dict[str, Any]) -> tuple[str, str, str]:
    """One run of the paper's preset: its time and its scores beside the paper's."""
    theirs = paper_scores("T72").values
    scores = ", ".join(
        f"{metric.short} {metric.text(paper['scores'][metric.key])} {metric.unit}".strip()
        + f" ({metric.text(theirs[metric.key])})"
        for metric in all_metrics(Yardstick.of(paper_grid()))
        if metric.short and metric.key in theirs and paper["scores"].get(metric.key) is not None
    )
    what = (
        f"the paper's training on an RTX 3060 Ti / `--preset paper` on these cores, {paper['iterations']:,} "
        f"iterations; one run. Scores, ours (the paper's): {scores}; the true images differ, as explained above"
    )
    ratio = theirs["time_s"] / paper["training_s"]
    return f"{ratio:.1f} × {GOOD_HIGH}", what, f"{theirs['time_s']:.0f} s / {paper['training_s']:.0f} s"


def other_table(parts: dict[str, Any]) -> str:
    """What is no ratio of times, as Markdown."""
    growth, floor, iteration = parts["growth"], parts["floor"], parts["iteration"]
    largest, each, live = growth["series"]["gaussians"][-1], growth["bytes_each"], floor["ratios"]
    split = ", ".join(f"{part} {1e3 * found['median']:.2f}" for part, found in iteration["split_s"].items())
    rows = [
        (
            f"{1e3 * iteration['view_s']['one view']['median']:.2f} ms",
            f"a training step of one view, {iteration['gaussians']['few']:,} Gaussians; in ms: {split}",
        ),
        *(
            (f"{growth['slopes'][name.lower()]:.2f}", f"exponent of the growth of time with {name} (1: linear)")
            for name in ("Gaussians", "pixels")
        ),
        (
            f"{largest['process_bytes'] / 2**30:.2f} GiB",
            f"peak memory of the whole process: {largest['gaussians']:,} Gaussians, "
            f"{largest['side']} × {largest['side']} pixels, forward and backward together:"
            f" {ms(largest['seconds']['median'])}",
        ),
        (
            f"{each['gaussian']:.0f} B, {each['pixel']:.0f} B",
            "peak memory per Gaussian, and per pixel with its four rays, gradients included",
        ),
        (
            f"{100 * live['live lanes, attenuation']:.0f} %, {100 * live['live lanes, imaging']:.0f} %",
            "live lanes: share of contributing pairs in the visited blocks, on the computation and the imaging plane",
        ),
        (f"{floor['rate_flop_s'] / 1e9:.0f} GFlop/s", "float32 matrix multiplication rate of these cores"),
        *((found, name) for name, found in parts["determinism"]["ratios"].items()),
    ]
    return markdown(("value", "quantity"), rows)


def how(machine: dict[str, Any]) -> str:
    """What was measured where and how, and what the words of the tables mean."""
    text = (
        f"Measured by `make bench` on {machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, "
        f"{machine['instruction_set']}, PyTorch {machine['torch']}, {machine['date']}, with `OMP_WAIT_POLICY=PASSIVE` "
        f"as the command line sets it; the machine's load before the run was {machine['load']:.1f}. Unless stated "
        f"otherwise, a time is that of forward and backward together, for one view of {COUNT:,} Gaussians as they are "
        "halfway through the reconstruction of a T-72 (synthetic, same distributions), with 128 × 128 pixels and the "
        "default of two rays per pixel spacing (four per pixel).",
        f"↑ means that higher is better, ↓ that lower is. A and B take turns of {TURN} calls each in one process; the "
        "first call of a turn, with cold caches and sleeping threads, is discarded. A ratio is that of the medians, "
        "followed by the 10th and 90th percentiles of the ratios of adjacent turns. The cost of the ordinary scene is "
        "computed from its time per visited block, and the spread is then that of A. The engine's time differs "
        "between rows because the caches are in a different state each time, so compare only within a row.",
        "Plain PyTorch is [benchmarks/naive_torch.py](benchmarks/naive_torch.py) (pair lists, autograd). The floor is "
        "the time for the multiplications and additions of all visited blocks of Gaussian–ray and Gaussian–pixel "
        "pairs, dead lanes included, at the float32 matrix multiplication rate of these cores in the same minute.",
    )
    return "\n\n".join(textwrap.fill(paragraph, 120, break_on_hyphens=False) for paragraph in text) + "\n"


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
        trained, beside = found["training"], found["gsplat"]
        for name, step in trained["steps"].items() if trained else ():
            rows.append(("", f"a training step, preset {name}", ms(step["step_s"]["median"] / step["views"])))
        if beside:
            rivals = " / ".join(ms(beside["view_s"][who]["median"]) for who in ("gsplat", "engine"))
            rows.append((f"{beside['gsplat / engine']:.2f} ×", "gsplat, orthographic / engine, the first", rivals))
    return markdown(("share of the device's multiply-add rate", "CUDA", "a view"), rows)


def markdown(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """A table of two or three columns, all but the second to the right."""
    rules = ("---:", "---", "---:")[: len(head)]
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], f"|{'|'.join(rules)}|", *lines[1:]]) + "\n"


def section(results: dict[str, Any], devices: list[dict[str, Any]]) -> str:
    """All of it, as Markdown."""
    parts = results["parts"]
    picture = "![Time of forward and backward against Gaussians and against pixels](docs/images/growth.png)\n"
    return "\n".join([ratio_table(parts), other_table(parts), how(results["machine"]), picture, cuda_table(devices)])


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
