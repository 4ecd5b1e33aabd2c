"""Budget of each room of `src` and of the tests: lines, files, raises and hard sentences may only fall.

`python tests/test_budget.py` lowers tests/budget.json to today's numbers. A change that needs more in one room
takes it from another, edits the file by hand and says so.
"""

import ast
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import pytest

from programs import ROOT

BUDGET = Path(__file__).with_name("budget.json")
SOURCE = ROOT / "src" / "sarsplat"

HARD_START = re.compile(
    r"(What|Who|Whose|Whether|Of|And|Those|That|The same|Such|By|From where|Where|How|As of|As for)\b"
)
"""First words that leave a reader without subject or verb."""

HARD_PHRASE = re.compile(
    r"\b[Ww]hat (is|was|are|were|has|had|does|do|stands|lies|reaches|returns|differs|changes|follows|remains|must|may"
    r"|can|would|each|all|others|it|they|no|nothing|else)\b"
    r"|\b[Ww]ho(ever)? (does|asks|holds|makes|reads|opens|writes|wrote|shares|it)\b"
    r"|\b(is|are|was|were) (none|said|told)\b|\bsaid of\b|\btold apart\b|\bof (one's|its|their|your) own\b"
    r"|\bof (ours|others|theirs)\b|\bstands? (beside|again)\b|\blies? beside\b|\bas (it is|they are)\b|\bso many\b"
)
"""Phrases that need a second reading."""

MESSAGE_CALLS = {"SarsplatError", "warn", "warn_caller"}
"""Functions whose arguments are messages to a user."""


def _sentences(nodes: Sequence[ast.AST]) -> Iterator[tuple[bool, str]]:
    """Docstrings (True) of modules, classes, functions and constants, and messages (False)."""
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield True, (ast.get_docstring(node) or "").strip()
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body[1:]:
                match statement:
                    case ast.Expr(ast.Constant(str(text))):
                        yield True, text.strip()
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in MESSAGE_CALLS:
            yield False, " ".join(map(ast.unparse, node.args))


@cache
def _measured() -> dict[str, dict[str, int]]:
    """Numbers of today, of each room and of the tests."""
    rooms: dict[str, Counter[str]] = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE).parts
        room = rooms.setdefault(parts[0] if len(parts) > 1 else ".", Counter())
        text = path.read_text()
        nodes = [*ast.walk(ast.parse(text))]
        room["lines"] += text.count("\n")
        room["files"] += 1
        room["raises"] += sum(isinstance(node, ast.Raise) for node in nodes)
        room["hard sentences"] += sum(
            bool(HARD_PHRASE.search(text) or (doc and HARD_START.match(text))) for doc, text in _sentences(nodes)
        )
    tests = sum(path.read_text().count("\n") for path in (ROOT / "tests").rglob("*.py"))
    return {room: dict(sorted(rooms[room].items())) for room in sorted(rooms)} | {"tests": {"lines": tests}}


@pytest.mark.parametrize("room", json.loads(BUDGET.read_text()) if BUDGET.exists() else [])
def test_no_room_exceeds_its_budget(room: str) -> None:
    budget, today = json.loads(BUDGET.read_text())[room], _measured().get(room, {})
    over = {name: (number, budget.get(name, 0)) for name, number in today.items() if number > budget.get(name, 0)}
    assert not over, f"{room}: (today, budget) {over}"


def test_every_room_has_a_budget() -> None:
    assert not _measured().keys() - json.loads(BUDGET.read_text()).keys()


if __name__ == "__main__":
    old = json.loads(BUDGET.read_text()) if BUDGET.exists() else {}
    new = {
        room: {name: min(number, old.get(room, {}).get(name, number)) for name, number in numbers.items()}
        for room, numbers in _measured().items()
    }
    BUDGET.write_text(json.dumps(new, indent=1) + "\n")
