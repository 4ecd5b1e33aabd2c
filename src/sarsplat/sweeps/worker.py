"""Worker process of a sweep: one JSON line per job in, one per result out; it ends with its parent process."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from queue import SimpleQueue

import msgspec

from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.work import do


def main() -> None:
    """Read lines until there are no more; the words are the folder of the sweep and `once` or `again`."""
    out, again = Path(sys.argv[1]), sys.argv[2] == "again"
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever is printed is no answer
    asked: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    while True:
        row = do(msgspec.json.decode(asked.get(), type=Cell), out, again)
        answers.write(msgspec.json.encode(row) + b"\n")
        answers.flush()


def _listen(asked: SimpleQueue[bytes]) -> None:
    """Pass lines on; when there can be no more, whoever asked has ended, and nobody waits for an answer."""
    for line in sys.stdin.buffer:
        asked.put(line)
    os._exit(0)


if __name__ == "__main__":
    main()
