"""What a table says, in sentences that are computed: how our trend compares with the paper's."""

from __future__ import annotations

import math

from experiment import Experiment
from metrics import METRIC
from scipy.stats import linregress
from summary import Line

_CHANCE = 0.05
"""A slope that chance alone gives more often is no trend."""


def findings(experiment: Experiment, lines: list[Line]) -> list[str]:
    """One sentence or two for every group of rows.

    Rows with a number that changes are a trend, rows with the paper's figures are held against these, and other rows,
    or those of a contest, against the first of their group.
    """
    sentences = []
    for group in experiment.groups():
        members = [line for line in lines if line.row.group == group]
        if all(line.row.x is not None for line in members):
            said = [_trend(experiment, key, members) for key in experiment.judged]
        elif any(line.row.paper for line in members) and not experiment.contest:
            said = [_against_paper(experiment, members)]
        else:
            said = [_against_first(experiment, key, members) for key in experiment.judged]
        heading = [f"{group[0].upper()}{group[1:]}:"] if group else []
        sentences.append(" ".join([*heading, *(f"{text[0].upper()}{text[1:]}" for text in said)]))
    return sentences


def _name(key: str) -> str:
    """A metric in a sentence."""
    return METRIC[key].label


def _trend(experiment: Experiment, key: str, lines: list[Line]) -> str:
    """How a metric moves with x, with us and in the paper."""
    finished = [line for line in lines if key in line.spreads]
    if len(finished) < 3:
        return f"{_name(key)}: {len(finished)} of {len(lines)} rows are finished, too few for a trend."
    pairs = [(line.row.x, value) for line in finished for value in line.spreads[key].values]
    fit = linregress([x for x, _ in pairs], [value for _, value in pairs])
    ours = 0 if not fit.pvalue <= _CHANCE else (1 if fit.slope > 0 else -1)  # without any change nothing is a number
    verb = {1: "rises", -1: "falls", 0: "shows no trend beyond chance"}
    strength = f" (r = {fit.rvalue:+.2f})" if math.isfinite(fit.rvalue) else ""
    said = f"{_name(key)} {verb[ours]} with the {experiment.axis}{strength}"
    published = [(line.row.x, line.row.paper[key]) for line in lines if key in line.row.paper]
    if len(published) > 1:
        slope = linregress([x for x, _ in published], [value for _, value in published])
        theirs, quoted = (1 if slope.slope > 0 else -1), f"in the paper it {{}} (r = {slope.rvalue:+.2f})"
    elif key in experiment.claim:
        theirs, quoted = experiment.claim[key], "the paper says, without figures, that it {}"
    else:
        return f"{said}; the paper has no figures for this."
    differs = "**our trend differs from the paper's**" if ours else "**the paper's trend is not seen in ours**"
    verdict = "as ours" if ours == theirs else differs
    return f"{said}; {quoted.format(verb[theirs])}: {verdict}."


def _against_paper(experiment: Experiment, lines: list[Line]) -> str:
    """How many of the paper's figures ours beat, and which not."""
    worse, compared = [], 0
    for line in lines:
        for key, theirs in line.row.paper.items():
            if key not in experiment.columns or key not in line.spreads:
                continue
            compared += 1
            ours, metric = line.spreads[key].mean, METRIC[key]
            if (ours < theirs) if metric.better == "more" else (ours > theirs):
                worse.append(f"{line.row.label} {metric.label} ({metric.text(ours)}, paper {metric.text(theirs)})")
    if not compared:
        return "nothing that the paper printed is finished yet."
    said = f"better than the paper's figure, or equal, in {compared - len(worse)} of {compared} comparisons"
    return f"{said}; worse: {', '.join(worse)}." if worse else f"{said}."


def _against_first(experiment: Experiment, key: str, lines: list[Line]) -> str:
    """Which rows are worse and which better than the first, by more than the spread of the seeds.

    Of a contest, only which are as good.
    """
    first, *others = lines
    compared = [line for line in others if key in line.spreads]
    if key not in first.spreads or not compared:
        return f"{_name(key)}: too few rows are finished."
    metric, start = METRIC[key], first.spreads[key]
    places: dict[str, list[str]] = {"worse": [], "better": [], "no different beyond the spread of the seeds": []}
    worse, better, same = places.values()
    for line in compared:
        spread = line.spreads[key]
        place = better if (spread.mean > start.mean) == (metric.better == "more") else worse
        if abs(spread.mean - start.mean) <= 2 * math.sqrt(((start.sd or 0) ** 2 + (spread.sd or 0) ** 2) / 2):
            place = same
        place.append(f"{line.row.label} ({metric.text(spread.mean)})")
    if experiment.contest:
        worse.clear()
    said = "; ".join(f"{how}: {', '.join(rows)}" for how, rows in places.items() if rows) or "no other is as good"
    once = " (one seed: no spread)" if start.sd is None else ""
    return f"{metric.title}, {metric.text(start.mean)} for {first.row.label}{once}; {said}."
