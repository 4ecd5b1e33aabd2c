"""Execution of a command: errors and warnings become sentences, and the exit code is set."""

from __future__ import annotations

import io
import os
import sys
import warnings

from sarsplat import extras
from sarsplat.cli import console
from sarsplat.errors import AssumptionWarning, SarsplatError, SarsplatWarning
from sarsplat.extras import installed_version

_MISUSED = 2
_READER_LEFT = 141  # as shells have it


def run(words: list[str]) -> int:
    """Carry out the words after the program's name; return the exit code, 2 after invalid input.

    `sarsplat check` and `sarsplat import` return 1 if images contradict the dataset, `sarsplat sweep` if a run has
    failed.
    """
    # before torch is loaded: threads that spin while they wait cost tens of milliseconds a step on a shared machine
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for stream in (sys.stdout, sys.stderr):  # a terminal without γ or ° gets "?", not an error after the work is done
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if words == ["--version"]:
        console.say(f"sarsplat {installed_version('sarsplat') or '(running from source)'}")
        return 0
    with warnings.catch_warnings():
        warnings.simplefilter("default", SarsplatWarning)
        warnings.simplefilter("ignore", AssumptionWarning)
        warnings.showwarning = _show_warning  # type: ignore[assignment]
        try:
            from sarsplat.cli.parser import parse  # here, for plug-ins of other packages may warn

            code = parse(words or ["--help"])()
        except SarsplatError as error:
            text = str(error).replace("overwrite=True", "--overwrite").replace("resume=True", "--resume")
            console.complain(text)
            return _MISUSED
        except ModuleNotFoundError as error:
            extra = extras.extra_with(error.name or "")
            if extra is None:
                raise
            console.complain(f"this needs {error.name}, which is not installed; {extras.install_command(extra)}")
            return _MISUSED
        except BrokenPipeError:  # the program that reads our output has ended, as `head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
            return _READER_LEFT
        except OSError as error:  # unforeseen: no permission, a name too long
            from sarsplat.data.files import plain_reason

            console.complain(f"cannot use {error.filename or 'a file'}: {plain_reason(error)}")
            return _MISUSED
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "can't allocate memory" not in str(error):  # torch's words for it
                raise
            console.complain("not enough memory; ask for fewer or smaller images, or fewer Gaussians")
            return _MISUSED
    return code or 0


def _show_warning(message: Warning | str, category: type[Warning], filename: str, line: int, *_: object) -> None:
    """Show our warnings as plain sentences, and others' as Python does."""
    if issubclass(category, SarsplatWarning):
        console.warn(str(message))
    else:
        sys.stderr.write(warnings.formatwarning(message, category, filename, line))
