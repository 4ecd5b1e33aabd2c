"""Parsing and execution of the command line; only the module of the named command is imported.

Errors and warnings become sentences, and the exit code is set.
"""

import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stderr
from difflib import get_close_matches
from functools import partial, wraps
from typing import Any

from sarsplat import extras
from sarsplat.cli import console
from sarsplat.cli.commands import COMMANDS, IMPORT_SUMMARY, Command, command, first_paragraph, show_overview, summary
from sarsplat.errors import AssumptionWarning, SarsplatError, SarsplatWarning
from sarsplat.extras import installed_version

_DESCRIPTION = (
    "From SAR images to a 3D target and back: simulate or import → reconstruct → evaluate → render. "
    "`sarsplat COMMAND --help` explains a command, `sarsplat --version` prints the version."
)

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
            code = parse(words or ["--help"])()
        except SarsplatError as error:
            console.complain(str(error))
            return _MISUSED
        except ModuleNotFoundError as error:
            root = (error.name or "").partition(".")[0]
            extra = next((extra for extra, modules in extras.EXTRAS.items() if root in modules), None)
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


def parse(words: Sequence[str]) -> Callable[[], int | None]:
    """Return the command of the words, ready to be called; for --help, print it and end the process.

    The command returns its exit code, or None for 0. Raises a SarsplatError if the words do not parse.
    """
    name, rest = _chosen("sarsplat", _DESCRIPTION, words, COMMANDS, lambda: {one: summary(one) for one in COMMANDS})
    return _importer(rest) if name == "import" else _read(f"sarsplat {name}", command(name), rest)


def _importer(words: Sequence[str]) -> Callable[[], int | None]:
    from sarsplat.cli.importers import IMPORTERS

    def summaries() -> dict[str, str]:
        return {name: first_paragraph(importer.__doc__) for name, importer in IMPORTERS.loaded().items()}

    name, rest = _chosen("sarsplat import", IMPORT_SUMMARY, words, IMPORTERS, summaries)
    return _read(f"sarsplat import {name}", IMPORTERS[name], rest)


def _chosen(
    program: str,
    description: str,
    words: Sequence[str],
    names: Iterable[str],
    summaries: Callable[[], Mapping[str, str]],
) -> tuple[str, Sequence[str]]:
    """Return the command at the start of the words, and the words after it; print help if they begin with --help."""
    if words and words[0] in ("-h", "--help"):
        show_overview(program, description, summaries())
        raise SystemExit(0)
    plain_names = {name.replace("_", "-"): name for name in names}
    name = plain_names.get(words[0].replace("_", "-")) if words else None
    if name is not None:
        return name, words[1:]
    choices = f"choose one of {', '.join(plain_names.values())}"
    if not words:
        raise SarsplatError(f"{program} needs a command; {choices}")
    meant = _meant(words[0], plain_names.values()) or choices
    raise SarsplatError(f"{words[0]!r} is not a command of {program}; {meant}")


def _read(program: str, command: Command, words: Sequence[str]) -> Callable[[], int | None]:
    import tyro  # not for the overview, whose time it would double

    from sarsplat.cli.arguments import MARKERS

    if {"-h", "--help"} & {*words}:
        words = ["--help"]  # tyro's would lack the options before it
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            return tyro.cli(_later(command, words), prog=program, args=words, config=MARKERS)
    except SystemExit as end:
        if not end.code:
            raise
        raise SarsplatError(_plain(program, box.getvalue())) from None


def _later(command: Command, words: Sequence[str]) -> Callable[..., Callable[[], int | None]]:
    """Return a function of the same signature that returns the call, with `words` if it has them."""

    @wraps(command)
    def bound(*arguments: Any, **options: Any) -> Callable[[], int | None]:
        if "words" in options:
            options["words"] = tuple(words)
        return partial(command, *arguments, **options)

    return bound


def _meant(word: str, names: Iterable[str]) -> str:
    """Suggest a similar name, ignoring capitals and hyphens: `T-72` is t72."""
    bare = {re.sub(r"[\W_]", "", name).lower(): name for name in names}
    near = get_close_matches(re.sub(r"[\W_]", "", word).lower(), bare, 1)
    return f"did you mean {bare[near[0]]}?" if near else ""


def _plain(program: str, box: str) -> str:
    """Return the error sentence for wrong arguments of a command, in place of tyro's box.

    Its text lies between title and last rule; in encodings without lines, the frame is of spaces and hyphens.
    """
    inside = (line.strip("│| ") for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()[1:])  # colours
    words = " ".join(line for line in inside if not re.fullmatch(r"[─╰╯+-]{3,}", line)).split()
    text = " ".join(words).partition(" For full helptext")[0]
    see = f"see {program} --help"
    if unread := re.search(r"Unrecognized options: (.*?)(?= Perhaps you meant:(.*)|$)", text):
        unknown = re.findall(r"[^\s,]+", unread[1])
        flag = next((word.partition("=")[0] for word in unknown if word.startswith("--")), None)
        if flag is None:
            if program == "sarsplat reconstruct":
                return f"{program} does one target at a time, and {unread[1]!r} is another; see `sarsplat sweep`"
            return f"{unread[1]!r} is one argument too many for {program}; remove it"
        others = {word for word in re.findall(r"--[\w.-]+", text) if word != flag}
        meant = _meant(flag, others) or f"{program} --help lists them"
        return f"{flag.replace('_', '-')} is not an option of {program}; {meant}"
    if choice := re.match(r"invalid choice '(.*?)' for argument '(.*?)'\. Expected one of \((.*?)\)", text):
        choices = [name for name in re.findall(r"'(.*?)'", choice[3]) if name != "None"]
        meant = _meant(choice[1], choices) or f"choose one of {', '.join(sorted(choices))}"
        return f"{choice[2]} {choice[1]!r} is unknown; {meant}"
    if missing := re.match(r"Missing from .*?: (\S+)( \S+)?", text):
        return f"{missing[1]} is missing; {see}"
    if wrong := re.match(r"Error parsing (\S+): .*?(string to float|for int\(\)).*?: ('[^']*')", text):
        return f"{wrong[1]} {wrong[3]} is not a {'number' if 'float' in wrong[2] else 'whole number'}; give one"
    if wrong := re.match(r"Error parsing (\S+): .*(?:arguments:?|instantiated from) \[(.*?)\]( into|\.|$| )", text):
        given = re.findall(r"'(.*?)'", wrong[2])
        counts = sorted({len(form.split()) for form in re.findall(r"\{(FLOAT(?: FLOAT)*)\}", text)})
        if counts and (words := [word for word in given if not _is_number(word)]):
            return f"{wrong[1]} {words[0]!r} is not a number; {see}"
        if counts:
            return f"{wrong[1]} takes {' or '.join(map(str, counts))} numbers, not {len(given)}; {see}"
        return f"{wrong[1]} does not accept {wrong[2]}; {see}"
    if short := re.match(r"Missing value for argument '(.*?)'\. Expected (\d+) values", text):
        return f"{short[1]} needs {'a value' if short[2] == '1' else 'more values'}; give {short[2]}, or {see}"
    return f"{text or 'the arguments cannot be read'}; {see}"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
