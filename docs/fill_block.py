"""Write generated text into a page, between two markers: <!-- NAME: begin … --> and <!-- NAME: end -->."""

from __future__ import annotations

import re
import sys
from pathlib import Path


def fill_block(page: Path, name: str, text: str) -> None:
    """Replace the text between the markers of that name."""
    block = re.compile(rf"(<!-- {name}: begin[^>]*-->\n).*?(<!-- {name}: end -->)", re.DOTALL)
    old = page.read_text(encoding="utf-8")
    if not block.search(old):
        sys.exit(f"{page} has no block to fill: <!-- {name}: begin … --> … <!-- {name}: end -->")
    page.write_text(block.sub(lambda match: match[1] + text + match[2], old), encoding="utf-8")
