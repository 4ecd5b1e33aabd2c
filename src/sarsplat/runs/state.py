"""How far a training is, as its run's folder tells without opening a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingState:
    """How far a training is."""

    done: int
    """Iterations done: those of the newest checkpoint, from which everything is made and a training goes on."""
    planned: int
    """Iterations asked for; as many as are done if the Gaussians were trained elsewhere."""
    has_results: bool
    """Whether its points have been extracted."""

    @property
    def trained(self) -> bool:
        """Whether all iterations are done."""
        return self.done >= self.planned

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return self.trained and self.has_results

    def __str__(self) -> str:
        if self.has_results and not self.done:
            return "finished, but its checkpoint is missing, so it can be neither rendered nor continued"
        if not self.trained:
            return f"unfinished, {self.done:,} of {self.planned:,} iterations"
        return "finished" if self.has_results else "trained, but its points have not been extracted"
