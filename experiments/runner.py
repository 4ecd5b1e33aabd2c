"""Run the cells that are missing, each in a process of its own, and say how long the rest will take."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path

from cell import Cell

from sarsplat.errors import SarsplatError
from sarsplat.reconstruction.presets import PRESETS

_PROGRAM = Path(__file__).with_name("cell.py")
_FIXED_S, _GAUSSIAN_STEP_S, _STEP_GAUSSIANS, _USUAL = 25.0, 7e-8, 20_000, 4000
"""Seconds on two cores: of simulation and evaluation, of a Gaussian in a step; a step costs as many besides.
Last, how many Gaussians there are about where the images say how many."""


def expected_s(cell: Cell) -> float:
    """About how long a cell takes, s: only the ratios between cells matter."""
    config = cell.config(PRESETS["default" if cell.preset == "auto" else cell.preset])
    images = config.iterations * config.views_per_step
    return _FIXED_S + images * ((config.gaussians or _USUAL) + _STEP_GAUSSIANS) * _GAUSSIAN_STEP_S


@dataclass
class Runner:
    """Runs cells, several at a time, and keeps the account.

    Attributes
    ----------
    work : pathlib.Path
        Folder of datasets and finished cells.
    code : str
        Version of the code.
    processes : int
        Cells at a time, each with one thread: most of a cell's time runs on one thread whatever it is given.
    failed : list of str
        What did not work, and why.
    """

    work: Path
    code: str
    processes: int
    failed: list[str] = field(default_factory=list)
    _total_s: float = 0.0
    _done_s: float = 0.0
    _begun: float = field(default_factory=time.monotonic)

    def plan(self, cells: Sequence[Cell]) -> int:
        """Number of those that are not finished: all that will be asked for, which the time left is of."""
        todo = self.missing(cells)
        self._total_s = sum(map(expected_s, todo))
        return len(todo)

    def missing(self, cells: Sequence[Cell]) -> list[Cell]:
        """Those that are not finished, each once."""
        by_path = {cell.path(self.work, self.code): cell for cell in cells}
        return [cell for path, cell in by_path.items() if not path.is_file()]

    def run(self, name: str, cells: Sequence[Cell], alone: bool) -> None:
        """Run what is missing of one experiment; a cell that fails is noted, and the others go on.

        Parameters
        ----------
        name : str
            What to call it.
        cells : sequence of Cell
            All of its cells.
        alone : bool
            One at a time, each with all threads.
        """
        todo = self.missing(cells)
        threads = {} if alone else {"OMP_NUM_THREADS": "1"}
        environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **threads}
        with ThreadPoolExecutor(1 if alone else self.processes) as pool:
            futures = {pool.submit(self._one, cell, environment): cell for cell in todo}
            try:
                for count, future in enumerate(as_completed(futures), 1):
                    self._tell(f"{name} {count}/{len(todo)}", futures[future], future.result())
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def _one(self, cell: Cell, environment: dict[str, str]) -> str:
        """Run a cell; returns the reason if it failed, and raises where no other can be run either."""
        done = subprocess.run(
            [sys.executable, str(_PROGRAM), str(self.work)],
            input=json.dumps(asdict(cell)),
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode == 0 and not cell.path(self.work, self.code).is_file():
            raise SarsplatError("the package's sources have changed since the tables were started; start them again")
        lines = done.stderr.strip().splitlines()
        return "" if done.returncode == 0 else lines[-1] if lines else f"exit code {done.returncode}"

    def _tell(self, where: str, cell: Cell, reason: str) -> None:
        self._done_s += expected_s(cell)
        spent = time.monotonic() - self._begun
        left = spent / self._done_s * (self._total_s - self._done_s)
        scene, changes = (
            " ".join(f"{name}={_shown(value)}" for name, value in options.items())
            for options in (cell.dataset, cell.changes)
        )
        what = " ".join(filter(None, (scene, cell.preset, changes, f"seed {cell.seed}")))
        if reason:
            self.failed.append(f"{what}: {reason}")
            what += f" FAILED: {reason}"
        print(f"{where}: {what}; {_duration(left)} left", flush=True)


def _shown(value: object) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def _duration(seconds: float) -> str:
    minutes = round(max(seconds, 0) / 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
