"""The documentation as a site: it builds without a warning, leads everywhere, and asks nothing of other machines."""

import json
import os
import pkgutil
import re
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import sarsplat
import sarsplat.radar
from chromium import chromium
from programs import ROOT, python

for needed in ("material", "mkdocstrings", "jupytext", "nbconvert"):
    pytest.importorskip(needed, reason="the site needs the extra docs")

FOLDERS = [info.name for info in pkgutil.iter_modules(sarsplat.__path__) if info.ispkg]


class Page(HTMLParser):
    """What a page names, links to, and loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value for name, value in attrs if value}
        self.ids |= {found[name] for name in ("id", "name") if name in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        elif "src" in found:
            self.loaded.append(found["src"])
        elif tag == "link" and found.get("rel") in ("stylesheet", "icon", "preload", "preconnect", "manifest"):
            self.loaded.append(found["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("site")
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = python("-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", made, cwd=ROOT, env=quiet)
    assert done.returncode == 0, done.stdout + done.stderr
    return made


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in sorted(site.rglob("*.html"))}


def test_every_link_and_picture_leads_somewhere(site, pages):
    wrong = []
    for path, page in pages.items():
        for link in [*page.links, *page.loaded]:
            address = urlsplit(link)
            if address.scheme or path.name == "404.html":
                continue
            target = (path.parent / unquote(address.path)).resolve() if address.path else path
            if not target.is_file() or (
                address.fragment and target in pages and unquote(address.fragment) not in pages[target].ids
            ):
                wrong.append(f"{path.relative_to(site)}: {link}")
    assert len(pages) > 50
    assert not wrong


def test_nothing_is_loaded_from_elsewhere(site, pages):
    for path, page in pages.items():
        assert not [link for link in page.loaded if urlsplit(link).netloc], path
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def test_every_public_name_is_in_the_reference(site, pages):
    known = set().union(*(page.ids for path, page in pages.items() if path.parent.name == "python"))
    missing = []
    lazy = (
        *("settings", "surface", "evaluation", "examination", "learning", "runs"),
        *("radar", "baselines", "samples", "sweeps"),
    )  # whose pages name the files that define what they export
    for module in {*FOLDERS} - {"cli", "viewer", *lazy}:
        for name in getattr(import_module(f"sarsplat.{module}"), "__all__", ()):
            own = f"sarsplat.{module}.{name}"  # of a function in a module of the same name it is the longer one
            missing += [own] * (not {own, f"{own}.{name}"} & known)
    assert not missing
    shown = {name.rpartition(".")[2] for name in known}
    exported = {name for module in lazy for name in import_module(f"sarsplat.{module}").__all__}
    assert sorted({*sarsplat.__all__, *exported} - shown) == []


def test_the_home_page_is_the_readme_and_search_needs_no_server(site):
    home = (site / "index.html").read_text(encoding="utf-8")
    assert 'src="images/sweep.gif"' in home
    assert 'href="learn/getting-started.html"' in home
    index = json.loads((site / "search" / "search_index.js").read_text(encoding="utf-8").removeprefix("var __index = "))
    assert {"learn/primer.html", "tutorials/own_mesh.html", "reference/python/renderer.html"} <= {
        entry["location"].partition("#")[0] for entry in index["docs"]
    }


def test_tutorials_are_pages_and_notebooks(site):
    for script in sorted((ROOT / "docs" / "tutorials").glob("*.py")):
        notebook = json.loads((site / "tutorials" / f"{script.stem}.ipynb").read_text(encoding="utf-8"))
        assert sum(cell["cell_type"] == "code" for cell in notebook["cells"]) > 3
        page = (site / "tutorials" / f"{script.stem}.html").read_text(encoding="utf-8")
        assert f'href="{script.stem}.ipynb"' in page


@pytest.mark.slow
def test_a_browser_asks_nothing_of_other_machines(site):
    with chromium() as browser:
        for name in ("index.html", "tutorials/own_mesh.html", "reference/python/renderer.html"):
            browser.page.open((site / name).as_uri())
            # what its scripts ask for when it is there
            browser.page.value("new Promise(done => setTimeout(done, 1000))")
        assert browser.quit() == []
