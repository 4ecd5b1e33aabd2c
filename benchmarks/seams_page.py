"""Fill docs/how-to/large-scenes.md from benchmarks/results/seams-*.json, which `python benchmarks/seams.py` writes."""

from __future__ import annotations

import json
import sys
from typing import Any

from results import REPOSITORY, RESULTS

sys.path.insert(0, str(REPOSITORY / "docs"))
from fill_block import fill_block

PAGE = REPOSITORY / "docs" / "how-to" / "large-scenes.md"
HEADINGS = (
    *("scene, preset", "tiles", "Gaussians", "CPU s", "peak", "PSNR of unseen views", "F1 at 0.3, 0.1 m", "CD"),
    *("at the seams: F1", "CD"),
)


def table(results: list[dict[str, Any]]) -> str:
    """Of all scenes and presets, with the machine, as Markdown."""
    machine = results[0]["machine"]
    lines = [
        f"{machine['processor']}, one thread, {machine['date']}; images of 0.3 m, 24 training views, seed 0; time and "
        "peak memory are those of the training.",
        "",
        f"| {' | '.join(HEADINGS)} |",
        f"|---|{'---:|' * (len(HEADINGS) - 1)}",
    ]
    for result in results:
        rows = {row["side"]: row for row in result["rows"]}
        for side, row in sorted(rows.items()):
            lines.append(f"| {' | '.join(cells(row, rows.get(1) if side > 1 else None))} |")
    return "\n".join(lines) + "\n"


def cells(row: dict[str, Any], whole: dict[str, Any] | None) -> list[str]:
    """One line; `whole` is scored at the seams, too."""
    side, key = row["side"], f"at the seams of {row['preset']}-{row['side']}"
    training, there = row["training"], row.get(key)
    seams = ["", ""]
    if there is not None:
        beside = None if whole is None else whole.get(key)
        brackets = [f" ({f1(beside)})", f" ({beside['cd_m']:.3f})"] if beside is not None else ["", ""]
        seams = [f1(there) + brackets[0], f"{there['cd_m']:.3f} m{brackets[1]}"]
    return [
        f"{row['dataset']}, `{row['preset']}`" if side == 1 or whole is None else "",
        "whole" if side == 1 else f"{side} × {side}",
        f"{row['gaussians']:,}",
        f"{training['seconds']:.0f}",
        f"{training['peak_gib']:.2f} GiB",
        f"{row['psnr_db']:.2f} dB",
        f1(row["everywhere"]),
        f"{row['everywhere']['cd_m']:.3f} m",
        *seams,
    ]


def f1(scores: dict[str, float]) -> str:
    """At both thresholds."""
    return ", ".join(f"{scores[name]:.3f}" for name in ("f1@0.3", "f1@0.1"))


if __name__ == "__main__":
    found = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(RESULTS.glob("seams-*.json"))]
    fill_block(PAGE, "seams", table(found))
