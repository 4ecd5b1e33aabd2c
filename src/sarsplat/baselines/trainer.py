"""Trainer of a baseline: steps, and snapshots that restore its state bit for bit."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sarsplat.baselines.baseline import Baseline, BaselineConfig, Scene
from sarsplat.data import Dataset, Masks
from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.learning.method import Trainable
from sarsplat.learning.snapshot import Snapshot, fitting
from sarsplat.learning.training_images import ViewQueue
from sarsplat.radiometry import from_db, usual_peak
from sarsplat.regions.target_region import target_region

_ABOVE_GROUND_DB = 10.0  # level above the ground's median that speckle hardly reaches: 0.1 % of single-look pixels do


class BaselineTrainer(Trainable):
    """Training of a baseline.

    `model` is that of the dataset's scene (`scene_of`), or of the scene saved with a resumed training.
    """

    def __init__(
        self, dataset: Dataset, config: BaselineConfig, model: Baseline, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.iteration = 0
        self._scene = model.scene
        self._device = torch.device(device)
        self._images = torch.from_numpy(dataset.images("train") / np.float32(self._scene.unit)).to(self._device)
        self._generator = torch.Generator().manual_seed(config.seed)
        self._queue = ViewQueue(len(self._images), config.views_per_step, self._generator)
        self.model = model.to(self._device)
        self._optimiser = self.model.optimiser()
        self._rates = [group["lr"] for group in self._optimiser.param_groups]

    def step(self) -> Float32[Tensor, ""]:
        chosen = torch.tensor(self._queue.next(), device="cpu")
        factor = self.model.rate(self.iteration)
        for group, rate in zip(self._optimiser.param_groups, self._rates, strict=True):
            group["lr"] = rate * factor
        self._optimiser.zero_grad(set_to_none=True)
        loss = self.model.loss(chosen, self._images[chosen.to(self._device)], self._generator)
        loss.backward()
        self._optimiser.step()
        self.iteration += 1
        return loss.detach()

    @property
    def learning_rates(self) -> dict[str, float]:
        factor = self.model.rate(self.iteration)
        return {f"group {index}": rate * factor for index, rate in enumerate(self._rates)}

    def rendered(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        return self.model.images(views)

    def check(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.current_stream(self._device).synchronize()  # another thread may be capturing on another stream

    def snapshot(self, seconds: float) -> Snapshot:
        scene = self._scene
        tensors = {f"model/{name}": tensor for name, tensor in self.model.state_dict().items()}
        for index, state in self._optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser/{index}/{name}": tensor.float() for name, tensor in state.items()}
        tensors |= {"generator": self._generator.get_state(), **_scene_tensors(scene)}
        return Snapshot(
            self.iteration,
            seconds,
            tuple(self._queue.waiting),
            scene.grid,
            scene.views,
            scene.unit,
            scene.brightest * scene.unit,
            {name: tensor.detach().cpu().clone() for name, tensor in tensors.items()},
        )

    def restore(self, snapshot: Snapshot) -> None:
        self._queue.restore(snapshot)
        self.model.load_state_dict(snapshot.like("model", self.model.state_dict()))
        groups = self._optimiser.state_dict()["param_groups"]
        parameters = [parameter for group in self._optimiser.param_groups for parameter in group["params"]]
        states = {
            k: {"step": torch.zeros((), dtype=torch.float32), "exp_avg": parameter, "exp_avg_sq": parameter}
            for k, parameter in enumerate(parameters if snapshot.iteration else ())
        }
        flat = {f"{k}/{name}": tensor for k, state in states.items() for name, tensor in state.items()}
        saved = snapshot.like("optimiser", flat)
        states = {k: {name: saved[f"{k}/{name}"] for name in state} for k, state in states.items()}
        if any(float(state["step"]) != snapshot.iteration for state in states.values()):
            raise ValueError(f"the optimiser has not done {snapshot.iteration} steps")
        self._optimiser.load_state_dict({"state": states, "param_groups": groups})
        self.iteration = snapshot.iteration


def scene_of(dataset: Dataset, masks: Masks | None = None) -> Scene:
    """`Scene` of a dataset's training images; its target box is that of sar-gs."""
    train = dataset.select("train")
    unit = float(train.power.mean(dtype=np.float64))
    if not np.float32(unit):
        raise SarsplatError(f"the training images of {dataset} are black everywhere; simulate or import again")
    if dataset.terrain is not None:
        raise SarsplatError(f"{dataset} has terrain, and this method knows level ground only; use `method='sar-gs'`")
    region = target_region(dataset, ground=dataset.ground)
    return Scene(
        train.views,
        train.grid,
        region.low,
        region.high,
        unit,
        masks,
        _brightest(train) / unit,
        dataset.ground,
        train.looks,
    )


def _brightest(train: Dataset) -> float:
    """Largest power without rare, far brighter echoes (`usual_peak`); ground does not count."""
    ground = float(np.median(train.power)) if train.ground else 0.0
    return usual_peak(train.power[train.power > ground * from_db(_ABOVE_GROUND_DB)]) or float(train.power.max())


def saved_scene(snapshot: Snapshot) -> Scene:
    """`Scene` of a snapshot."""
    saved, grid, masks = snapshot.part("scene"), snapshot.grid, None
    if "masks" in saved:
        masks = fitting(saved, "masks", torch.uint8, (len(snapshot.views), grid.rows, grid.columns)).numpy()
    return Scene(
        snapshot.views,
        grid,
        saved["low_m"].double().numpy(),
        saved["high_m"].double().numpy(),
        snapshot.unit,
        masks,
        snapshot.brightest / snapshot.unit,
        bool(saved["ground"]),
        float(saved["looks"]) or None,
    )


def _scene_tensors(scene: Scene) -> dict[str, Tensor]:
    """Fields of a scene that a snapshot does not already hold."""
    tensors = {
        "low_m": torch.from_numpy(scene.low_m),
        "high_m": torch.from_numpy(scene.high_m),
        "ground": torch.tensor(scene.ground),
        "looks": torch.tensor(scene.looks or 0.0, dtype=torch.float64),
    }
    if scene.masks is not None:
        tensors["masks"] = torch.from_numpy(scene.masks)
    return {f"scene/{name}": tensor for name, tensor in tensors.items()}
