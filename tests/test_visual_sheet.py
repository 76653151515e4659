"""The sheet for a customer: one page of PDF that says everything, by the command line and from Python."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from registration_views import make_result, nasty_view, room_view, without_transform

from geomoe3d.errors import FormatError, OutputError
from geomoe3d.types import Accuracy
from geomoe3d.visual.sheet import draw_sheet, save_sheet


def texts(view):
    figure = draw_sheet(view)
    own = [text.get_text() for text in figure.texts]
    return own + [
        text.get_text() for axes in figure.axes for text in axes.findobj(lambda one: hasattr(one, "get_text"))
    ]


def accuracy(**changes):
    names = Accuracy.__dataclass_fields__
    return Accuracy(**{**dict.fromkeys(names, 0.0123), **changes})


def test_a_sheet_says_scans_transform_accuracy_and_versions():
    view = room_view()
    result = replace(view.result, accuracy=accuracy(), versions={"geomoe3d": "9.8.7", "numpy": "6.5.4"})
    said = "\n".join(texts(replace(view, result=result, unit="m")))
    for word in (
        "source_scan.ply",
        "target_scan.ply",
        "ok, confidence 0.90",
        "0.0123 m",
        "numpy 6.5.4",
        "seed 0",
    ):
        assert word in said, word
    row = [f"{value:.9f}" for value in result.T_target_source[0, :3]]
    assert all(cell in said for cell in row)
    assert "Distances after alignment" in said and "0.05 m" in said


def test_a_sheet_without_a_transform_says_so():
    said = "\n".join(texts(without_transform(room_view())))
    assert "No transform was found" in said and "Distances after alignment" not in said


def test_the_file_is_one_page_and_repeatable(tmp_path):
    for view, name in ((room_view(), "a"), (nasty_view(), "b")):
        save_sheet(view, tmp_path / f"{name}.pdf")
        data = (tmp_path / f"{name}.pdf").read_bytes()
        assert data.startswith(b"%PDF") and len(re.findall(rb"/Type /Page\b", data)) == 1
        save_sheet(view, tmp_path / f"{name}.pdf", force=True)
        assert (tmp_path / f"{name}.pdf").read_bytes() == data
    with pytest.raises(OutputError):
        save_sheet(room_view(), tmp_path / "a.pdf")
    with pytest.raises(FormatError, match=r"use one of \.pdf"):
        save_sheet(room_view(), tmp_path / "a.png")


def test_many_long_reasons_stay_on_the_page():
    view = room_view()
    result = make_result(
        np.eye(4), status="ambiguous", reasons=("a reason of many words " * 20,) * 9, accuracy=accuracy()
    )
    figure = draw_sheet(replace(view, result=result))
    assert all(0 < text.get_position()[1] < 1 for text in figure.texts)
