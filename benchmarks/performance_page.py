"""Fill docs/reference/performance.md and docs/images/growth.png from the files in benchmarks/results.

Run as the last step of `make bench`, or as `python benchmarks/performance_page.py`.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

from clock import TURN
from cuda_suite import SECTIONS
from recipes import COUNT
from results import REPOSITORY, RESULTS

from sarsplat.evaluation import Yardstick, all_metrics, paper_scores
from sarsplat.scenes import paper_grid

sys.path.insert(0, str(REPOSITORY / "docs"))

from fill_block import fill_block

PAGE, PICTURE = REPOSITORY / "docs" / "reference" / "performance.md", REPOSITORY / "docs" / "images" / "growth.png"


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
    return markdown(("computation", "PyTorch", "sarsplat", "times as fast (↑)"), rows)


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
            "the same without the work done once for every Gaussian, seen or not",
            floor["times"]["engine less the same Gaussians unseen"],
            bound,
            floor["ratios"]["engine less the same Gaussians unseen / floor of visited blocks"],
        ),
    ]
    return markdown(("computation", "sarsplat", "arithmetic alone", "times as long (↓)"), rows)


def beside_the_ordinary(parts: dict[str, Any]) -> str:
    """What other ways of calling it, and awkward scenes, cost, as Markdown."""
    iteration = parts["iteration"]
    few, many = (f"{iteration['gaussians'][size]:,}" for size in ("few", "many"))
    alone = iteration["view_s"]["one view"]
    rows = [
        *(
            row(name.replace(" / ", " instead of "), first, second, quotient)
            for name, quotient in parts["steps"]["ratios"].items()
            for first, second in [parts["steps"]["contenders_s"][name]]
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
            row(_load(load), first, second, quotient)
            for load, quotient in parts["degenerate"]["ratios"].items()
            for first, second in [parts["degenerate"]["contenders_s"][load]]
        ),
    ]
    return markdown(("difference", "with it", "without", "times as long (↓)"), rows)


def _load(name: str) -> str:
    """An awkward scene as the page calls it: some are compared with as much work in an ordinary scene."""
    scene, _, _ = name.partition(": time / ")
    return (
        f"{scene} instead of as much work of an ordinary scene"
        if scene != name
        else name.replace(" / ", " instead of ")
    )


def against_twins(twins: dict[str, Any]) -> list[tuple[str, dict[str, Any], dict[str, Any], dict[str, Any]]]:
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
        f"otherwise, the scene is one view of {COUNT:,} Gaussians, distributed as halfway through the reconstruction "
        "of a T-72 (synthetic), 128 × 128 pixels, two rays per pixel spacing (four per pixel).",
        f"The two sides of a row take turns of {TURN} calls each in one process; the first call of a turn, with cold "
        "caches and sleeping threads, is discarded. Times are medians. The ratio is that of the medians; in brackets, "
        "the 10th and 90th percentiles of the ratios of adjacent turns. Caches differ between rows, and so does the "
        "time of one and the same thing: compare within a row only.",
    )


def wrapped(*paragraphs: str) -> str:
    """Paragraphs of Markdown in lines of 120 characters."""
    return "\n\n".join(textwrap.fill(paragraph, 120, break_on_hyphens=False) for paragraph in paragraphs) + "\n"


def cuda(device: dict[str, Any]) -> str:
    """What `cuda_suite.py` found on a device, as Markdown, and what it did not look for."""
    sections = device["sections"]
    found = {name: sections.get(name, {}).get("found", {}) for name in SECTIONS}
    said, whole = [], [name for name, section in sections.items() if section["done"]]
    if scenes := found["scenes"].values():
        values, gradients = (max(scene[of] for scene in scenes) for of in ("values", "gradients"))
        same = "the same bits" if all(scene["same_bits"] for scene in scenes) else "OTHER BITS"
        said.append(
            f"{len(scenes)} scenes agree with the float64 reference to {values:.1e} in every value and to "
            f"{gradients:.1e} in every gradient, in the Euclidean norm, with {same} from run to run."
        )
    if {"cuda", "cpu"} <= found["demo"].keys():
        there, here = found["demo"]["cuda"], found["demo"]["cpu"]
        said.append(
            f"The demo is trained there in {there['training_s']:.1f} s, and in {here['training_s']:.1f} s on all "
            f"cores of the same machine: PSNR {there['psnr_db']:.2f} and {here['psnr_db']:.2f} dB, CD "
            f"{there['chamfer_m']:.4f} and {here['chamfer_m']:.4f} m."
        )
        said += stages(there, "After it")
    for preset, village in found["village"].items():
        if preset != "simulated":
            side = found["village"]["simulated"]["side"]
            seconds = f"{village['training_s']:.1f} s"
            said.append(f"A village of {side} × {side} pixels is trained by the preset `{preset}` in {seconds}.")
            said += stages(village, "After that")
    if recording := found["recording"]:
        bits = "the same bits" if all(one["same_bits"] for one in recording.values()) else "OTHER BITS"
        times = [
            f"`{name}` {one['recorded_ms']:.2f} instead of {one['launched_ms']:.2f} ms"
            for name, one in recording.items()
            if one["recorded"]
        ]
        said.append(
            "Steps that the GPU replays as a CUDA graph, instead of kernels that Python launches, take: "
            f"{', '.join(times)}; they learn {bits}."
        )
    for name, one in found["paper"].items():
        said.append(f"The paper's training takes {one['training_s']:.1f} s for {name}.")
    if fleet := found["fleet"]:
        bits = "the same bits" if all(one["same_bits"] for one in fleet.values()) else "OTHER BITS"
        rates = ", ".join(f"{one['per_minute']:.0f} ({together} at a time)" for together, one in fleet.items())
        said.append(
            f"Targets of 64 × 64 pixels that one process trains a minute with `quick`, to their points: {rates}; they "
            f"learn {bits}."
        )
    if found["waits"]:
        counts = ", ".join(f"`{name}` {sum(lines.values())}" for name, lines in found["waits"].items())
        said.append(f"So often a training step makes Python wait for the GPU: {counts}.")
    if tools := found["sanitizer"]:
        wrong = [tool for tool, end in tools.items() if end["code"]]
        said.append(f"NVIDIA's {', '.join(tools)} find {'FAULTS: ' + ', '.join(wrong) if wrong else 'no fault'}.")
    machine = found["machine"]
    if "bandwidth_bytes_s" in machine:
        said.append(f"Copying, it moves {machine['bandwidth_bytes_s'] / 1e9:.0f} GB/s.")
    if "peak_flop_s" in machine:
        said.append(f"It multiplies and adds float32 matrices at {machine['peak_flop_s'] / 1e12:.1f} TFlop/s.")
    unknown = ", ".join(name for name in SECTIONS if name not in whole)
    head = ("what", "views of a step", "a step", "a view", "of a step, the GPU works", "share of its multiply-add rate")
    table = markdown(head, pace(found))
    end = f"Not measured, or not to the end: {unknown} (the sections of `python benchmarks/cuda_suite.py`)."
    return "\n".join([wrapped(f"{device['device']}: " + " ".join(said)), table, *([wrapped(end)] if unknown else [])])


def stages(seconds: dict[str, float], after: str) -> list[str]:
    """What is made of a training, in one sentence; none where nothing of that was timed."""
    parts = [f"{name} {seconds[f'{name}_s']:.1f} s" for name in ("points", "normals", "mesh") if f"{name}_s" in seconds]
    return [f"{after}: {', '.join(parts)}."] if parts else []


def pace(found: dict[str, dict[str, Any]]) -> list[Row]:
    """Scenes and training steps on a GPU: all views of a call, one of them, and for how long of the call it works."""
    scenes = {name: paced for name, paced in found["kernels"].items() if "views" in paced}
    titles = {name: f"a training step: {name}" for name in scenes} | {
        name: f"image and gradients: {paced['gaussians']:,} Gaussians, {paced['side']} × {paced['side']} pixels"
        for name, paced in scenes.items()
        if f"{name}: arithmetic" in found["kernels"]
    }
    rows = []
    for title, paced, name in (
        *((titles[name], paced, name) for name, paced in scenes.items()),
        *((f"a training step: preset {name}", paced, name) for name, paced in found["steps"].items()),
    ):
        kernels_ms = paced["views"] * sum(paced.get("kernel_ms_per_view", {}).values())
        busy_ms = paced.get("busy_ms", {}).get("all") or kernels_ms
        share = found["kernels"].get(f"{name}: arithmetic")
        times = (ms(1e-3 * each) for each in (paced["step_ms"], paced["per_view_ms"], busy_ms))
        rows.append((title, f"{paced['views']}", *times, f"{100 * share['share_of_peak']:.1f} %" if share else ""))
    return rows


def markdown(head: Row, rows: Sequence[Row]) -> str:
    """A table whose first column is words and whose others are numbers."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|---|" + "---:|" * (len(head) - 1), *lines[1:]]) + "\n"


