"""`sarsplat render`: what a name stands for, sweeps, and other pixels than the run's."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from sarsplat import Run, SarsplatError, SarsplatWarning, View
from sarsplat.report.rendered import asked_grid, sweep_views


@pytest.fixture(scope="module")
def run(workshop: Path) -> Path:
    return workshop / "run"


def frames_of(path: Path) -> list[np.ndarray]:
    if path.suffix == ".mp4":
        cv2 = pytest.importorskip("cv2")
        video, frames = cv2.VideoCapture(str(path)), []
        while (read := video.read())[0]:
            frames.append(read[1].mean(axis=2))
        return frames
    frames = []
    animation: Any
    with Image.open(path) as animation:
        assert animation.info["loop"] == 0  # for ever
        for number in range(animation.n_frames):
            animation.seek(number)
            frames.append(np.asarray(animation.convert("L"), dtype=float))
    return frames


@pytest.mark.parametrize("ending", ["gif", "webp", "mp4"])
def test_a_sweep_all_around_is_an_animation_without_a_jump(run: Path, tmp_path: Path, ending: str, said) -> None:
    out = tmp_path / f"sweep.{ending}"
    said(f"render {run} --sweep azimuth --frames 12 --seconds 1.2 --out {out}")
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    frames = frames_of(out)
    assert len(frames) == 12
    picture = np.stack(frames)[:, :400]  # without what is written below
    assert picture.max() > 100
    steps = [np.abs(picture[k] - picture[k - 1]).mean() for k in range(12)]
    assert 0 < steps[0] < 2 * np.median(steps[1:])  # from the last one to the first


def test_a_grazing_sweep_goes_there_and_back(run: Path, tmp_path: Path, said) -> None:
    words = "--sweep grazing --grazing 20 70 --azimuth 33 --frames 8 --overwrite"
    for _ in range(2):
        said(f"render {run} {words} --out {tmp_path}/sweep.gif")
    frames = frames_of(tmp_path / "sweep.gif")
    for number in (1, 2, 3):
        np.testing.assert_array_equal(frames[number], frames[8 - number])
    assert np.abs(frames[0] - frames[4]).mean() > 0.5


def test_a_sweep_in_a_folder_has_each_view_once(run: Path, tmp_path: Path, said) -> None:
    said(f"render {run} --sweep grazing --frames 6 --out {tmp_path}/images")
    names = sorted(path.name for path in (tmp_path / "images").glob("*.tif"))
    assert names == [f"az000_gr{grazing}.tif" for grazing in ("30", "37.5", "52.5", "60")]


def test_one_image(run: Path, tmp_path: Path, said) -> None:
    render = f"render {run} --azimuth 40 --grazing 45 --range 20"
    for name in ("one.tif", "one.png", "c.png --cmap viridis"):
        said(f"{render} --out {tmp_path}/{name}")
    power = tifffile.imread(tmp_path / "one.tif")
    assert power.dtype == np.float32
    np.testing.assert_array_equal(power, Run.load(run).render([View(40, 45)])[0])
    shade = np.clip(1 + 10 * np.log10(np.maximum(power, 1e-30) / Run.load(run).brightest) / 20, 0, 1)
    np.testing.assert_allclose(np.asarray(Image.open(tmp_path / "one.png")), 255 * shade, atol=0.51)
    assert Image.open(tmp_path / "c.png").convert("RGB").getpixel((0, 0)) == (68, 1, 84)  # viridis begins there


def test_levels_of_uncalibrated_images_are_not_given_as_power(run: Path, tmp_path: Path, said) -> None:
    render, header = f"render {run} --azimuth 0 --grazing 45 --out {tmp_path}", run.parent / "dataset" / "dataset.json"
    assert "brightest training pixel, β⁰ = " in said(f"{render}/a.png")
    text = header.read_text()
    header.write_text(text.replace('"absolute"', '"relative"'))
    told = said(f"{render}/b.png")
    header.write_text(text)
    assert "brightest training pixel, β⁰ up to an unknown factor;" in told


def test_other_pixels_show_the_same_power(run: Path) -> None:
    """The cross-section, β⁰ times the area of the pixels, is that of the run's own images."""
    done = Run.load(run)
    own = done.grid
    expected = done.render([View(40, 45)]).sum() * np.prod(own.spacing_m)
    for pixels, spacing, resolution in [((90, 70), 0.15, None), (None, 0.2, 0.9), ((20, 41), None, None)]:
        grid = asked_grid(own, pixels, spacing, resolution)
        image = done.render([View(40, 45)], grid)[0]
        assert image.shape == (pixels or (48, 48))
        assert image.sum() * np.prod(grid.spacing_m) == pytest.approx(expected, rel=0.01)
    with pytest.warns(SarsplatWarning, match=r"a resolution of 0\.1 m is finer than the 0\.3 m of the training images"):
        done.render([View(40, 45)], asked_grid(own, None, 0.1, 0.1))


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("--azimuth 0 --grazing 45 --out r.avi", "looks like a file, but images are written to .mp4, .gif, .webp"),
        ("--azimuth 0 --grazing 45 --out r.mp4", "is an animation but one view was asked for"),
        ("--azimuth 0:90:30 --grazing 45 --out r.png", "holds one image but 3 views were asked for"),
        ("--sweep azimuth --frames 1 --out r", "a sweep of 1 frames does not move"),
        ("--sweep azimuth --azimuth 0:40:10 --out r.gif", "was given 4 azimuth angles and 0 of grazing"),
        ("--sweep azimuth --azimuth 5 5 --out r.gif", "begins and ends at 5°"),
        ("--sweep azimuth --grazing 30 --incidence 60 --out r.gif", "but --incidence was given"),
        ("--sweep azimuth --seconds 0 --out r.gif", "cannot take 0 s"),
        ("--sweep azimuth --seconds 0.5 --out r.gif", "at most 50 frames a second"),
        ("--sweep azimuth --cmap plaid --out r.gif", "there is no colour map 'plaid'"),
        ("--sweep azimuth --range 0 --out r.gif", "a range of 0.0 dB cannot be shown"),
        ("--azimuth 0 --grazing 45 --pixels 0 20 --out r", "is empty"),
        ("--azimuth 0 --grazing 45 --pixels 131072 131072 --out r", "GiB are free; ask for fewer or smaller images"),
        ("--sweep azimuth --frames 4 --seconds 1 --out r.mp4", "[video]', or write a .gif or .webp file"),
        ("--sweep azimuth --out thesis.gif", "already exists"),
        ("--sweep azimuth --out thesis.gif --overwrite", "not a .gif file as exported"),
        ("--sweep azimuth --out {run}/new.gif", "is inside the run"),
    ],
)
def test_what_is_refused(run: Path, tmp_path: Path, words: str, complaint: str, monkeypatch, refused) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "cv2", None)
    if "--seconds" not in words:
        monkeypatch.setattr(Run, "render", lambda *_: pytest.fail("must not get here"))
    Path("thesis.gif").write_text("\\documentclass")
    assert complaint in refused(f"render {run} {words.format(run=run)}")
    assert {path: path.read_text() for path in tmp_path.iterdir()} == {tmp_path / "thesis.gif": "\\documentclass"}


