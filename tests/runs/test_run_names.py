"""Runs whose folders are called by addresses are named by what differs."""

from typing import Any

from sarsplat.runs.run_folder import Header, distinguished


def header(dataset: str | None, method: str = "sar-gs", **config: Any) -> Header:
    return Header("sarsplat-run", 4, dataset, "", config, method)


def test_settings_are_named_where_they_differ_between_runs_alike() -> None:
    runs = [
        header("/a/T72", preset="quick", iterations=5, points={"voxel": 0.1, "rays": 2}, seed=0),
        header("/a/T72", preset="quick", iterations=5, points={"voxel": 0.2, "rays": 2}, seed=0),
        header("/a/BMP2", preset="quick", iterations=9, points={"voxel": 0.2, "rays": 2}, seed=1),
    ]
    assert distinguished(runs) == ["T72, points.voxel 0.1, seed 0", "T72, points.voxel 0.2, seed 0", "BMP2, seed 1"]
    others = [header("/a/T72", "sar-nerf-grid", iterations=9, seed=0), header("/b/T72", preset="default", seed=0)]
    assert distinguished([runs[0], *others]) == [
        "/a/T72, sar-gs, quick, seed 0",
        "/a/T72, sar-nerf-grid, seed 0",
        "/b/T72, sar-gs, default, seed 0",
    ]
    assert distinguished([header(None)]) == ["images in memory"]


def test_sections_that_some_do_not_have_are_named() -> None:
    dense, none = {"start": 5, "stop": 9}, header("/a/T72", preset="quick", densification=None, seed=0)
    runs = [header("/a/T72", preset="quick", densification=dense, seed=0), none]
    assert distinguished(runs) == ["T72, densification, seed 0", "T72, densification None, seed 0"]
    other = header("/a/T72", preset="quick", densification={**dense, "stop": 8}, seed=0)
    assert distinguished([*runs, other]) == [
        "T72, densification, densification.stop 9, seed 0",
        "T72, densification None, seed 0",
        "T72, densification, densification.stop 8, seed 0",
    ]
    earlier = header("/a/T72", preset="quick", seed=0)
    assert distinguished(
        [earlier, header("/a/T72", preset="quick", smoothing={"rounds": 40}, dropout=0.1, seed=0)]
    ) == [
        "T72, seed 0",
        "T72, smoothing, dropout 0.1, seed 0",
    ]
