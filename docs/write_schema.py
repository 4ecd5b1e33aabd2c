"""Write dataset.schema.json, and the fields in dataset.md beside it, from the types that read dataset.json."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from fill_block import fill_block

from sarsplat.data.header import DatasetHeader

_PARTS = ("GridHeader", "StackHeader", "TurnHeader", "ViewHeader", "PlaceHeader")
FORMATS = Path(__file__).parent / "reference" / "formats"


def schema() -> dict[str, Any]:
    """JSON schema of dataset.json."""
    made = msgspec.json.schema(DatasetHeader)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "sarsplat dataset", **made}


def schema_text() -> str:
    """As the file has it."""
    return json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"


def field_table() -> str:
    """The fields as a table, those of a part under its dotted name."""
    lines = [f"| `{name}` | {kind} | {text} |\n" for name, kind, text in _fields("DatasetHeader", "")]
    return "\n| field | type | meaning |\n|---|---|---|\n" + "".join(lines) + "\n"


def _fields(struct: str, prefix: str) -> Iterator[tuple[str, str, str]]:
    definition = schema()["$defs"][struct]
    for name, field in definition["properties"].items():
        inner = next((part for part in _PARTS if part in json.dumps(field)), None)
        if inner is not None:
            yield from _fields(inner, f"{prefix}{name}[]." if field.get("type") == "array" else f"{prefix}{name}.")
            continue
        optional = "" if name in definition["required"] else "; may be absent"
        yield f"{prefix}{name}", _kind(field), f"{field['description']}{optional}"


def _kind(field: dict[str, Any]) -> str:
    """The JSON type in words."""
    if "const" in field:
        return f"`{json.dumps(field['const'])}`"
    if "enum" in field:
        return " or ".join(f"`{json.dumps(value)}`" for value in field["enum"])
    if "anyOf" in field:
        return " or ".join(_kind(choice) for choice in field["anyOf"])
    if field["type"] == "array":
        of_list = [_kind(item) for item in field.get("prefixItems", ())] or [_kind(field["items"]), "…"]
        return f"[{', '.join(of_list)}]"
    return str(field["type"])


if __name__ == "__main__":
    (FORMATS / "dataset.schema.json").write_text(schema_text(), encoding="utf-8")
    fill_block(FORMATS / "dataset.md", "fields", field_table())
