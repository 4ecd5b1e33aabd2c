"""Fill docs/performance.md and docs/images/growth.png from the files in benchmarks/results.

Run as the last step of `make bench`, or as `python benchmarks/performance_page.py`.
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

PAGE, PICTURE = REPOSITORY / "docs" / "performance.md", REPOSITORY / "docs" / "images" / "growth.png"


Row = tuple[str, ...]


def ms(seconds: float) -> str:
    """Three digits, in milliseconds below a second."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def row(
    what: str, first: dict[str, float] | float, second: dict[str, float] | float, quotient: dict[str, float]
) -> Row:
    """What is timed, both times, and their ratio with where 80 % of its samples are."""
    times = (ms(each if isinstance(each, float) else each["median"]) for each in (first, second))
    return what, *times, f"{quotient['median']:.3g} ({quotient['p10']:.3g} … {quotient['p90']:.3g})"


def beside_pytorch(parts: dict[str, Any]) -> str:
    """What PyTorch's own operations take for the same, as Markdown."""
    naive = parts["naive"]
    rows = [
        row(
            "image and gradients, one view",
            naive["times"]["plain torch"],
            naive["times"]["engine"],
            naive["ratios"]["plain torch / engine"],
        ),
        *(row(name, theirs, ours, quotient) for name, quotient, theirs, ours in against_twins(parts["twins"])),
    ]
    return markdown(("what is computed", "PyTorch", "sarsplat", "times as fast (↑)"), rows)


def beside_arithmetic(floor: dict[str, Any]) -> str:
    """What the additions and multiplications alone would take, as Markdown."""
    bound = floor["times"]["floor of visited blocks"]
    rows = [
        row(
            "image and gradients, one view",
            floor["times"]["engine forward + backward"],
            bound,
            floor["ratios"]["engine / floor of visited blocks"],
        ),
        row(
            "the same without what is done once for every Gaussian, seen or not",
            floor["times"]["engine less the same Gaussians unseen"],
            bound,
            floor["ratios"]["engine less the same Gaussians unseen / floor of visited blocks"],
        ),
    ]
    return markdown(("what is computed", "sarsplat", "arithmetic alone", "times as long (↓)"), rows)


def beside_the_ordinary(parts: dict[str, Any]) -> str:
    """What other ways of calling it, and awkward scenes, cost, as Markdown."""
    iteration = parts["iteration"]
    few, many = (f"{iteration['gaussians'][size]:,}" for size in ("few", "many"))
    alone = iteration["view_s"]["one view"]
    rows = [
        *(
            row(name.replace(" / ", " instead of "), *parts["steps"]["contenders_s"][name], quotient)
            for name, quotient in parts["steps"]["ratios"].items()
        ),
        row(
            f"a training step on 8 views instead of one, time per view, {few} Gaussians",
            iteration["view_s"]["8 views"],
            alone,
            iteration["ratios"]["a view of 8 / a view alone"],
        ),
        row(
            f"a training step with {many} Gaussians instead of {few}",
            iteration["view_s_many"]["one view"],
            alone,
            iteration["ratios"][f"{many} / {few} Gaussians, a view alone"],
        ),
        *(
            row(_load(load), *parts["degenerate"]["contenders_s"][load], quotient)
            for load, quotient in parts["degenerate"]["ratios"].items()
        ),
    ]
    return markdown(("what is different", "with it", "without", "times as long (↓)"), rows)


def _load(name: str) -> str:
    """An awkward scene as the page calls it: some are compared with as much work in an ordinary scene."""
    scene, _, _ = name.partition(": time / ")
    return (
        f"{scene} instead of as much work of an ordinary scene"
        if scene != name
        else name.replace(" / ", " instead of ")
    )


def against_twins(twins: dict[str, Any]) -> list[tuple[str, dict, dict, dict]]:
    """Loss and Adam: what, the ratio, PyTorch's time and the engine's."""
    names = {key.removesuffix(": torch / engine"): quotient for key, quotient in twins["ratios"].items()}
    return [
        (n, quotient, twins["times"][f"{n}: torch"], twins["times"][f"{n}: engine"]) for n, quotient in names.items()
    ]


