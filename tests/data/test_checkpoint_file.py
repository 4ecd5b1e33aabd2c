"""Checkpoints: bit for bit, or a clear refusal."""

import pytest
import torch

from sarsplat.data import load_checkpoint, save_checkpoint
from sarsplat.errors import SarsplatError

STATE = {"step": 7, "lr": 0.1 + 0.2, "generator": {"state": 2**70, "name": "PCG64"}, "history": [1.5, None, "ü"]}


def tensors() -> dict[str, torch.Tensor]:
    base = torch.randn(4, 3, requires_grad=True)
    return {
        "means": base,
        "means.transposed": base.T,  # shares memory, and is not contiguous
        "double": torch.tensor(1 / 3, dtype=torch.float64),
        "bytes": torch.arange(256, dtype=torch.uint8),
        "mask": torch.tensor([True, False]),
        "empty": torch.empty(0, 16),
        "odd": torch.tensor([float("nan"), float("-inf"), -0.0]),
    }


def test_round_trip(tmp_path):
    path = tmp_path / "a.safetensors"
    written = tensors()
    save_checkpoint(path, written, STATE)
    read, state = load_checkpoint(path)
    assert state == STATE
    assert read.keys() == written.keys()
    for name, tensor in written.items():
        assert read[name].dtype == tensor.dtype
        torch.testing.assert_close(read[name], tensor.detach(), rtol=0, atol=0, equal_nan=True)


def test_what_was_loaded_survives_the_next_save(tmp_path):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, {"x": torch.ones(1000)}, {})
    loaded, _ = load_checkpoint(path)
    save_checkpoint(path, {"x": torch.zeros(1000)}, {})
    assert loaded["x"].sum() == 1000
    loaded["x"] += 1  # and may be written to, without touching the file
    assert load_checkpoint(path)[0]["x"].sum() == 0


def test_a_failed_save_keeps_the_old_one(tmp_path):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, tensors(), {"step": 1})
    with pytest.raises(SarsplatError, match="JSON"):
        save_checkpoint(path, tensors(), {"loss": float("nan")})
    assert load_checkpoint(path)[1] == {"step": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
