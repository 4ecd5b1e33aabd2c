"""Tutorials: scripts in docs/tutorials (cells begin with `# %%`) become executed notebooks and pages of the site.

`python docs/site_tutorials.py` (`make notebooks`) executes those that have changed, or the library has, since the last
time, and keeps them in build/notebooks. As a hook of mkdocs, this file makes pages of them; a tutorial that was not
executed appears without its outputs.
"""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path
from typing import Any

import jupytext
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from nbformat import NotebookNode

REPOSITORY = Path(__file__).parents[1]
SOURCES = sorted((REPOSITORY / "docs" / "tutorials").glob("*.py"))
EXECUTED = REPOSITORY / "build" / "notebooks"
LIMIT_S = 600  # a cell


def kept(source: Path) -> Path:
    """Path of the executed notebook; its name changes with the script and with the library."""
    state = hashlib.sha256(source.read_bytes())
    for path in sorted((REPOSITORY / "src").rglob("*.py")):
        state.update(path.read_bytes())
    return EXECUTED / f"{source.stem}-{state.hexdigest()[:16]}.ipynb"


def execute(source: Path) -> None:
    """Run a tutorial in an empty folder, if that was not done yet."""
    done = kept(source)
    if done.is_file():
        return
    begun = time.perf_counter()
    folder = EXECUTED / source.stem
    folder.mkdir(parents=True, exist_ok=True)
    notebook = jupytext.read(source)
    NotebookClient(notebook, timeout=LIMIT_S, resources={"metadata": {"path": str(folder)}}).execute()
    for output in (output for cell in notebook.cells for output in cell.get("outputs", [])):
        if "text" in output:  # warnings name the file they come from
            output["text"] = output["text"].replace(f"{REPOSITORY}{os.sep}", "")
    for old in EXECUTED.glob(f"{source.stem}-*.ipynb"):
        old.unlink()
    jupytext.write(notebook, done)
    print(f"{source.name}: executed in {time.perf_counter() - begun:.0f} s")


def page(notebook: NotebookNode, name: str) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by name."""
    names: dict[str, Any] = {"unique_key": name, "output_files_dir": f"{name}_files"}
    body, made = MarkdownExporter().from_notebook_node(notebook, names)
    title, _, rest = body.strip().partition("\n")
    how = f"*A notebook: [download it]({name}.ipynb), or read it from top to bottom.*"
    if not any(cell.get("outputs") for cell in notebook.cells):
        how += "\n\n!!! note\n    This copy of the site was built without executing the tutorials: `make docs` does."
    return f"{title}\n\n{how}\n{rest}\n", made["outputs"]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """A page, its pictures and the notebook itself for every tutorial."""
    for source in SOURCES:
        done = kept(source)
        notebook = jupytext.read(done if done.is_file() else source)
        notebook.metadata.setdefault("language_info", {"name": "python"})  # a kernel would have said so
        text, pictures = page(notebook, source.stem)
        made = {f"{source.stem}.md": text, f"{source.stem}.ipynb": jupytext.writes(notebook, fmt="ipynb"), **pictures}
        for name, content in made.items():
            files.append(File.generated(config, f"tutorials/{name}", content=content))
    return files


if __name__ == "__main__":
    for script in SOURCES:
        execute(script)
