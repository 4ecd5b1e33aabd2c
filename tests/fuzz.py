"""Fuzz every reader of files: python tests/fuzz.py [--inputs 2000] [--seed 0] [--keep FOLDER] [reader …]

Each reader runs in forks of its own, guided by coverage if atheris is installed. An input may be read or refused with
one sentence; anything else, more than two seconds, or more memory than 4 × its size + 96 MiB is a failure. Failing
inputs are kept. Prints a table, and exits with code 1 if there was a failure. With a folder to keep, it can be ended
at any time: the same command goes on from the last round of every reader.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import importlib.util
import json
import math
import os
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fuzz_inputs import Reader

_MAX_SECONDS = 2.0  # jbpy takes 0.7 for the 999 images that a NITF may state, and measuring coverage doubles it
_FREE_BYTES = 96 << 20  # GDAL takes 82 MiB to open the 65,535 bands that a TIFF of 336 bytes may have
_ROUND = 2000  # inputs of one process
_INSTRUMENTED = ["sarsplat.data", "sarsplat.importers", "sarsplat.runs.run", "sarsplat.scenes", "tifffile", "trimesh"]


@dataclass
class Tally:
    """What came of the inputs of one reader."""

    tried: int = 0
    refused: int = 0
    accepted: int = 0
    failed: int = 0
    slowest_s: float = 0.0
    max_mib: float = 0.0
    rounds: int = 0

    def add(self, other: Tally) -> None:
        """Add another round."""
        self.tried, self.refused = self.tried + other.tried, self.refused + other.refused
        self.accepted, self.failed = self.accepted + other.accepted, self.failed + other.failed
        self.slowest_s, self.max_mib = max(self.slowest_s, other.slowest_s), max(self.max_mib, other.max_mib)
        self.rounds += 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("readers", nargs="*")
    parser.add_argument("--inputs", type=int, default=2000, help="for each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder of failing inputs, from which a later run goes on")
    arguments = parser.parse_args()
    arguments.keep = arguments.keep or Path(tempfile.mkdtemp(prefix="sarsplat-fuzz-"))
    arguments.keep.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads do not survive a fork
    atheris = importlib.import_module("atheris") if importlib.util.find_spec("atheris") else None
    # takes half a minute, and so is done once
    with atheris.instrument_imports(include=_INSTRUMENTED) if atheris else contextlib.nullcontext():
        from fuzz_inputs import READERS

    names = arguments.readers or [reader.name for reader in READERS]
    totals = {name: _tally(arguments.keep, name, "total") for name in names}
    for number in range(math.ceil(arguments.inputs / _ROUND)):
        for name, total in totals.items():
            if total.rounds == number:
                total.add(_in_process(name, number, arguments, atheris))
                _file(arguments.keep, name, "total").write_text(json.dumps(asdict(total)))
    print(f"{'reader':<15}{'tried':>8}{'refused':>9}{'accepted':>9}{'failures':>9}{'slowest':>10}{'most memory':>13}")
    for name, one in totals.items():
        counts = f"{one.tried:>8}{one.refused:>9}{one.accepted:>9}{one.failed:>9}"
        print(f"{name:<15}{counts}{one.slowest_s:>8.2f} s{one.max_mib:>9.1f} MiB")
    return int(any(total.failed for total in totals.values()))


def _file(keep: Path, name: str, ending: str) -> Path:
    return keep / f"{name.replace(' ', '-')}.{ending}"


def _tally(keep: Path, name: str, ending: str) -> Tally:
    file = _file(keep, name, ending)
    return Tally(**json.loads(file.read_text())) if file.exists() else Tally()


def _in_process(name: str, number: int, arguments: argparse.Namespace, atheris: Any) -> Tally:
    """The tally of a round in a fork of this process; one that dies, of a crash or a hang, is a failure."""
    keep, log = arguments.keep, _file(arguments.keep, name, "log")
    _file(keep, name, "tally").unlink(missing_ok=True)
    inputs = min(_ROUND, arguments.inputs - number * _ROUND)
    if (child := os.fork()) == 0:
        with log.open("ab") as output:
            os.dup2(output.fileno(), 1), os.dup2(output.fileno(), 2)
        try:
            work(name, inputs, arguments.seed + number, keep, atheris)
        except Exception:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    found = _tally(keep, name, "tally")
    if code:
        dead = _file(keep, name, f"dead-{number}")
        print(f"{name}: the process ended with code {code}; see {log} and {dead}", flush=True)
        _file(keep, name, "current").rename(dead)
        found.failed += 1
    return found


def work(name: str, inputs: int, seed: int, keep: Path, atheris: Any) -> None:
    """Feed one reader, and write the tally every hundred inputs."""
    import fuzz_inputs

    reader = next(reader for reader in fuzz_inputs.READERS if reader.name == name)
    tally = Tally()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        reader.prepare(place)

        def one(data: bytes) -> None:
            _file(keep, name, "current").write_bytes(data)
            fault = judge(reader, place, data, tally)
            if fault:
                kept = _file(keep, name, f"{seed}-{tally.failed}")
                kept.write_bytes(data)
                print(f"FAILURE {kept}: {fault}", file=sys.stderr, flush=True)
            if tally.tried % 100 == 0 or tally.tried == inputs:
                _file(keep, name, "tally").write_text(json.dumps(asdict(tally)))

        seeds = reader.seeds()
        if atheris is None:
            rng = random.Random(seed)
            for data in [*seeds, *(reader.spoil(rng.choice(seeds), rng) for _ in range(inputs - len(seeds)))]:
                one(data)
            return
        corpus = place / "corpus"
        corpus.mkdir()
        for number, data in enumerate(seeds):
            (corpus / f"seed{number}").write_bytes(data)

        def spoil(data: bytes, most: int, number: int) -> bytes:
            rng = random.Random(number)
            return reader.spoil(rng.choice((data, rng.choice(seeds))), rng)[:most]

        options = [f"-runs={inputs}", f"-seed={seed + 1}", f"-max_len={fuzz_inputs.MAX_BYTES}", "-rss_limit_mb=0"]
        atheris.Setup([__file__, *options, str(corpus)], one, custom_mutator=spoil)
        atheris.Fuzz()


def judge(reader: Reader, folder: Path, data: bytes, tally: Tally) -> str | None:
    """Read one input, add it to the tally, and return what was wrong with how it was taken."""
    path = folder / reader.file
    path.write_bytes(data)
    faults = []
    tally.tried += 1
    with watched() as cost, warnings.catch_warnings():
        from sarsplat.errors import SarsplatError, SarsplatWarning

        warnings.simplefilter("error")
        warnings.simplefilter("ignore", SarsplatWarning)
        try:
            reader.read(folder)
            tally.accepted += 1
        except SarsplatError as error:
            tally.refused += 1
            faults += sentence_faults(str(error))
        except Exception as error:
            faults.append(f"{type(error).__name__}: {error!s:.300}")
    tally.slowest_s, tally.max_mib = max(tally.slowest_s, cost.seconds), max(tally.max_mib, cost.bytes / 2**20)
    if cost.seconds > _MAX_SECONDS:
        faults.append(f"took {cost.seconds:.2f} s")
    if cost.bytes > 4 * len(data) + _FREE_BYTES:
        faults.append(f"took {cost.bytes / 2**20:.0f} MiB for {len(data)} bytes")
    tally.failed += bool(faults)
    return "; ".join(faults) or None


def sentence_faults(text: str) -> list[str]:
    """What keeps an error from being one readable sentence."""
    found = []
    if not text.isprintable():
        found.append(f"the message is not printable: {text[:300]!r}")
    if len(text) > 1000:
        found.append(f"the message has {len(text)} characters: {text[:300]!r}")
    return found


@dataclass
class Cost:
    """What reading took: processor time, s, and memory beyond what was held before, bytes."""

    seconds: float = 0.0
    bytes: int = 0


@contextlib.contextmanager
def watched() -> Iterator[Cost]:
    """Measure the block; a hang of five minutes ends the process with a traceback."""
    cost = Cost()
    faulthandler.dump_traceback_later(300, exit=True)
    Path("/proc/self/clear_refs").write_text("5")  # the peak of the resident memory starts anew (Linux)
    before, begun = _memory("VmRSS"), time.process_time()
    try:
        yield cost
    finally:
        cost.seconds = time.process_time() - begun
        cost.bytes = max(0, _memory("VmHWM") - before)
        faulthandler.cancel_dump_traceback_later()


def _memory(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


if __name__ == "__main__":
    sys.exit(main())
