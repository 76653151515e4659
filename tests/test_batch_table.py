"""The table of a batch: read, checked as a whole, refused with the line at fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geomoe3d import register_pairs
from geomoe3d.batch.folder import page_name, transform_name
from geomoe3d.batch.memory import choose_workers, worker_bytes
from geomoe3d.batch.run import BatchReport
from geomoe3d.batch.store import Outcome, results_table
from geomoe3d.batch.table import MATRIX_COLUMNS, as_rows, read_pairs
from geomoe3d.cli.batch import table
from geomoe3d.errors import FormatError, InputError
from geomoe3d.runtime.csv_text import csv_text


def test_paths_are_relative_to_the_table_and_ids_are_made_where_missing(tmp_path):
    (tmp_path / "t.csv").write_text("target;source\nsub/b.ply;/x/a.ply\n\n")
    (row,) = read_pairs(tmp_path / "t.csv")
    assert row.source == "/x/a.ply"
    assert row.target == str(tmp_path / "sub" / "b.ply")
    assert row.id == "/x/a.ply+sub/b.ply"
    assert row.initial is None


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("", InputError, "is empty"),
        ("source,target\n", InputError, "holds no pairs"),
        ("sorce,target\na,b\n", FormatError, "no column 'source'.*is 'sorce' meant"),
        ("a.ply,b.ply\n", FormatError, "no column 'source'"),
        ("source,source,target\na,b,c\n", FormatError, "more than one column 'source'"),
        ("id,source,target\nx,a,b\nx,a,c\n", InputError, "line 3: the id 'x' is that of .* line 2"),
        ("source,target\na,b\na,b\n", InputError, "line 3: the id"),
        ("source,target\na,\n", InputError, "line 2: the cell 'target' is empty"),
        ("source,target,T00\na,b,1\n", FormatError, "T00 but not T01"),
        ("source,target,initial\na,b,none.txt\n", InputError, "line 2: the first guess.*none.txt"),
        ("source,target,initial," + ",".join(MATRIX_COLUMNS) + "\n", FormatError, "both the column"),
        ("source,target," + ",".join(MATRIX_COLUMNS) + "\na,b" + ",2" * 16 + "\n", InputError, "no rigid"),
        ("source,target," + ",".join(MATRIX_COLUMNS) + "\na,b" + ",x" * 16 + "\n", InputError, "16 numbers"),
        ("source,target,initail\na,b,g.txt\n", FormatError, "column 'initail', which is nearly 'initial'"),
        ("Initial,source,target\ng.txt,a,b\n", FormatError, "column 'Initial', which is nearly 'initial'"),
        ("source,target,T_00\na,b,1\n", FormatError, "column 'T_00', which is nearly 'T00'"),
        ("source,target,ID\na,b,1\n", FormatError, "column 'ID', which is nearly 'id'"),
        ("source,target,id,id\na,b,1,2\n", FormatError, "more than one column 'id'"),
        ("id,source,target\n../../evil,a,b\n", InputError, "line 2: the id '../../evil' cannot name files"),
        ("id,source,target\nx,a,b\n.x,a,c\n", InputError, "line 3: the id '.x' .* must not begin with a dot"),
        ("id,source,target\na/../b,a,b\n", InputError, "nor hold the part '..'"),
        ('source,target\na,b\n"c,d\n', FormatError, "line 3: a cell begins with a quote that is not closed"),
        ('source,target\n"a,b\nc",d\n', FormatError, "line 3: a cell begins with a quote that is not closed"),
        ('source,target\n"a"b,c\n', FormatError, "line 2: a cell begins with a quote that is not closed"),
        ('source,"target\na,b\n', FormatError, "a cell begins with a quote that is not closed"),
        ("source,target\na,b\na,1.ply,b\n", FormatError, "line 3 has more cells than the 2 .* 'b'; put"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_with_its_line(tmp_path, text, kind, message):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(kind, match=message):
        read_pairs(path)


def test_columns_unlike_any_known_one_and_empty_cells_beyond_the_last_are_ignored(tmp_path):
    (tmp_path / "t.csv").write_text("source,target,source_id,note,ids,scene\na,b,1,c,2,d,,\n")
    assert [row.id for row in read_pairs(tmp_path / "t.csv")] == ["a+b"]


def test_ids_made_of_paths_never_hide_a_file(tmp_path):
    (tmp_path / "t.csv").write_text("source,target,id\n../a.ply,b.ply,\n../a.ply,c.ply,../a.ply+c.ply\n")
    ids = [row.id for row in read_pairs(tmp_path / "t.csv")]
    assert ids == ["../a.ply+b.ply", "../a.ply+c.ply"]  # also where a table of results gives it back
    assert transform_name(ids[0]) == "%2E.%2Fa.ply+b.ply.txt"
    assert page_name(ids[1]) == "%2E.%2Fa.ply+c.ply.html"


def test_tables_that_are_no_text_or_not_there(tmp_path):
    with pytest.raises(InputError, match="cannot read"):
        read_pairs(tmp_path / "none.csv")
    (tmp_path / "t.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="UTF-8"):
        read_pairs(tmp_path / "t.csv")


def test_pairs_in_memory(tmp_path):
    rows = as_rows([("a", "b"), (Path("a"), Path("c"), np.eye(4))])
    assert [row.id for row in rows] == ["a+b", "a+c"]
    assert rows[1].matrix.tolist() == np.eye(4).tolist()
    assert [row.id for row in as_rows(np.array([("a", "b")]))] == ["a+b"]
    for bad in ([], ["ab"], [("a",)], [("a", "b"), ("a", "b")]):
        with pytest.raises(InputError):
            as_rows(bad)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (None, "must be a CSV file or a list of .source, target.* found None"),
        (np.zeros((5, 6)), r"list of .* found ndarray of shape \(5, 6\)"),
        (7, "list of .* found int 7"),
        ({"a": "b"}, "list of .* found dict of 1"),
        ([None], "pair 1: expected .* found None"),
        ([("a", "b"), {"a", "b"}], "pair 2: expected .* found set of 2"),
        ([(np.zeros((9, 3)), "b")], r"pair 1: .* must be paths of files, found ndarray of shape \(9, 3\)"),
        ([("a", None)], "pair 1: .* must be paths of files, found None"),
    ],
)
def test_what_is_no_path_is_named(tmp_path, pairs, message):
    with pytest.raises(InputError, match=message):
        register_pairs(pairs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "stem"),
    [("CON", "%43ON"), ("nul.a", "%6Eul.a"), ("com1 ", "%63om1 "), ("Console", "Console"), (" x", "%20x")],
)
def test_no_file_has_a_name_that_windows_forbids(name, stem):
    assert transform_name(name) == f"{stem}.txt"
    assert not set(transform_name('a:b?c*"<|>\\')) & set(':?*"<|>\\')


def test_no_text_of_a_table_is_a_formula():
    rows = [["=1+1", "@x", "+a", "-b", "\tc"], ["-1.5", -2.5, "a=b", "", None]]
    text = csv_text(["id", "a", "b", "c", "d"], rows)
    assert text == "id,a,b,c,d\n'=1+1,'@x,'+a,'-b,'\tc\n-1.5,-2.5,a=b,,\n"
    record = {"id": "=1+1", "error": "@no", "result": None}
    assert results_table([record]).splitlines()[1] == f"'=1+1,error{',' * 19}'@no"


def test_the_summary_names_pairs_whole_where_that_is_short(tmp_path):
    name = "north wing of A/scan 17.e57" + "+" + "north wing of A/scan 18.e57"  # wider than the column
    report = BatchReport(
        tmp_path, (Outcome(name, None, "cannot be read"), Outcome("b", None, "nor this")), 2, 0
    )
    assert f"  {name}  0.00  error" in table(report)
    assert "\n  b  " in table(report)


def test_memory_is_estimated_and_workers_are_bounded(scans, monkeypatch):
    rows = read_pairs(scans[0] / "pairs.csv")
    each = worker_bytes(rows)
    assert 2**28 < each < 2**30
    monkeypatch.setattr("geomoe3d.runtime.machine.Machine.memory", lambda self: (3 * each, 4 * each))
    assert choose_workers(2, each) == (2, int(0.9 * 3 * each) // 2)
    with pytest.raises(InputError, match=r"at most --workers 2"):
        choose_workers(3, each)
    assert choose_workers(None, 100 * each)[0] == 1
    with pytest.raises(InputError, match="at least 1"):
        choose_workers(0, each)


def test_a_folder_in_place_of_a_table_is_told_what_takes_folders(tmp_path):
    with pytest.raises(InputError, match=r"is a folder, not a table of pairs; .* by `multiway`"):
        read_pairs(tmp_path)
