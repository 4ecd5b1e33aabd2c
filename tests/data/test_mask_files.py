"""Masks from a folder of pictures, and into one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chip_files import LOWER_LEFT, write_chips
from made import small_dataset, small_mask
from sarsplat.data import Dataset, DatasetEntry, read_dataset, read_masks, write_dataset
from sarsplat.errors import SarsplatError, SarsplatWarning

Image = pytest.importorskip("PIL.Image")


def named(dataset: Dataset, name: str) -> Dataset:
    entries = (DatasetEntry(entry.view, entry.split, f"{name}{k}.jpeg") for k, entry in enumerate(dataset.entries))
    return replace(dataset, entries=tuple(entries))


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def test_masks_are_found_by_the_names_of_the_test_images(tmp_path):
    for name in ("000", "002"):  # one of a training image, which is not scored
        save(tmp_path / f"{name}.png", small_mask())
    masks = read_masks(tmp_path, small_dataset())
    assert list(masks) == [2]
    np.testing.assert_array_equal(masks[2], small_mask())


def test_training_images_need_a_mask_each(tmp_path):
    dataset = named(small_dataset(), "view")
    entries = (dataset.entries[0], replace(dataset.entries[1], split="train"), dataset.entries[2])
    dataset = replace(dataset, entries=entries)
    save(tmp_path / "view1.png", small_mask())
    with pytest.raises(SarsplatError, match=r"no mask of 1 of 2 training images, the first .*view0\.png; give one for"):
        read_masks(tmp_path, dataset, ["train"])
    save(tmp_path / "view0.png", small_mask()[::-1])
    masks = read_masks(tmp_path, dataset, ["train"])
    assert list(masks) == [0, 1]
    np.testing.assert_array_equal(masks[0], small_mask()[::-1])
    assert list(read_masks(tmp_path, dataset, ["train", "test"])) == [0, 1]  # test images may lack theirs


def test_masks_are_written_beside_the_images_and_found_again(tmp_path):
    masks = np.stack([small_mask(), small_mask()[::-1], small_mask()[:, ::-1]])
    written = write_dataset(tmp_path / "set", small_dataset(), masks=masks)
    assert sorted(path.name for path in (tmp_path / "set/masks").iterdir()) == ["000.png", "001.png", "002.png"]
    dataset = read_dataset(tmp_path / "set")
    found = read_masks(tmp_path / "set/masks", dataset, dataset.splits())
    np.testing.assert_array_equal(np.stack(list(found.values())), masks)
    assert dataset.fingerprint() == written.fingerprint() == small_dataset().fingerprint()
    levelled = dataset.power * np.array([0.3, 7.0, 1.1], np.float32)[:, None, None]
    write_dataset(tmp_path / "levelled", replace(dataset, power=levelled))
    found = read_masks(tmp_path / "levelled/masks", dataset, dataset.splits())
    np.testing.assert_array_equal(np.stack(list(found.values())), masks)
    with pytest.warns(SarsplatWarning, match="left out masks of"):
        write_dataset(tmp_path / "turned", replace(dataset, power=dataset.power + np.arange(12, dtype="f4")))
    write_dataset(tmp_path / "set", small_dataset(), overwrite=True)
    assert not (tmp_path / "set/masks").exists()


@pytest.mark.parametrize("mirrored", [False, True])
def test_masks_of_chips_are_turned_as_the_chips_were(tmp_path, mirrored):
    published = small_mask()[::-1] if mirrored else small_mask()[::-1, ::-1]
    published = np.pad(published, 2)  # chips of several sizes are cut
    save(tmp_path / "T72" / "17deg" / "hb1.png", published)
    source = {"kind": "mstar", "mirrored": mirrored}
    dataset = named(small_dataset(source={**source, "cut_to_common_size": True}), "T72/17deg/hb")
    np.testing.assert_array_equal(read_masks(tmp_path, dataset)[1], small_mask())


@pytest.mark.filterwarnings("ignore::sarsplat.SarsplatWarning")  # three chips alike
def test_chips_and_their_masks_are_turned_alike(tmp_path):
    from sarsplat import import_mstar

    labels = write_chips(tmp_path, [("T72", "1", 17, azimuth) for azimuth in (0, 120, 240)])
    for index in range(3):
        save(tmp_path / "masks" / "T72" / f"chip{index:03d}.png", (LOWER_LEFT > 0).astype(np.uint8))
    dataset = import_mstar(tmp_path, tmp_path / "out", labels=labels, target_class="T72", train_views=2)
    ((index, found),) = read_masks(tmp_path / "masks", dataset).items()
    power = dataset.power[index]
    assert found.sum() == 64
    assert power[found == 1].min() > 4 * power[found == 0].max()
