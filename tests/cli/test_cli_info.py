"""What `sarsplat info` says: of datasets and their views, in letters and as a picture; of runs; of folders of both."""

import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made import dataset_of
from sarsplat import Dataset, ImageGrid, Place, Run, SarImage, Turn, View, read_dataset, write_dataset
from sarsplat.cli.info_dataset import PLAIN, PRETTY, sky_chart, symbols_for
from sarsplat.runs.run_folder import names_of
from sarsplat.sweeps import Plan

GRID = ImageGrid(8, 8, (0.3, 0.3), (0.3, 0.3))
RING = [View(float(azimuth), 45.0) for azimuth in range(0, 360, 15) if not 100 < azimuth < 200]


def written(folder: Path, train: list[View], test: Sequence[View] = (), **fields: Any) -> Path:
    views = [*((view, "train") for view in train), *((view, "test") for view in test)]
    images = np.random.default_rng(0).random((len(views), 8, 8), np.float32)
    write_dataset(folder / "data", dataset_of(GRID, views, images, **fields))
    return folder / "data"


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return written(tmp_path, RING, [View(150, 30)])


def test_views_gap_and_chart(dataset: Path, said) -> None:
    told = said(f"info {dataset}")
    assert "largest gap        120°, from 90° clockwise to 210° (azimuths of the training views)" in told
    assert re.search(r"train +45° +17 +210° … 90°, clockwise +15° +120°", told)
    assert re.search(r"test +30° +1 +150° +– +–", told)
    assert "0° (nose)" in told


def test_azimuths_of_a_place_count_from_a_bearing_and_are_rounded(tmp_path: Path, said) -> None:
    """Houses have no nose; and what is 0 but for rounding is said to be."""
    views = [View(azimuth + 4e-12 * (-1) ** k, 45.0) for k, azimuth in enumerate(range(360, 0, -15), 1)]
    told = said(f"info {written(tmp_path, views, place=Place(47.4, 8.5, 430.0, x_towards_deg=90))}")
    assert "0° (compass bearing 90°)" in told
    assert "nose" not in told
    assert re.search(r"train +45° +24 +0° … 345°", told)


def rows(symbols=PRETTY, train=(), test=(), width=80) -> list[str]:
    return sky_chart(train, test, width, symbols).plain.splitlines()


def test_images_with_phase_say_so(dataset: Path, tmp_path: Path, said) -> None:
    power = read_dataset(dataset)
    write_dataset(tmp_path / "complex", Dataset.of_complex(GRID, power.entries, power.power.astype(np.complex64)))
    for path, told in ((dataset, "linear power, float32"), (tmp_path / "complex", "is β⁰, complex64")):
        assert told in said(f"info {path}")


@pytest.mark.parametrize(
    ("deviations", "told"), [((3.0, 0.03), "2 passes, axis ± 3°, rate ± 0.03"), ((0.0, 0.0), "2 passes, known exactly")]
)
def test_rotations_and_their_deviations(tmp_path: Path, said, deviations: tuple[float, float], told: str) -> None:
    turns = [Turn((0, 0, 1), 40.0 * k, *deviations, name=str(k % 2)) for k in range(4)]
    frames = [SarImage(np.ones((8, 8), np.float32), turn.seen_from((1, 0.5, 0.3)), GRID) for turn in turns]
    write_dataset(tmp_path / "data", Dataset.from_images(frames, turns=turns))
    assert f"rotations {told}" in " ".join(said(f"info {tmp_path}/data").split())


def test_where_images_come_from_is_said_in_words(tmp_path: Path, said) -> None:
    source = {
        "kind": "phase-history",
        "around_m": [1.5, 2.0],
        "columns": {"azimuth": "heading"},
        "apertures": [{"name": "000", "pulses": 117}, {"name": "001", "pulses": 118}],
        "assumptions": ["the nose is at 0°", "the ground is flat"],
        "offset": 0.0,
    }
    told = said(f"info {written(tmp_path, RING[:1], source=source)}")
    lines = [" ".join(line.split()) for line in told.splitlines()]
    first = lines.index("assumed the nose is at 0°")
    assert lines[first + 1] == "the ground is flat"
    assert "source.apertures 2, listed in dataset.json" in lines
    assert "source.around_m 1.5, 2.0" in lines
    assert "source.columns azimuth = heading" in lines
    assert not [line for line in lines if line.startswith("source.") and set(line) & set("[]{}'")]


