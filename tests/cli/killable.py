"""The command line with small presets, in a process that can be told when to kill itself, as `kill -9` does.

KILL_BEFORE=k: before the k-th time that it opens a file for writing, renames, removes or makes one. KILL_AFTER=s: after
so many seconds. Without either it says at its end how many such moments there were and how long they took.
"""

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from typing import Any

from sarsplat.cli import main
from sarsplat.settings import PRESETS

EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "shutil.rmtree")


def use_small_presets() -> None:
    """Forty iterations with a checkpoint every ten."""
    for name, preset in list(PRESETS.items()):
        PRESETS[name] = replace(preset, iterations=40, gaussians=300, harmonics_every=15, checkpoint_every=10)


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    use_small_presets()
    count, last = 0, int(os.environ.get("KILL_BEFORE", "0"))

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        global count
        if event in EVENTS or (event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)):
            count += 1
            if count == last:
                kill()

    sys.addaudithook(watch)
    if "KILL_AFTER" in os.environ:
        threading.Timer(float(os.environ["KILL_AFTER"]), kill).start()
    begun = time.monotonic()
    code = main(sys.argv[1:])
    sys.stderr.write(f"moments {count} seconds {time.monotonic() - begun}\n")
    sys.stderr.flush()
    os._exit(code)  # the timer may still be waiting
