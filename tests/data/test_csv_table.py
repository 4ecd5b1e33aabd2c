"""Tables as spreadsheets and scripts write them."""

from pathlib import Path

import pytest

from sarsplat.data.csv_table import column_names, read_table


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
        "file\taz\r\na.png\t1.5\r\nb.png\t-2\r\n".encode("utf-16"),  # a spreadsheet's "Unicode text"
        "\ufefffile,az\na.png,1.5\nb.png,-2\n".encode("utf-16-be"),
        "file,az\na.png,1.5\nb.png,-2\n".encode("utf-16-le"),  # without its mark
        b"sep=;\r\nfile;az\r\na.png;1,5\r\nb.png;-2\r\n",
        b"\nfile,az\n ,\na.png,1.5\nb.png,-2\n,,\n,\n",  # rows without a value are none
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
