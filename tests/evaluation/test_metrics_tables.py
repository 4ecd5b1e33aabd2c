import io
import itertools

import pytest
from rich.console import Console

from sarsplat.errors import SarsplatError
from sarsplat.evaluation import IMAGE_METRICS, POINT_METRICS, metrics_table, paper_row


def metrics(**images):
    """Metrics of a run in which everything not named is null."""
    return {
        "images": {name: {**dict.fromkeys(IMAGE_METRICS), **scores} for name, scores in images.items()},
        "points": {
            "visible": {**dict.fromkeys(POINT_METRICS), "cd_m": 0.0741, "f1@0.3": 0.9834},
            "whole": dict.fromkeys(POINT_METRICS),
        },
        "time_s": 61.7,
        "seed": 0,
    }


def rows(table) -> list[list[str]]:
    cells = [[str(cell) for cell in column.cells] for column in table.columns]
    return [list(row) for row in itertools.zip_longest(*cells)]


def test_rendered_sets_stand_above_the_paper():
    table = metrics_table(
        metrics(test={"psnr_db": 53.712, "psnr_target_db": 36.0, "ssim": 0.99951}), paper=paper_row("T72")
    )
    assert [str(column.header) for column in table.columns][1:] == [
        *("PSNR dB", "target dB", "SSIM", "LPIPS", "CD m", "F1@0.3", "time"),
    ]
    assert rows(table) == [
        ["ours, test", "53.71", "36.00", "0.9995", "–", "0.074", "0.983", "1:02"],
        ["paper, T72", "35.91", "–", "0.9943", "0.0165", "0.187", "0.925", "6:40"],
    ]
    assert "not the same experiment" in str(table.caption)


def test_another_row_of_the_paper():
    table = metrics_table(metrics(test={"psnr_db": 40.0}), paper=paper_row("kraz"))
    assert rows(table)[-1] == ["paper, KRAZ", "37.33", "0.9969", "0.0109", "0.207", "0.862", "6:16"]
    assert paper_row("Btr70").f1 == 0.846


def test_unknown_rows_are_told():
    with pytest.raises(SarsplatError, match=r"'bmp2'.*T72, BTR70, KRAZ"):
        paper_row("bmp2")


def test_measured_sets_stand_beside_the_yardsticks():
    sets = {"test-17": {"nats_per_pixel": 0.55, "log_correlation": 0.86}, "test-15": {"nats_per_pixel": 0.5}}
    yardsticks = {"test-17": {"nearest_chip": {"nats_per_pixel": 0.573, "log_correlation": 0.841}}}
    measured = metrics(**sets)
    measured["points"]["visible"] = dict.fromkeys(POINT_METRICS)
    assert rows(metrics_table(measured, yardsticks=yardsticks)) == [
        ["ours, test-17", "0.550", "0.860", "1:02"],
        ["nearest chip, test-17", "0.573", "0.841", "–"],
        ["ours, test-15", "0.500", "–", "1:02"],
    ]


def test_speckled_simulations_have_both_kinds_of_scores():
    speckled = {"psnr_db": 40.0, "nats_per_pixel": 0.5123, "log_correlation": 0.91}
    table = metrics_table(metrics(test=speckled))
    assert [str(column.header) for column in table.columns][1:] == [
        *("PSNR dB", "nats per pixel", "log corr.", "CD m", "F1@0.3", "time"),
    ]
    assert rows(table) == [["ours, test", "40.00", "0.512", "0.910", "0.074", "0.983", "1:02"]]


def test_without_test_views_the_points_have_their_row():
    assert rows(metrics_table(metrics())) == [["ours", "0.074", "0.983", "1:02"]]


def test_the_table_fits_a_terminal():
    every = {name: 53.712 if name.startswith("psnr") else 0.98765 for name in IMAGE_METRICS}
    console = Console(file=io.StringIO(), width=80)
    console.print(metrics_table(metrics(test=every)))
    printed = console.file.getvalue()
    for figure in ("53.71", "0.9877", "0.988", "0.074", "0.983", "1:02", "ours, test"):
        assert figure in printed
    assert "…" not in printed