def test_north_is_up_and_azimuths_go_clockwise() -> None:
    def place(view: View) -> tuple[int, int]:
        ((row, line),) = ((r, line) for r, line in enumerate(rows(train=[view])) if "●" in line)
        return row, line.index("●")

    up, right, down, left, middle = (place(View(*angles)) for angles in ((0, 5), (90, 5), (180, 5), (270, 5), (0, 89)))
    assert up[0] < right[0] == left[0] == middle[0] < down[0]
    assert left[1] < up[1] < right[1]
    assert abs(up[1] - middle[1]) <= 1 >= abs(down[1] - middle[1])


def test_narrow_terminals_and_few_letters() -> None:
    assert max(map(len, rows(width=40))) <= 40 < max(map(len, rows(width=80)))
    assert symbols_for("utf-8") is PRETTY
    assert symbols_for("ascii") is symbols_for("latin-1") is PLAIN
    chart = "\n".join(rows(PLAIN, train=RING, test=[View(150, 30)])).replace("°", "")
    assert chart.isascii()
    assert chart.count("o") >= len(RING) - 2  # and the o of nose
    assert chart.count("x") == 1


def test_pictures(dataset: Path, tmp_path: Path, said, refused) -> None:
    pytest.importorskip("matplotlib")
    for _ in range(2):
        said(f"info {dataset} --plot {tmp_path}/sky.png")
        said(f"info {dataset} --plot {tmp_path}/sky.svg")
    assert (tmp_path / "sky.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "sky.svg").read_bytes()
    assert "does not end in .png or .svg" in refused(f"info {dataset} --plot {tmp_path}/sky.bmp")
    assert not (tmp_path / "sky.bmp").exists()


def test_info_lists_datasets_and_runs_in_a_folder(there, tmp_path: Path, unfinished, said) -> None:
    for folder in ("dataset", "run"):
        shutil.copytree(folder, tmp_path / "deep" / folder)
        shutil.copytree(folder, tmp_path / f"bad-{folder}")
    shutil.copytree("run", tmp_path / "begun")
    unfinished(tmp_path / "begun")
    (tmp_path / "begun" / "metrics.json").unlink()
    (tmp_path / "bad-dataset" / "dataset.json").write_text('{"schema": "sarsplat-dataset"}')
    (tmp_path / "bad-run" / "config.json").write_text('{"schema": "sarsplat-run"}')
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "config.json").write_text('{"hidden_size": 768}')
    lines = [" ".join(line.split()) for line in said(f"info {tmp_path}").splitlines()]
    assert lines[0] == f"{tmp_path}: 2 datasets and 3 runs"
    rows = {line.split()[0]: line for line in lines[2:]}
    assert rows["deep/dataset"] == "deep/dataset 16 images of box.obj 8 train, 8 test; 32 × 32 pixels"
    metrics = json.loads(Path("run/metrics.json").read_text())
    psnr_db, cd_m = metrics["images"]["test"]["psnr_target_db"], metrics["points"]["visible"]["cd_m"]
    assert rows["deep/run"].startswith("deep/run run of dataset, seed 0 (sar-gs) finished ")
    assert f"target {psnr_db:.2f} dB" in rows["deep/run"]
    assert f"CD {cd_m:#.3g} m" in rows["deep/run"]
    assert rows["begun"] == "begun run of dataset, seed 0 (sar-gs) unfinished, 4 of 6,000 iterations not evaluated"
    assert "unusable:" in rows["bad-dataset"]
    assert "unusable:" in rows["bad-run"]
    assert "model" not in rows


def test_addresses_are_shown_only_as_folders_to_open(run: Path, tmp_path: Path, said) -> None:
    folders = [tmp_path / "fleet" / "runs" / (digit * 16) for digit in "ab"]
    for folder, iterations in zip(folders, (6000, 20), strict=True):
        shutil.copytree(run, folder)
        config = json.loads((folder / "config.json").read_text())
        config["config"]["iterations"] = iterations
        (folder / "config.json").write_text(json.dumps(config))
    lines = [line.split("  ") for line in said(f"info {tmp_path / 'fleet'}").splitlines()]
    assert lines[1][0] == "holds"
    assert [line[0] for line in lines[2:]] == [f"run of dataset, iterations {n}, seed 0 (sar-gs)" for n in (20, 6000)]
    assert [line[-1].strip() for line in lines[2:]] == [f"runs/{digit * 16}" for digit in "ba"]
    assert names_of(folders) == [f"dataset, iterations {n}, seed 0" for n in (6000, 20)]
    assert names_of([folders[0], run]) == ["dataset, seed 0", "run"]
    assert names_of([run, run.parent / "other" / run.name]) == [str(run), str(run.parent / "other" / run.name)]


