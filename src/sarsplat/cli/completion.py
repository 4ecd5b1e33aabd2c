"""`sarsplat completion`: what a shell needs to complete the words of this program."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from sarsplat.cli.mistakes import Level

_SCRIPT = """\
# Completion of sarsplat for {shell}.
{start}_sarsplat() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} previous=${{COMP_WORDS[COMP_CWORD-1]}} command="" index
  local commands="" options=""
  for ((index = 1; index < COMP_CWORD; index++)); do
    case "$command ${{COMP_WORDS[index]}}" in
      {commands}) command="$command ${{COMP_WORDS[index]}}" ;;
    esac
  done
  COMPREPLY=()
  case "$command $previous" in
{values}
  esac
  case "$command" in
{words}
  esac
  if [[ $current == -* ]]; then commands=$options; fi
  COMPREPLY=($(compgen -W "$commands" -- "$current"))
}}
complete -o default -F _sarsplat sarsplat
"""
"""Where nothing is offered, the shell completes paths (`-o default`)."""


def completion(shell: Annotated[Literal["bash", "zsh"], tyro.conf.Positional]) -> None:
    """Print a shell script that completes commands, options, presets, targets and paths.

    Parameters
    ----------
    shell
        The shell to complete in.
    """
    from sarsplat.cli.parser import options

    sys.stdout.write(script(options(), shell))


def script(level: Level, shell: str) -> str:
    """The script for `shell`, of all commands and their options."""
    levels = dict(_levels(level))
    commands = [f'"{path}"' for path in levels if path]
    words, values = [], []
    for path, found in levels.items():
        flags = [flag for option in found["options"] for flag in option["flags"]]
        words.append(f'    "{path}") commands="{" ".join(found["subcommands"])}" options="{" ".join(flags)}" ;;')
        for option in found["options"]:
            choices = sorted(choice for choice in option.get("choices", ()) if choice != "None")
            for flag in option["flags"]:
                if choices:
                    reply = f'COMPREPLY=($(compgen -W "{" ".join(choices)}" -- "$current"))'
                    values.append(f'    "{path} {flag}") {reply}; return ;;')
                elif option["type"] == "path":
                    values.append(f'    "{path} {flag}") return ;;')
                elif option["type"] == "value":
                    values.append(f'    "{path} {flag}") compopt +o default 2> /dev/null; return ;;')
    return _SCRIPT.format(
        shell=shell,
        start="autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else "",
        commands=" | ".join(commands),
        values="\n".join(values),
        words="\n".join(words),
    )


def _levels(level: Level, path: str = "") -> Iterator[tuple[str, Level]]:
    """Every command by its path, such as ` import mstar`."""
    yield path, level
    for name, inner in level["subcommands"].items():
        yield from _levels(inner, f"{path} {name}")
