"""Sets of chips: each is the same whoever makes it and whatever else is made, also shared among processes."""

import json
import os
import pickle
import signal
import time
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import torch

from made_runs import GRID, made_up, make_metrics
from sarsplat import ImageGrid, Run, SarsplatError, SarsplatWarning, chips
from sarsplat.samples import Chips, write, write_chips
from sarsplat.samples.chip_set import _warn_of_poor_runs
from sarsplat.samples.write import parallel_map


def test_each_is_the_same_in_any_order_and_by_any_worker(folders: list[Path]) -> None:
    made = chips(folders, count=5, seed=3)
    assert len(made) == 10
    forwards = [made[index] for index in range(10)]
    again = chips(folders, count=7, seed=3)
    assert all(torch.equal(again[index][0], forwards[index][0]) for index in reversed(range(10)))
    loader = torch.utils.data.DataLoader(made, batch_size=5, num_workers=2)
    images, classes = zip(*loader, strict=True)
    assert torch.equal(torch.cat(images), torch.stack([image for image, _ in forwards]))
    assert torch.cat(classes).tolist() == [number for _, number in forwards] == [0, 1] * 5
    assert not torch.equal(chips(folders, count=5, seed=4)[0][0], forwards[0][0])
    assert len(list(iter(made))) == 10  # a loop ends


def test_a_row_of_the_table_draws_its_chip_again(folders: list[Path]) -> None:
    made = chips(folders, count=3, format="npy", scale="calibrated", near="top")
    label = made.label(5)
    assert label.target == made.classes[label.run] == "T-72__a_"
    again = Run.load(folders[label.run]).sample(label.view, label.seed)
    assert np.array_equal(made[5][0][0].numpy(), np.abs(again))
    assert label.view.azimuth_deg == float(f"{label.view.azimuth_deg:.4f}")


def test_views_are_spread_all_around_however_many(run: Run) -> None:
    for count in (8, 50, 333):
        made = chips([run], count=count)
        views = [made.label(index).view for index in range(count)]
        azimuths = np.sort([view.azimuth_deg for view in views])
        gaps = np.diff([*azimuths, azimuths[0] + 360])
        assert gaps.max() < 2.7 * 360 / count
        low, high = min(v.grazing_deg for v in views), max(v.grazing_deg for v in views)
        assert 16 <= low < high <= 16 + 300 / 180  # as the training images
        assert high - low > 0.6 * 300 / 180


def test_views_that_are_asked_for(run: Run) -> None:
    made = chips([run], azimuths_deg=[10, 370.5, -20], grazing_deg=(14.5, 14.5))
    assert [made.label(index).view.azimuth_deg for index in range(len(made))] == [10, 10.5, 340]
    assert {made.label(index).view.grazing_deg for index in range(3)} == {14.5}
    assert chips([run], azimuths_deg=[10, 20], count=5).label(4).view.azimuth_deg == 10


def test_a_run_keeps_its_chips_when_others_join(run: Run, folders: list[Path]) -> None:
    alone, joined = chips([run], count=3), chips([run, *folders], count=3)
    for number in range(3):
        assert torch.equal(alone[number][0], joined[3 * number][0])


def test_runs_that_do_not_go_together(run: Run, folders: list[Path]) -> None:
    other = made_up("other", grid=replace(GRID, columns=32))
    with pytest.raises(SarsplatError, match=r"of 32 × 32 pixels, but .* of 32 × 36; cut all to one size"):
        chips([folders[0], other])
    assert {image.shape for image, _ in iter(chips([folders[0], other], count=1, crop=30))} == {(1, 30, 30)}
    coarser = made_up("coarser", grid=ImageGrid(32, 36, (0.3, 0.3), GRID.resolution_m))
    with pytest.raises(SarsplatError, match=r"pixels of 0.3 m × 0.3 m, .* with the same pixels"):
        chips([folders[0], coarser], crop=30)
    assert isinstance(chips([run, *folders]), Chips)
    quick = made_up("box")
    quick = replace(quick, config=replace(quick.config, loss="amplitude", surroundings=None))
    with pytest.raises(SarsplatError, match=r"^the run in memory: this run was learned without speckle"):
        chips([run, quick])
    with pytest.raises(SarsplatError, match=r"^'T-72 \(a\)' and 'T-72 \[a\]' are two classes .* called T-72__a_;"):
        chips([folders[1], made_up("T-72 [a]")])


def test_workers_that_begin_empty_make_the_same(folders: list[Path]) -> None:
    """As on Windows and macOS, and wherever a GPU is used."""
    for some in (folders, [made_up("in memory")]):
        made = chips(some, count=2)
        first = made[0][0]
        again = pickle.loads(pickle.dumps(made))
        assert torch.equal(again[0][0], first)
        assert again.classes == made.classes


