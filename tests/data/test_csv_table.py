"""Tables as spreadsheets and scripts write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from sarsplat.data.csv_table import column_names, read_table, relative_path
from sarsplat.errors import SarsplatError


def table_of(tmp_path: Path, data: bytes):
    (tmp_path / "t.csv").write_bytes(data)
    return read_table(tmp_path / "t.csv", "the table")


@pytest.mark.parametrize(
    "data",
    [
        b"file,az\na.png,1.5\nb.png,-2\n",
        b"\xef\xbb\xbffile;az\r\na.png;1,5\r\n\r\nb.png;-2",  # a spreadsheet with decimal commas
        b"file\taz\ra.png\t1.5\rb.png\t-2\r",
        b'"file" , "az" ,\n"a.png",1.5,\nb.png," -2 "\n',  # a separator too many at the end says nothing
    ],
)
def test_every_way_of_writing_says_the_same(tmp_path, data):
    table = table_of(tmp_path, data)
    assert table.columns[:2] == ("file", "az")
    assert [cells["file"] for _, cells in table.rows] == ["a.png", "b.png"]
    assert [table.number(row, "az") for row in table.rows] == [1.5, -2]
    assert column_names(tmp_path / "t.csv")[0] == "file"


@pytest.mark.parametrize("count", [1, 48, 400])
@pytest.mark.parametrize("separator", ",;\t")
def test_as_many_columns_as_there_are(tmp_path, count, separator):
    names, cells = (separator.join(f"{letter}{k}" for k in range(count)) for letter in "ax")
    table = table_of(tmp_path, f"{names}\n{cells}\n".encode())
    assert table.rows == ((2, {f"a{k}": f"x{k}" for k in range(count)}),)


def test_cells_that_are_missing_are_empty(tmp_path):
    table = table_of(tmp_path, b"a,b\n1\n")
    assert table.rows == ((2, {"a": "1", "b": ""}),)
    with pytest.raises(SarsplatError, match=r"line 2: b is ''; it must be a number"):
        table.number(table.rows[0], "b")


def test_a_decimal_comma_between_commas_is_named(tmp_path):
    table = table_of(tmp_path, b'a,b\n1,"0,5"\n')
    with pytest.raises(SarsplatError, match=r"line 2: b is '0,5'; write it with a point, or put semicolons between"):
        table.number(table.rows[0], "b")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "has no rows"),
        (b"a,b\n", "has no rows"),
        (b"a,a\n1,2\n", "the column 'a' twice"),
        (b"a,b\n1,2,3\n", "line 2: there are 3 cells for 2 columns"),
        (b"\xff\xfea", "not a readable CSV"),
        (b"a,b\n" + b"1,2\n" * 100_001, "more than 100000 rows"),
        (b"a,b\n" + b"x" * 200_000, "not a readable CSV"),
    ],
)
def test_what_is_no_table(tmp_path, data, words):
    with pytest.raises(SarsplatError, match=words):
        table_of(tmp_path, data)


def test_a_column_that_is_needed(tmp_path):
    (tmp_path / "t.csv").write_bytes(b"a,b\n1,2\n")
    with pytest.raises(SarsplatError, match=r"is missing the column 'c'; it needs a, c"):
        read_table(tmp_path / "t.csv", "the table", ("a", "c"))


@pytest.mark.parametrize("path", ["../a.png", "b/../../a.png", "/etc/passwd", "a\0.png", "..\\a.png"])
def test_paths_stay_in_the_folder(tmp_path, path):
    table = table_of(tmp_path, f"file\n{path}\n".encode())
    with pytest.raises(SarsplatError, match=r"line 2: .* points outside the folder of images"):
        relative_path(table.path, table.rows[0], "file", of="images")
