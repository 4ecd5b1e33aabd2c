"""A hook of mkdocs: pages link to each other and to the repository as on GitHub, and the site has the linked files.

The README becomes the home page; other files outside docs/ that a page links to come along under `repository/`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

REPOSITORY = Path(__file__).parents[1]
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages outside docs/, and where the site has them."""

_LINK = re.compile(r"\]\((?!\w+:)([^)#\s]+)(#[^)\s]*)?\)")


def place(path: str) -> str:
    """Path on the site of a file of the repository; tutorials are pages there."""
    if path in PAGES:
        return PAGES[path]
    folder, _, inside = path.partition("/")
    if folder != "docs":
        return f"repository/{path}"
    return re.sub(r"^(tutorials/\w+)\.py$", r"\1.md", inside)


def linked(page: str) -> set[str]:
    """The repository's files that a page links to, as paths from its root."""
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    return {_target(page, found[1]) for found in _LINK.finditer(text)}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add linked files from outside docs/."""
    for path, uri in PAGES.items():
        files.append(File.generated(config, uri, abs_src_path=str(REPOSITORY / path)))
    sources = [*PAGES, *(f"docs/{file.src_uri}" for file in files.documentation_pages() if _is_in_docs(file))]
    for path in sorted({target for page in sources for target in linked(page)}):
        outside = not path.startswith("docs/") and path not in PAGES
        if outside and (REPOSITORY / path).is_file():  # mkdocs reports missing files
            files.append(File.generated(config, place(path), abs_src_path=str(REPOSITORY / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files, **_: Any) -> str:
    """The page with its links as the site needs them."""
    uri = page.file.src_uri
    source = next((path for path, made in PAGES.items() if made == uri), f"docs/{uri}")

    def relinked(found: re.Match[str]) -> str:
        target = os.path.relpath(place(_target(source, found[1])), PurePosixPath(uri).parent)
        return f"]({PurePosixPath(target)}{found[2] or ''})"

    return _LINK.sub(relinked, markdown)


def _target(page: str, link: str) -> str:
    """A relative link as a path from the repository's root."""
    return os.path.normpath(PurePosixPath(page).parent / link).replace(os.sep, "/")


def _is_in_docs(file: File) -> bool:
    return (REPOSITORY / "docs" / file.src_uri).is_file()