def test_a_plan_is_offered_for_several_datasets(there, tmp_path: Path, said, monkeypatch) -> None:
    for name in ("here/one", "here/two", "here/deep/three"):
        shutil.copytree("dataset", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    told = said("info here")
    (tmp_path / "plan.toml").write_text("\n".join(line for line in told.splitlines() if line.startswith("  ")))
    plan = Plan.read(tmp_path / "plan.toml")
    assert plan.seeds == (0, 1, 2)
    assert {path.name for path in plan.folders(tmp_path)} == {"one", "two", "three"}
    assert "and run: sarsplat sweep plan.toml --out here-fleet" in told
    assert "plan.toml" not in said("info here/deep")


def test_info_on_a_run_whose_dataset_has_moved(run: Path, tmp_path: Path, said, refused) -> None:
    before = said(f"info {run}").split()
    header = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**header, "dataset": str(tmp_path / "gone")}))
    after = said(f"info {run}")
    assert "(no longer there)" in after
    assert after.split()[-20:] == before[-20:]  # iterations, Gaussians, points: as with the dataset
    (run / "about.json").unlink()
    assert said(f"info {run}").split()[-20:] == before[-20:]  # as runs of older versions
    assert f"`sarsplat evaluate {run} --dataset DIR`" in refused(f"evaluate {run} --no-points")
    said(f"evaluate {run} --dataset dataset --no-points --no-report")
    header["dataset_fingerprint"] = "another"
    (run / "config.json").write_text(json.dumps(header))
    assert "was made from another dataset than" in refused(f"evaluate {run} --dataset dataset")


def test_info_on_an_unfinished_run_says_how_to_go_on(run: Path, tmp_path: Path, unfinished, said, monkeypatch) -> None:
    """At once: it neither opens the checkpoint nor extracts points."""
    (run / "points.ply").unlink()
    monkeypatch.setattr(Run, "load", None)

    def told() -> list[str]:
        return [" ".join(line.split()) for line in said(f"info {run}").splitlines()]

    lines = told()
    assert "state trained, but its points have not been extracted" in lines
    assert "points none yet" in lines
    assert any(re.fullmatch(r"learned [\d,]+ Gaussians", line) for line in lines)
    unfinished(run)
    with (run / "metrics.jsonl").open("a") as log:  # of a training that was killed after its last checkpoint
        log.write('{"iteration":5,"seconds":9999.0,"loss":0.5}\n')
    lines = told()
    assert "state unfinished, 4 of 6,000 iterations" in lines
    assert "time 9999.0 s" not in lines
    assert lines[-1] == f"go on with: sarsplat reconstruct {Path('dataset').resolve()} --out {run} --resume"
    (run / "checkpoints" / "00005000.copy.safetensors").write_bytes(b"")  # no training names one like this
    assert "state unfinished, 4 of 6,000 iterations" in told()
    (tmp_path / "whole" / "tiles").mkdir(parents=True)
    shutil.copytree(run, tmp_path / "whole" / "tiles" / "3")
    shutil.copy(run / "config.json", tmp_path / "whole" / "config.json")
    first, *_, last = (" ".join(line.split()) for line in said(f"info {tmp_path}/whole/tiles/3").splitlines())
    assert first.endswith(f"tiles/3: a tile of the run {tmp_path}/whole, which goes on with it")
    assert "go on with" not in last
    shutil.rmtree(run / "checkpoints")
    assert "state unfinished, 0 of 6,000 iterations" in told()
    shutil.copy("run/points.ply", run / "points.ply")
    assert "state finished, but its checkpoint is missing, so it can be neither rendered nor continued" in told()


def test_a_run_that_loses_says_so_wherever_it_is_shown(run: Path, tmp_path: Path, ended, said) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["baselines"], metrics["missing"] = {"test": {"rotated_average": {"psnr_db": 99.5}}}, [[1.0, 2.0, 0.5]]
    (run / "metrics.json").write_text(json.dumps(metrics))
    sentence = "warning: on the set test the baseline rotated average, which knows no third dimension, is better than"
    for words in (f"info {run}", f"export {run} {tmp_path}/points.ply --format points", f"compare {run} run"):
        out, err = ended(words, 0)
        assert sentence in err, words
    assert "rotated average" in out  # a column of its own
    assert re.search(r"1 place where images show what points lack: \(1\.0, 2\.0, 0\.5\)", " ".join(out.split()))
    assert "; worse than rotated average on test, 99.50" in " ".join(said(f"info {run.parent}").split())