def test_a_run_of_one_grazing_angle_needs_the_ends_of_its_sweep() -> None:
    known = [View(azimuth, 17.0) for azimuth in (0, 90)]
    with pytest.raises(SarsplatError, match=r"all training views have the grazing angle 17°.*--grazing 10 60"):
        sweep_views("grazing", 8, known)
    assert {view.grazing_deg for view in sweep_views("azimuth", 8, known)} == {17.0}


def test_a_dataset_is_no_run_whatever_the_angles(run: Path, tmp_path: Path, refused) -> None:
    dataset, made = tmp_path / "d", tmp_path / "d-run"
    dataset.symlink_to(run.with_name("dataset"))
    told = refused(["render", str(dataset), "--out", str(tmp_path / "new")])
    assert f"give a run of it, which `sarsplat reconstruct {dataset} --out {made}` makes" in told


def test_no_points_lead_to_a_longer_training(run: Path, tmp_path: Path, monkeypatch, ended) -> None:
    out, dataset = tmp_path / "short", run.with_name("dataset")
    monkeypatch.setattr(Run, "points", np.zeros((0, 3), np.float32))
    told, complaints = ended(f"reconstruct {dataset} --out {out} --iterations 2 --gaussians 20", 0)
    assert "and 0 points" in told
    assert f"train longer, such as with `sarsplat reconstruct {dataset} --out {out} --resume --iter" in complaints
