import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.evaluation import Lpips, lpips
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.evaluation.lpips import WEIGHTS_VARIABLE, lpips_weights

WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "weights"
needs_weights = pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"the LPIPS weights are not in {WEIGHTS}")


@pytest.fixture(scope="module")
def network() -> Lpips:
    return Lpips(WEIGHTS)


def read(name: str) -> torch.Tensor:
    image = pytest.importorskip("PIL.Image").open(WEIGHTS / "lpips_check_imgs" / f"{name}.png").convert("RGB")
    return torch.from_numpy(np.asarray(image).astype(np.float32) / 127.5 - 1).permute(2, 0, 1)[None]


@needs_weights
@pytest.mark.parametrize(("name", "expected"), [("ex_p0", 0.7219), ("ex_p1", 0.1376)])
def test_published_pairs(network, name, expected):
    assert float(network(read("ex_ref"), read(name))) == pytest.approx(expected, abs=1e-4)


@needs_weights
def test_sets_are_averaged_and_grey_amplitudes_fill_minus_one_to_one(network):
    amplitude = np.random.default_rng(0).random((2, 2, 64, 64), dtype=np.float32)
    truth, rendered = (25 * amplitude**2).astype(np.float32)  # reference amplitude 5
    grey = [torch.from_numpy(a * 2 - 1)[:, None].repeat(1, 3, 1, 1) for a in amplitude]
    assert lpips(truth, rendered, 5.0, network) == pytest.approx(float(network(*grey).mean()), abs=1e-5)
    assert lpips(truth, truth, 5.0, network) == 0.0


@needs_weights
def test_small_images_have_no_lpips(network):
    smallest = np.ones((1, 31, 31), np.float32)
    assert lpips(smallest, smallest, 1.0, network) == 0.0
    with pytest.raises(UndefinedScore, match="30 × 40"):
        lpips(np.ones((1, 30, 40), np.float32), np.ones((1, 30, 40), np.float32), 1.0, network)


class _Exploit:
    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self):
        return Path.touch, (self.victim,)


@needs_weights
@pytest.mark.parametrize("name", ["alexnet_features_torchvision.npz", "lpips_v0.1_lin_alex.pth"])
def test_nothing_is_unpickled_freely(tmp_path, name):
    shutil.copytree(WEIGHTS, tmp_path / "weights", copy_function=shutil.copyfile)
    (tmp_path / "weights" / name).write_bytes(pickle.dumps(_Exploit(tmp_path / "victim"), protocol=2))
    with pytest.raises(SarsplatError, match="no usable LPIPS weights"):
        Lpips(tmp_path / "weights")
    assert not (tmp_path / "victim").exists()


def test_the_argument_goes_before_the_environment(monkeypatch):
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    assert lpips_weights(None) is None
    monkeypatch.setenv(WEIGHTS_VARIABLE, "named")
    assert lpips_weights(None) == Path("named")
    assert lpips_weights(Path("given")) == Path("given")
