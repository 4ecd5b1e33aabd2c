import io
import itertools
from types import SimpleNamespace

import pytest
from rich.console import Console

from made_runs import POINT_KEYS, make_metrics
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import (
    IMAGE_METRICS,
    Yardstick,
    all_metrics,
    beaten_by_baselines,
    comparison,
    metrics_of_points,
    metrics_table,
    paper_beside,
    paper_scores,
)

YARDSTICK = Yardstick(0.3)
METRICS = all_metrics(YARDSTICK)
IMAGE_KEYS = [metric.key for metric in IMAGE_METRICS]


def metrics(baselines=None, **images):
    """Metrics of a run in which everything not named is null."""
    points = {"visible": {**dict.fromkeys(POINT_KEYS), "cd_m": 0.0741, "f1@0.3": 0.9834, "f1@0.1": 0.7654}}
    return make_metrics() | {"images": images, "points": points, "baselines": baselines, "time_s": 61.7}


def table(metrics, paper=None):
    return metrics_table(comparison(metrics, paper), YARDSTICK)


def rows(table) -> list[list[str]]:
    cells = [[str(cell) for cell in column.cells] for column in table.columns]
    return [list(row) for row in itertools.zip_longest(*cells)]


def test_keys_and_headings_are_unique_and_every_metric_has_a_definition():
    for name in ("key", "title", "definition"):
        assert len({getattr(metric, name) for metric in METRICS}) == len(METRICS), name
    headings = [metric.heading for metric in METRICS if metric.short]
    assert len(set(headings)) == len(headings) > 5


def test_values_are_written_and_compared_as_their_metric_says():
    psnr, lpips = (next(metric for metric in METRICS if metric.key == key) for key in ("psnr_db", "lpips"))
    assert (psnr.text(1.006), psnr.text(None), lpips.text(0.5)) == ("1.01", "–", "0.5000")
    assert (psnr.best([1.0, None, 2.0]), lpips.best([1.0, None, 2.0]), psnr.best([1.0, None])) == (2.0, 1.0, None)
    assert (psnr.arrow, lpips.arrow) == ("↑", "↓")
    distance = metrics_of_points(YARDSTICK)[0]  # three digits, whatever their size
    written = [distance.text(value) for value in (0.00412, 0.0490, 0.4, 5.3, 123.4)]
    assert written == ["0.00412", "0.0490", "0.400", "5.30", "123"]


def test_noise_free_sets_stand_above_the_paper():
    ours = metrics(test={"psnr_db": 53.712, "psnr_target_db": 36.0, "ssim": 0.99951})
    shown = table(ours, paper_scores("T72"))
    assert [str(column.header) for column in shown.columns][1:] == [
        *("PSNR dB", "target dB", "SSIM", "LPIPS", "CD m", "F1@0.3", "F1@0.1", "time s")
    ]
    assert rows(shown) == [
        ["sar-gs, test", "53.71", "36.00", "0.9995", "–", "0.0741", "0.983", "0.765", "62"],
        ["paper, T72", "35.91", "–", "0.9943", "0.0165", "0.187", "0.925", "–", "400"],
    ]


def test_the_row_of_the_paper_is_that_of_the_target():
    for target, f1 in (("T72", 0.925), ("Btr70", 0.846), ("kraz", 0.862)):
        assert paper_scores(target).values["f1@0.3"] == f1
        assert set(paper_scores(target).values) < {metric.key for metric in METRICS}
    with pytest.raises(SarsplatError, match=r"'bmp2'.*T72, BTR70, KRAZ"):
        paper_scores("bmp2")

    def beside(target="unnamed", protocol="paper", looks=None, ground=False):
        published = paper_beside(SimpleNamespace(target=target, protocol=protocol, looks=looks, ground=ground))
        return published and published.name

    assert beside(target="BTR70") == "paper, BTR70"
    assert beside() is None
    for other in ({"protocol": None}, {"looks": 1.0}, {"ground": True}):
        assert beside(target="BTR70", **other) is None


def test_measured_sets_stand_beside_the_baselines():
    nats, correlation = "registered_nats_per_pixel", "registered_log_correlation"
    sets = {"test-17": {nats: 0.55, correlation: 0.86}, "test-15": {nats: 0.5}}
    baselines = {"test-17": {"nearest_chip": {nats: 0.573, correlation: 0.841}}}
    measured = metrics(baselines, **sets)
    measured["points"]["visible"] = dict.fromkeys(POINT_KEYS)
    assert rows(table(measured)) == [
        ["sar-gs, test-17", "0.550", "0.860", "62"],
        ["nearest chip, test-17", "0.573", "0.841", "–"],
        ["sar-gs, test-15", "0.500", "–", "62"],
    ]
    assert rows(table(metrics())) == [["sar-gs", "0.0741", "0.983", "0.765", "62"]]  # without test views


def test_a_baseline_that_wins_is_named():
    nats = "registered_nats_per_pixel"
    baselines = {split: {"nearest_chip": {nats: 0.573}, "rotated_average": {nats: 0.53}} for split in ("a", "b")}
    measured = metrics(baselines, a={nats: 0.55}, b={nats: 0.52}, c={nats: 0.9})
    assert beaten_by_baselines(measured) == [
        "on the set a the baseline rotated average, which knows no third dimension, is better than sar-gs: negative "
        "log-likelihood, registered, nats/pixel 0.530 against 0.550"
    ]
    without = measured | {"images": measured["images"] | {"a": dict.fromkeys(IMAGE_KEYS)}}  # as where nothing is lit
    (said,) = beaten_by_baselines(without)
    assert said.endswith("nats/pixel 0.530, where the other has no score")


@pytest.mark.parametrize("speckled", [False, True])
def test_the_table_fits_a_terminal(speckled):
    some = IMAGE_METRICS[4:] if speckled else IMAGE_METRICS[:4]
    every = {metric.key: 53.712 if metric.unit == "dB" else 0.98765 for metric in some}
    shown = io.StringIO()
    console = Console(file=shown, width=80)
    console.print(table(metrics(**{"test-17": every})))
    printed = shown.getvalue()
    figures = ("0.988", "0.988") if speckled else ("53.71", "0.9877")
    for figure in (*figures, "0.0741", "0.983", "0.765", "62", "sar-gs, test-17"):
        assert figure in printed
    assert "…" not in printed