def section(results: dict[str, Any], devices: list[dict[str, Any]]) -> str:
    """All of it, as Markdown."""
    parts = results["parts"]
    picture = "![Time for image and gradients against the number of Gaussians and of pixels](../images/growth.png)\n"
    said = [
        how(results["machine"]),
        "## Beside plain PyTorch\n",
        wrapped(
            "The same results from PyTorch's own operations and automatic differentiation "
            "([naive_torch.py](../../benchmarks/naive_torch.py)), and from sarsplat's engine in C++. It matters "
            "because a training does this thousands of times."
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
        "## Cost of other calls and awkward scenes\n",
        wrapped(
            "Below 1, the different case is faster. Scenes of huge or coincident Gaussians occur when a training goes "
            "wrong; they should cost no more than the work that is in them."
        ),
        beside_the_ordinary(parts),
        "## Time, memory and growth\n",
        other_table(parts),
        picture,
    ]
    if "paper" in parts:
        said += ["## The paper's training\n", paper_training(parts["paper"])]
    if not devices:
        return "\n".join([*said, "## On a GPU\n", "The CUDA engine has not been run on a GPU.\n"])
    about = wrapped(
        "A step is of several views at once, and *a view* is a step divided by their number. Small scenes leave a GPU "
        "idle most of the time, while Python asks for the next step."
    )
    return "\n".join([*said, "## On a GPU\n", about, *map(cuda, devices)])


def main() -> None:
    """Rewrite the page's block and the picture."""
    path = RESULTS / "cpu.json"
    if not path.is_file():
        sys.exit(f"{path} does not exist; run `make bench`")
    results = json.loads(path.read_text(encoding="utf-8"))
    if results["machine"]["quick"]:
        sys.exit(f"{path} is from a quick run, whose numbers mean nothing; run `make bench`")
    devices = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(RESULTS.glob("cuda-*.json"))]
    devices = [device for device in devices if not device["quick"]]
    fill_block(PAGE, "performance", section(results, devices))
    from draw_growth import draw  # matplotlib

    draw(results["parts"]["growth"], PICTURE)


if __name__ == "__main__":
    main()
