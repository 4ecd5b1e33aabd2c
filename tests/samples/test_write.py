"""Sets of chips as files: read back by the importers, and the same after any stop."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from made import read_table
from sarsplat import Run, SarsplatError, chips, import_folder, import_mstar
from sarsplat.importers.pictures import read_pixels
from sarsplat.samples import Chips, write, write_chips


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_mstar_reads_a_class_back(folders: list[Path], tmp_path: Path) -> None:
    made = chips(
        folders, azimuths_deg=[0, 90, 180, 270, 45, 135], grazing_deg=(17, 17.2), jpeg_quality=100, near="left"
    )
    write_chips(made, tmp_path / "set")
    table = tmp_path / "set" / "labels.csv"
    back = import_mstar(
        tmp_path / "set", tmp_path / "back", labels=table, target_class="T-72__a_", train_views=4, test=False
    )
    assert sorted(view.azimuth_deg for view in back.views) == [0, 90, 180, 270]
    place = [view.azimuth_deg for view in back.views].index(90)
    assert back.views[place] == made.label(3).view
    grid = made.runs[0].grid
    assert (back.grid.spacing_m, back.grid.resolution_m) == (grid.spacing_m, grid.resolution_m)
    power = np.abs(made.sample(3)) ** 2
    found = back.power[place]
    bright = power > power.max() / 30
    assert found[bright] / found.max() == pytest.approx(power[bright] / power.max(), rel=0.15)


@pytest.mark.parametrize(("format", "quantity"), [("npy", "complex"), ("npy", "power"), ("png", "magnitude")])
def test_pictures_are_read_back(run: Run, tmp_path: Path, format: str, quantity: str) -> None:
    made = chips([run], count=3, format=format, quantity=quantity, crop=24, near="left")
    write_chips(made, tmp_path / "set")
    back = import_folder(tmp_path / "set", tmp_path / "back")
    assert [view.azimuth_deg for view in back.views] == [made.label(index).view.azimuth_deg for index in range(3)]
    assert back.grid.spacing_m == run.grid.spacing_m
    assert back.grid.resolution_m == run.grid.resolution_m
    wanted = made.sample(1)[4:28, 6:30]
    if quantity == "complex":
        assert back.signal is not None
        phase = back.signal[1] * wanted.conj()
        assert np.abs(np.angle(phase)).max() < 1e-4
    means = [float(np.mean(np.abs(made.sample(index)[4:28, 6:30]) ** 2)) for index in range(3)]
    power = np.abs(wanted) ** 2 / np.mean(means)
    assert back.power[1] / back.power.mean() == pytest.approx(power, abs=0.01 * power.max())


def test_a_folder_of_several_classes_is_imported_class_by_class(folders: list[Path], tmp_path: Path) -> None:
    write_chips(chips(folders, count=3, format="npy"), tmp_path / "set")
    with pytest.raises(SarsplatError, match=r"pictures of 2 classes \(box, T-72__a_\); choose one as `target_class`"):
        import_folder(tmp_path / "set", tmp_path / "back", near="bottom", quantity="amplitude")
    back = import_folder(tmp_path / "set", tmp_path / "back", target_class="box")
    assert (len(back), back.target) == (3, "box")
    assert {Path(entry.name).parent.name for entry in back.entries} == {"box"}


def test_the_table_says_what_each_shows(folders: list[Path], tmp_path: Path) -> None:
    made = chips(folders, count=2)
    write_chips(made, tmp_path / "set")
    rows = read_table(tmp_path / "set" / "labels.csv")
    for index, row in enumerate(rows):
        label = made.label(index)
        assert (row["class"], int(row["seed"]), row["run"]) == (label.target, label.seed, str(folders[label.run]))
        angles = label.view.azimuth_deg, label.view.grazing_deg
        assert (float(row["azimuth_deg"]), float(row["grazing_deg"])) == angles
        stored = read_pixels(tmp_path / "set" / row["path"])
        assert np.array_equal(stored, made[index][0][0].numpy())
    assert len(rows) == len(tree(tmp_path / "set")) - 2


@pytest.mark.parametrize("shard", [None, 2])
def test_stopped_anywhere_it_goes_on_and_ends_the_same(run: Run, tmp_path, shard: int | None, monkeypatch) -> None:
    made = chips([run], count=5)
    write_chips(made, tmp_path / "whole", shard=shard)
    encode, drawn, left = write._encoded, [], 3

    def stops(chips: object, index: int) -> tuple[bytes, float]:
        drawn.append(index)
        if len(drawn) > left:
            raise KeyboardInterrupt
        return encode(made, index)

    monkeypatch.setattr(write, "_encoded", stops)
    out = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        write_chips(made, out, shard=shard)
    assert not out.exists()
    drawn.clear()
    left = 100
    write_chips(made, out, shard=shard)
    assert set(drawn) == ({3, 4} if shard is None else {2, 3, 4})
    assert tree(out) == tree(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stopped", "whole"]


@pytest.mark.parametrize("changed", ["seed", "picture"])
def test_another_set_is_not_gone_on_with_and_not_lost(run: Run, tmp_path, changed, monkeypatch) -> None:
    def made(seed: int, level: int) -> Chips:
        picture = np.full((40, 40), 40, np.uint8)
        picture[20:] = level
        Image.fromarray(picture).save(tmp_path / "ground.png")  # under the same name
        return chips([run], count=3, seed=seed, ground=tmp_path / "ground.png")

    first = made(0, 80)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(write, "_table", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        write_chips(first, tmp_path / "set")
    other = made(1, 80) if changed == "seed" else made(0, 120)
    what = r"seed \(0, not 1\)" if changed == "seed" else "the picture of the ground"
    with pytest.raises(SarsplatError, match=f"unfinished set that differs in {what}; go on with it"):
        write_chips(other, tmp_path / "set")
    header = next(tmp_path.glob(".set.sarsplat-new/chips.json"))
    text = header.read_text()
    header.write_text(text.replace('"schema_version": 5', '"schema_version": 3'))
    with pytest.raises(SarsplatError, match="that has a header that this version of the program does not read"):
        write_chips(first, tmp_path / "set")
    header.write_text(text.replace('"program": "', '"program": "0.'))
    with pytest.raises(SarsplatError, match=r"differs in program \('0\..*', not '.*'\)"):
        write_chips(made(0, 80), tmp_path / "set")
    write_chips(other, tmp_path / "set", overwrite=True)
    write_chips(other, tmp_path / "alone")
    assert tree(tmp_path / "set") == tree(tmp_path / "alone")


def test_numbers_of_numpy_make_the_same_files(run: Run, tmp_path: Path) -> None:
    angles = {"azimuths_deg": (angle for angle in np.arange(0, 360, 90)), "grazing_deg": np.array([16, 17])}
    plain = {"count": 3, "seed": 2, "crop": 20, "jpeg_quality": 80}
    numbers: dict[str, Any] = {name: np.uint8(number) for name, number in plain.items()}
    made = chips([run], **angles, **numbers, scatterers=np.float32(3))
    write_chips(made, tmp_path / "set", shard=np.int64(2))
    made = chips([run], azimuths_deg=[0, 90, 180, 270], grazing_deg=(16.0, 17.0), **plain, scatterers=3.0)
    write_chips(made, tmp_path / "plain", shard=2)
    assert tree(tmp_path / "set") == tree(tmp_path / "plain")


def test_shards_hold_image_class_and_row(folders: list[Path], tmp_path: Path) -> None:
    made = chips(folders, count=2, format="npy")
    write_chips(made, tmp_path / "set", shard=3)
    assert sorted(tree(tmp_path / "set")) == ["chips-000000.tar", "chips-000001.tar", "chips.json", "labels.csv"]
    with tarfile.open(tmp_path / "set" / "chips-000001.tar") as tar:
        files = {member.name: tar.extractfile(member).read() for member in tar}
    assert list(files) == ["00000003.npy", "00000003.cls", "00000003.json"]
    assert np.array_equal(np.load(io.BytesIO(files["00000003.npy"])), made[3][0][0].numpy())
    assert int(files["00000003.cls"]) == made[3][1] == 1
    row = json.loads(files["00000003.json"])
    assert row["azimuth_deg"] == made.label(3).view.azimuth_deg
    assert (row["near_side"], row["serial"]) == ("bottom", "")
    assert np.abs(made.sample(3)).max() * row["dn_per_magnitude"] == pytest.approx(1)
