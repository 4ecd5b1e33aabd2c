"""How far a run's training is, as the files in its folder tell: takes no torch and opens no checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sarsplat.runs.log import LogLine, read_log
from sarsplat.runs.run_folder import POINTS, Header
from sarsplat.settings.config import OWN_LOOP


@dataclass(frozen=True)
class TrainingState:
    """How far a training is.

    Attributes
    ----------
    done : int
        Iterations done: those of the newest checkpoint, from which everything is made and a training goes on.
    planned : int
        Iterations asked for; as many as are done if the Gaussians were trained elsewhere.
    has_results : bool
        Whether its points have been extracted.
    last : LogLine or None
        The last line of its log that is not newer than the checkpoint.
    """

    done: int
    planned: int
    has_results: bool
    last: LogLine | None

    @property
    def trained(self) -> bool:
        """Whether all iterations are done."""
        return self.done >= self.planned

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return self.trained and self.has_results

    def __str__(self) -> str:
        if not self.trained:
            return f"unfinished, {self.done:,} of {self.planned:,} iterations"
        return "finished" if self.has_results else "trained, but its points have not been extracted"


def state_of(path: Path, header: Header) -> TrainingState:
    """The state of the training in a folder with this header."""
    checkpoints = [int(file.stem) for file in (path / "checkpoints").glob("*.safetensors") if file.stem.isdecimal()]
    done = max(checkpoints, default=0)
    planned, lines = header.config.get("iterations"), read_log(path / "metrics.jsonl")
    if header.config.get("preset") == OWN_LOOP or not isinstance(planned, int):
        planned = done
    last = next((line for line in reversed(lines) if line.iteration <= done), None)
    return TrainingState(done, planned, (path / POINTS).is_file(), last)
