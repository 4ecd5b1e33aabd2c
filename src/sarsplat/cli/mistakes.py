"""Words that do not parse, told in one sentence that names what was probably meant."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any

Level = dict[str, Any]
"""A command as tyro lists it for shells: its `options` (`flags`, `choices`) and its `subcommands`, levels again."""


def explained(words: Sequence[str], told: str, level: Level) -> str:
    """One sentence in place of tyro's box.

    Parameters
    ----------
    words : sequence of str
        What was typed after the program's name.
    told : str
        tyro's error.
    level : Level
        All commands and their options.
    """
    program, rest = "sarsplat", list(words)
    while level["subcommands"]:
        if not rest or rest[0] not in level["subcommands"]:
            return _no_command(program, rest, level["subcommands"])
        program, level = f"{program} {rest[0]}", level["subcommands"][rest[0]]
        del rest[0]
    options = {flag: option for option in level["options"] for flag in option["flags"]}
    for index, word in enumerate(rest):
        flag, _, value = word.partition("=")
        flag = flag.replace("_", "-")
        if word.startswith("--") and flag not in options:
            return f"{flag} is no option of {program}; {_meant(flag, options) or f'{program} --help lists them'}"
        value = value or next(iter(rest[index + 1 : index + 2]), "")
        choices = _choices(options.get(flag))
        if choices and value not in choices:
            meant = _meant(value, choices) or f"choose one of {', '.join(choices)}"
            return f"{flag} {value!r} is unknown; {meant}" if value else f"{flag} lacks its value; {meant}"
    return _plain(program, told)


def _no_command(program: str, rest: Sequence[str], commands: Iterable[str]) -> str:
    listed = f"there are {', '.join(commands)}"
    if not rest:
        return f"{program} needs a command; {listed}"
    return f"{rest[0]!r} is no command of {program}; {_meant(rest[0], commands) or listed}"


def _choices(option: Level | None) -> list[str]:
    return [choice for choice in (option or {}).get("choices", ()) if choice != "None"]


def _meant(word: str, known: Iterable[str]) -> str:
    near = get_close_matches(word, list(known), 1)
    return f"did you mean {near[0]}?" if near else ""


def _plain(program: str, told: str) -> str:
    """What tyro says between title and first rule; where letters are few, its frame is of spaces and hyphens."""
    inside = "\n".join(line.strip("│| ") for line in told.splitlines()[1:])
    text = " ".join(re.split(r"^[─╰╯+-]{3,}$", inside.lstrip("-\n"), maxsplit=1, flags=re.MULTILINE)[0].split())
    if missing := re.match(r"Missing from .*?: (\S+)( \S+)?", text):
        return f"{missing[1]} is missing; {program} --help says what it is"
    if wrong := re.match(r"Error parsing (\S+): .*?(string to float|for int\(\)).*?: ('[^']*')", text):
        return f"{wrong[1]} {wrong[3]} is no {'number' if 'float' in wrong[2] else 'whole number'}; give one"
    if wrong := re.match(r"Error parsing (\S+): .*arguments \[(.*)\] into", text):
        return f"{wrong[1]} cannot be {wrong[2]}; {program} --help says what it is"
    if short := re.match(r"Missing value for argument '(.*?)'\. Expected (\d+) values", text):
        return f"{short[1]} lacks its value{'' if short[2] == '1' else 's'}; give {short[2]}"
    if extra := re.match(r"Unrecognized options: (.*)", text):
        return f"{extra[1]!r} is more than {program} takes; leave it out"
    return f"{text or 'the words do not parse'}; see {program} --help"