def paper_training(paper: dict[str, Any]) -> str:
    """One run of the paper's preset: its time and its scores beside the paper's."""
    theirs = paper_scores("T72").values
    scores = ", ".join(
        f"{metric.short} {metric.text(paper['scores'][metric.key])} {metric.unit}".strip()
        + f" ({metric.text(theirs[metric.key])})"
        for metric in all_metrics(Yardstick.of(paper_grid()))
        if metric.short and metric.key in theirs and paper["scores"].get(metric.key) is not None
    )
    return wrapped(
        f"The paper's training, {paper['iterations']:,} iterations (`--preset paper`), takes "
        f"{paper['training_s']:.0f} s on these cores; the paper reports {theirs['time_s']:.0f} s on an RTX 3060 Ti. "
        f"Our scores, and the paper's in brackets: {scores}. The true images differ, so the scores are not of one "
        "experiment. One run."
    )


def other_table(parts: dict[str, Any]) -> str:
    """What is no ratio of times, as Markdown."""
    growth, floor, iteration = parts["growth"], parts["floor"], parts["iteration"]
    largest, each, used = growth["series"]["gaussians"][-1], growth["bytes_each"], floor["ratios"]
    split = ", ".join(f"{part} {1e3 * seconds['median']:.2f}" for part, seconds in iteration["split_s"].items())
    rows = [
        (
            f"a training step of one view, {iteration['gaussians']['few']:,} Gaussians; in ms: {split}",
            f"{1e3 * iteration['view_s']['one view']['median']:.2f} ms",
        ),
        *(
            (
                f"time grows with the number of {name} to this power (1: twice as many take twice as long)",
                f"{slope:.2f}",
            )
            for name, slope in (("Gaussians", growth["slopes"]["gaussians"]), ("pixels", growth["slopes"]["pixels"]))
        ),
        (
            f"peak memory of the whole process: {largest['gaussians']:,} Gaussians, {largest['side']} × "
            f"{largest['side']} pixels, image and gradients in {ms(largest['seconds']['median'])}",
            f"{largest['process_bytes'] / 2**30:.2f} GiB",
        ),
        ("peak memory for each Gaussian, gradients included", f"{each['gaussian']:.0f} B"),
        ("peak memory for each pixel and its four rays, gradients included", f"{each['pixel']:.0f} B"),
        *(
            (f"of the pairs that are computed, those that change a result: {name}", f"{100 * used[key]:.0f} %")
            for name, key in (
                ("Gaussian and ray", "live lanes, attenuation"),
                ("Gaussian and pixel", "live lanes, imaging"),
            )
        ),
        (
            "float32 additions and multiplications of these cores, in a matrix product",
            f"{floor['rate_flop_s'] / 1e9:.0f} GFlop/s",
        ),
        *((name, quotient) for name, quotient in parts["determinism"]["ratios"].items()),
    ]
    return markdown(("quantity", "value"), rows)


def how(machine: dict[str, Any]) -> str:
    """What was measured, on what and how."""
    return wrapped(
        f"Measured by `make bench` on {machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, "
        f"{machine['instruction_set']}, PyTorch {machine['torch']}, {machine['date']}, with `OMP_WAIT_POLICY=PASSIVE` "
        f"as the command line sets it; the machine's load before the run was {machine['load']:.1f}. Unless a row says "
        f"otherwise, the scene is one view of {COUNT:,} Gaussians as they are halfway through the reconstruction of a "
        "T-72 (synthetic, same distributions), 128 × 128 pixels, two rays per pixel spacing (four per pixel).",
        f"The two sides of a row take turns of {TURN} calls each in one process; the first call of a turn, with cold "
        "caches and sleeping threads, is discarded. Times are medians. The ratio is that of the medians; in brackets, "
        "the 10th and 90th percentiles of the ratios of adjacent turns. Caches differ between rows, and so does the "
        "time of one and the same thing: compare within a row only.",
    )


def wrapped(*paragraphs: str) -> str:
    """Paragraphs of Markdown in lines of 120 characters."""
    return "\n\n".join(textwrap.fill(paragraph, 120, break_on_hyphens=False) for paragraph in paragraphs) + "\n"