def test_a_run_knows_what_it_shows_without_its_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made_up("T-72", tmp_path / "some-run").folder
    (tmp_path / "some-run-data").rename(tmp_path / "elsewhere")
    assert chips([folder], count=1).classes == ("T-72",)
    header = json.loads((folder / "config.json").read_text())
    del header["target"]  # as runs of before
    (folder / "config.json").write_text(json.dumps(header))
    assert chips([folder], count=1).classes == ("some-run",)
    monkeypatch.chdir(folder)
    assert chips(["."], count=1).classes == ("some-run",)


def test_runs_that_lose_or_were_never_evaluated_are_warned_of(folders: list[Path]) -> None:
    runs = [replace(Run.load(folder)) for folder in folders]
    nats = "registered_nats_per_pixel"
    first, second = (Run.from_gaussians(run.gaussians) for run in runs)
    assert first.metrics is None
    scores = make_metrics(**{nats: 0.625}) | {"time_s": 1.0, "seed": 0}
    first.keep(scores | {"baselines": {"test": {"rotated_average": {nats: 0.5}}}})
    with pytest.warns(SarsplatWarning) as caught:
        _warn_of_poor_runs([first, second, second])
    worse, unknown = (str(one.message) for one in caught)
    assert worse == (
        "on the set test the baseline rotated average, which knows no third dimension, is better than the run in "
        "memory: negative log-likelihood, registered, nats/pixel 0.500 against 0.625; its chips may teach a classifier "
        "less than the training images do"
    )
    assert unknown.startswith(
        "the run in memory and 1 more were never evaluated on unseen images, so whether the chips look like"
    )
    chips(runs, count=1)  # evaluated, and no worse


def test_angles_that_no_training_image_has_seen_are_warned_of(run: Run) -> None:
    with pytest.warns(
        SarsplatWarning, match=r"of 16° to 40° are up to 22° from those that a run of box has seen \(16° to 17.67°\)"
    ):
        chips([run], count=1, grazing_deg=(16.0, 40.0))
    chips([run], count=1, grazing_deg=(14.5, 20.0))


def test_chips_look_as_the_images_of_their_run_do(tmp_path: Path) -> None:
    made = chips([made_up("box", tilt_deg=12.0)], count=3)
    assert {(made.label(k).view.tilt_deg, made.label(k).view.side) for k in range(3)} == {(12.0, "left")}
    write_chips(made, tmp_path / "set")
    lines = (tmp_path / "set" / "labels.csv").read_text().splitlines()
    assert lines[0].endswith(",tilt_deg,look") and all(line.endswith(",12.0,left") for line in lines[1:])
    assert "tilt" not in ",".join(write._columns(chips([made_up("box")], count=1)))


# ---- work shared among processes -------------------------------------------------------------------------------------
@pytest.fixture(params=[1, 2])
def count(request, threads):
    threads(request.param)
    return request.param


def test_results_come_in_order_from_as_many_processes_as_there_are_threads(count: int) -> None:
    made = list(parallel_map(lambda index: (index, os.getpid(), torch.get_num_threads()), range(500, 0, -1)))
    assert [index for index, _, _ in made] == list(range(500, 0, -1))
    assert {one for _, _, one in made} == {1}
    processes = {process for _, process, _ in made}
    assert len(processes) == count
    assert (os.getpid() in processes) == (count == 1)


def test_few_are_made_here(count: int) -> None:
    assert set(parallel_map(lambda _: os.getpid(), range(20))) == {os.getpid()}
    assert list(parallel_map(str, [])) == []


def test_a_polite_kill_of_all_is_left_to_the_first_process(count: int) -> None:
    def work(index: int) -> int:
        if index == 130 and os.getpid() != first:
            os.kill(os.getpid(), signal.SIGTERM)
        return index

    first = os.getpid()
    assert list(parallel_map(work, range(300))) == list(range(300))


def long_results(tell: Connection) -> None:
    torch.set_num_threads(2)
    for number, (process, _) in enumerate(parallel_map(lambda _: (os.getpid(), bytes(100_000)), range(1000))):
        tell.send(process)
        if number == 100:
            time.sleep(60)


def lives(process: int) -> bool:
    """Also false of one whose end nobody has asked about yet."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    return False


def test_processes_end_with_the_first_one_however_that_ends() -> None:
    processes = get_context("fork")
    told, tell = processes.Pipe(duplex=False)
    first = processes.Process(target=long_results, args=(tell,))
    first.start()
    try:
        workers = {told.recv() for _ in range(101) if told.poll(1)}
    finally:
        first.kill()
        first.join()
    assert len(workers) == 2
    until = time.monotonic() + 10
    while any(map(lives, workers)):
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_failure_is_raised_where_it_was_in_the_same_words(count: int) -> None:
    def work(index: int) -> int:
        if index == 130:
            raise SarsplatError("the disk is full; make room")
        return index

    made = parallel_map(work, range(300))
    assert [next(made) for _ in range(130)] == list(range(130))
    with pytest.raises(SarsplatError, match=r"^the disk is full; make room$"):
        next(made)
