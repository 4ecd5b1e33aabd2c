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
            return f"{flag} is not an option of {program}; {_meant(flag, options) or f'{program} --help lists them'}"
        value = value or next(iter(rest[index + 1 : index + 2]), "")
        choices = _choices(options.get(flag))
        if choices and value not in choices:
            meant = _meant(value, choices) or f"choose one of {', '.join(choices)}"
            return f"{flag} {value!r} is unknown; {meant}" if value else f"{flag} needs a value; {meant}"
    return _plain(program, told)


def _no_command(program: str, rest: Sequence[str], commands: Iterable[str]) -> str:
    listed = f"choose one of {', '.join(commands)}"
    if not rest:
        return f"{program} needs a command; {listed}"
    return f"{rest[0]!r} is not a command of {program}; {_meant(rest[0], commands) or listed}"


def _choices(option: Level | None) -> list[str]:
    return [choice for choice in (option or {}).get("choices", ()) if choice != "None"]


def _meant(word: str, known: Iterable[str]) -> str:
    near = get_close_matches(word, list(known), 1)
    return f"did you mean {near[0]}?" if near else ""


def _plain(program: str, told: str) -> str:
    """What tyro says between title and first rule; where letters are few, its frame is of spaces and hyphens."""
    told = re.sub(r"\x1b\[[0-9;]*m", "", told)  # colours, on a terminal
    inside = "\n".join(line.strip("│| ") for line in told.splitlines()[1:])
    text = " ".join(re.split(r"^[─╰╯+-]{3,}$", inside.lstrip("-\n"), maxsplit=1, flags=re.MULTILINE)[0].split())
    if missing := re.match(r"Missing from .*?: (\S+)( \S+)?", text):
        return f"{missing[1]} is missing; see {program} --help"
    if wrong := re.match(r"Error parsing (\S+): .*?(string to float|for int\(\)).*?: ('[^']*')", text):
        return f"{wrong[1]} {wrong[3]} is not a {'number' if 'float' in wrong[2] else 'whole number'}; give one"
    if wrong := re.match(r"Error parsing (\S+): .*(?:arguments|instantiated from) \[(.*?)\]( into|\.)", text):
        return f"{wrong[1]} does not accept {wrong[2]}; see {program} --help"
    if short := re.match(r"Missing value for argument '(.*?)'\. Expected (\d+) values", text):
        return f"{short[1]} needs {'a value' if short[2] == '1' else 'more values'}; give {short[2]}"
    if extra := re.match(r"Unrecognized options: (.*)", text):
        return f"{extra[1]!r} is one argument too many for {program}; remove it"
    return f"{text or 'the arguments cannot be read'}; see {program} --help"