def cuda_table(devices: list[dict[str, Any]]) -> str:
    """The results of `cuda_check.py` on every device, as Markdown, or that there was none."""
    if not devices:
        return "The CUDA engine has not been run on a GPU.\n"
    rows, said = [], []
    for device in devices:
        errors = device["largest_relative_error"].values()
        values, gradients = (max(error[of] for error in errors) for of in ("values", "gradients"))
        said.append(
            f"{device['device']}: {len(errors)} scenes agree with the float64 reference to {values:.1e} in every value "
            f"and to {gradients:.1e} in every gradient, in the Euclidean norm, with the same bits from run to run."
        )
        for work in device["workloads"].values():
            count = work["views"]
            scene = f"{work['gaussians']:,} Gaussians, {work['side']} × {work['side']} pixels"
            share = f"{100 * work['share_of_peak']:.1f} %"
            views = f"{count} view{'s' * (count > 1)}"
            what = f"{device['device']}, image and gradients: {scene}, {views}"
            rows.append((what, ms(work["view_s"]["median"]), share))
        trained, beside = device["training"], device["gsplat"]
        for name, step in trained["steps"].items() if trained else ():
            rows.append((f"a training step, preset {name}", ms(step["step_s"]["median"] / step["views"]), ""))
        if trained:
            there, here = (trained["demo"][place] for place in ("cuda", "cpu"))
            said.append(
                f"The demo is trained there in {there['training_s']:.1f} s, and in {here['training_s']:.1f} s on all "
                f"cores of the same machine: PSNR {there['psnr_db']:.2f} and {here['psnr_db']:.2f} dB, CD "
                f"{there['chamfer_m']:.4f} and {here['chamfer_m']:.4f} m. Small scenes leave a GPU idle most of the "
                "time, while Python asks for the next step."
            )
        if beside:
            theirs, ours = (ms(beside["view_s"][who]["median"]) for who in ("gsplat", "engine"))
            what = f"gsplat, orthographic: {theirs}; sarsplat, the first of these scenes"
            rows.append((what, ours, f"{beside['gsplat / engine']:.2f} × as fast"))
    table = markdown(("what", "a view", "share of the device's multiply-add rate"), rows)
    return "\n".join([wrapped(*said), table])


def markdown(head: Row, rows: Sequence[Row]) -> str:
    """A table whose first column is words and whose others are numbers."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|---|" + "---:|" * (len(head) - 1), *lines[1:]]) + "\n"


def section(results: dict[str, Any], devices: list[dict[str, Any]]) -> str:
    """All of it, as Markdown."""
    parts = results["parts"]
    picture = "![Time for image and gradients against the number of Gaussians and of pixels](images/growth.png)\n"
    said = [
        how(results["machine"]),
        "## Beside plain PyTorch\n",
        wrapped(
            "The same results from PyTorch's own operations and automatic differentiation "
            "([naive_torch.py](../benchmarks/naive_torch.py)), and from sarsplat's engine in C++. It matters because a "
            "training does this thousands of times."
        ),
        beside_pytorch(parts),
        "## Beside the arithmetic alone\n",
        wrapped(
            "How much could still be gained? No program that visits the same pairs of Gaussians and rays, and of "
            "Gaussians and pixels, can be faster than their multiplications and additions at the rate that these cores "
            "reach in a matrix product, measured in the same minute. A ratio of 1 would be perfect; the rest is "
            "exponentials, sorting, memory and waiting."
        ),
        beside_arithmetic(parts["floor"]),
        "## What other calls and awkward scenes cost\n",
        wrapped(
            "Below 1, what is different is faster. Scenes of huge or coincident Gaussians occur when a training goes "
            "wrong; they should cost no more than the work that is in them."
        ),
        beside_the_ordinary(parts),
        "## Time, memory and growth\n",
        other_table(parts),
        picture,
    ]
    if "paper" in parts:
        said += ["## The paper's training\n", paper_training(parts["paper"])]
    return "\n".join([*said, "## On a GPU\n", cuda_table(devices)])


def main() -> None:
    """Rewrite the page's block and the picture."""
    path = RESULTS / "cpu.json"
    if not path.is_file():
        sys.exit(f"{path} does not exist; run `make bench`")
    results = json.loads(path.read_text(encoding="utf-8"))
    if results["machine"]["quick"]:
        sys.exit(f"{path} is from a quick run, whose numbers mean nothing; run `make bench`")
    devices = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(RESULTS.glob("cuda-*.json"))]
    fill_block(PAGE, "performance", section(results, devices))
    draw(results["parts"]["growth"], PICTURE)


if __name__ == "__main__":
    main()
