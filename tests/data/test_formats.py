"""docs/reference/formats/dataset.md and dataset.schema.json beside it say what `read_dataset` reads."""

import importlib.util
import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from made import SIGNALS, tiny_dataset
from refusals import edit_json
from sarsplat.data import read_dataset, write_dataset
from sarsplat.errors import SarsplatError

DOCS = Path(__file__).parents[2] / "docs"
FORMATS = DOCS / "reference" / "formats"
PAGE = (FORMATS / "dataset.md").read_text(encoding="utf-8")
SCHEMA = json.loads((FORMATS / "dataset.schema.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
    """The folder that the page's program writes, which knows nothing of sarsplat."""
    program = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[-1]
    assert "sarsplat import" not in program
    assert "import sarsplat" not in program
    place = tmp_path_factory.mktemp("foreign")
    exec(program.replace('Path("mine")', f"Path({str(place / 'mine')!r})"), {})
    return place / "mine"


def test_the_schema_is_made_from_what_reads_the_file(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    spec = importlib.util.spec_from_file_location("write_schema", DOCS / "write_schema.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert json.loads(module.schema_text()) == SCHEMA, "run python docs/write_schema.py"
    assert module.field_table() in PAGE, "run python docs/write_schema.py"
    sys.modules.pop("fill_block", None)


def test_a_folder_of_another_program_is_read(foreign):
    header = json.loads((foreign / "dataset.json").read_text())
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(header, SCHEMA)
    made = read_dataset(foreign)
    assert (made.target, made.looks, made.ground, made.splits()) == ("mine", 1.0, True, ("train", "test"))
    assert (made.grid.rows, made.grid.columns, made.grid.spacing_m) == (64, 96, (0.1, 0.3))
    assert [view.azimuth_deg for view in made.views] == list(range(0, 360, 30))
    first = np.random.default_rng(0).exponential(size=(64, 96)).astype(np.float32)
    np.testing.assert_array_equal(made.power[0], first)


def test_what_sarsplat_writes_fits_the_schema(tmp_path):
    write_dataset(tmp_path / "power", tiny_dataset())
    more = {"looks": 2.0, "clean_tests": True, "target_box_m": ((-1.0, -1, 0), (1.0, 1, 2))}
    made = tiny_dataset(SIGNALS, **more)
    entries = tuple(replace(entry, azimuth_std_deg=1.5 * k) for k, entry in enumerate(made.entries))
    write_dataset(tmp_path / "complex", replace(made, entries=entries))
    for folder in ("power", "complex"):
        jsonschema.validate(json.loads((tmp_path / folder / "dataset.json").read_text()), SCHEMA)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("unit", "dB", "unit is 'dB'"),
        ("more", 1, "unknown field 'more'"),
        ("views", [], "at least one image"),
        ("views.0.split", "validation", "split 'validation'"),
        ("views.0.grazing_deg", 90, "grazing angle 90"),
        ("views.0.azimuth_deg", 4000, "azimuth 4000"),
        ("grid.rows", 0, "0 × 96"),
        ("score_margin", -1, "score_margin -1"),
    ],
)
def test_what_the_schema_refuses_the_reader_refuses(foreign, tmp_path, place, value, words):
    folder = shutil.copytree(foreign, tmp_path / "set")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(edit_json(folder / "dataset.json", place, value), SCHEMA)
    with pytest.raises(SarsplatError, match=words):
        read_dataset(folder)
