"""Plugins: found by file name and by entry point, imported when asked for, and broken ones named."""

import sys

import pytest

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.plugins import discover

GROUP = "sarsplat.formats"


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Two packages with format_NAME.py, and an installed third with entry points."""
    files = {
        "ours_a/__init__.py": "",
        "ours_a/format_long_name.py": "FORMAT = 'ours'",
        "ours_a/other.py": "raise RuntimeError",
        "ours_b/__init__.py": "",
        "ours_b/format_c.py": "FORMAT = 'c'",
        "theirs.py": "GOOD = 'theirs'",
        "broken.py": "raise KeyError('no luck')",
        "theirs-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n",
        "theirs-1.0.dist-info/entry_points.txt": f"[{GROUP}]\nfine = theirs:GOOD\nbad = broken:GOOD\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for module in ("ours_a", "ours_a.format_long_name", "ours_b", "ours_b.format_c", "theirs"):
        sys.modules.pop(module, None)


def found():
    return discover("ours_a", "format_", "FORMAT", GROUP, "ours_b")


def test_plugins_are_found_by_name_and_imported_when_asked_for(home):
    plugins = found()
    assert list(plugins) == ["long-name", "c", "fine", "bad"]
    assert "theirs" not in sys.modules and "ours_a.format_long_name" not in sys.modules
    assert (plugins["long-name"], plugins["fine"]) == ("ours", "theirs")
    assert "ours_b.format_c" not in sys.modules


def test_a_broken_plugin_is_named_and_stops_no_other(home):
    plugins = found()
    with pytest.raises(SarsplatError, match=r"the plugin bad of sarsplat.formats .* broken:GOOD \(KeyError: .*no luck"):
        plugins["bad"]
    with pytest.warns(SarsplatWarning, match="the plugin bad") as warned:
        assert plugins.loaded() == {"long-name": "ours", "c": "c", "fine": "theirs"}
    assert len(warned) == 1


def test_a_name_that_is_taken_is_refused_with_a_warning(home):
    (home / "theirs-1.0.dist-info" / "entry_points.txt").write_text(f"[{GROUP}]\nc = theirs:GOOD\n")
    with pytest.warns(SarsplatWarning, match=r"the plugin c .* from theirs:GOOD is ignored, because ours_b.format_c"):
        assert found()["c"] == "c"
