"""Chips whose order alone is known, as of a turntable whose start and sense are not: both senses are learned from.

Prints, for true azimuths and for even steps in each sense, how well unseen chips are predicted from the azimuth that
predicts each best, and the errors of these azimuths relative to their mean. Nothing is trained twice, so end it at
any time and start it again.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded

import numpy as np
from recognise import evenly
from unordered import imported, options, trained, with_tests

from sarsplat import Dataset, Run, locate
from sarsplat.evaluation.azimuths import signed

SENSES = {"true azimuths": 0, "even steps": 1, "even steps, other sense": -1}


def main() -> int:
    """Read the command line."""
    parser = options(__doc__)
    parser.add_argument("--count", type=int, default=36, metavar="N", help="chips")
    given = parser.parse_args()
    chips, tests = imported(given, given.count)
    train = evenly(chips, None)
    for name, sense in SENSES.items():
        dataset = with_tests(stepped(train, sense) if sense else train, tests)
        run = trained(dataset, given.work / given.target / f"seed {given.seed}" / name, given.seed)
        for test in tests:
            told(run, test, sense or 1)
    return 0


def stepped(train: Dataset, sense: int) -> Dataset:
    """The chips in their order, at even steps of azimuth from 0; the standard deviation is a quarter of a step."""
    step = 360 / len(train)
    entries = tuple(
        replace(entry, view=replace(entry.view, azimuth_deg=(sense * number * step) % 360), azimuth_std_deg=step / 4)
        for number, entry in enumerate(train.entries)
    )
    return replace(train, entries=entries)


def told(run: Run, test: Dataset, sense: int) -> None:
    """Print how well chips are explained, each from the azimuth that explains it best."""
    located = locate([run], test, split=None)
    errors = signed(located.azimuth_deg[:, 0] - sense * np.array([view.azimuth_deg for view in test.views]))
    turn = np.degrees(np.angle(np.exp(1j * np.radians(errors)).mean()))
    errors = np.abs(signed(errors - turn))
    print(
        f"  {test.entries[0].split}: nats {located.nats[:, 0].mean():.4f}, azimuths relative to their mean: median "
        f"error {np.median(errors):.2f}°, within 5° {(errors <= 5).mean():.0%}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
