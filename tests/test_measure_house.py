"""The script that measures the house: what counts as a constant, what as a circle."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "measure_house.py"


@pytest.fixture(scope="module")
def house():
    spec = importlib.util.spec_from_file_location("measure_house", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_constants_are_numbers_with_a_name_at_the_level_of_a_module(house):
    text = (
        "A = 1\nB: float = -0.5\nC, D = 2 * 3, 'x'\nE = (1.0, 2)\nF = {'a': 1}\nG = True\nH = 'text'\n"
        "I = np.array([1, 2])\nJ = other\nK = ()\ndef f():\n    L = 1\nclass M:\n    N = 1\n"
    )
    assert [name for name, _ in house.constants(ast.parse(text))] == ["A", "B", "C", "E", "F", "I"]


def test_circles_are_found_through_functions_but_not_through_type_checks(house, tmp_path, monkeypatch):
    monkeypatch.setattr(house, "ROOT", tmp_path)
    texts = {
        "a": "from package import b",
        "b": "def f():\n    from package.c import thing",
        "c": "import package.a",
        "d": "from package.a import x\nif TYPE_CHECKING:\n    from package.e import y",
        "e": "from package import d",
        "__init__": "",
    }
    trees = {tmp_path / "package" / f"{name}.py": ast.parse(text) for name, text in texts.items()}
    assert house.import_circles(trees) == [["package.a", "package.b", "package.c"]]


def test_a_constant_is_of_the_first_kind_that_fits_and_else_decides(house):
    assert house.kind_of("data/splits.py:_TEST").startswith("of a file format")
    assert house.kind_of("maps/store.py:VERSION").startswith("of a file format")
    assert house.kind_of("visual/page.py:MAX_POINTS").startswith("of how an answer is shown")
    assert house.kind_of("decision/scale.py:_UNITS").startswith("of mathematics")
    assert house.kind_of("scoring/surfaces.py:_LEAST_COSINE") == house.DECIDES


def test_what_decides_an_answer_stands_in_the_configuration(house):
    trees = {
        path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(house.PACKAGE.rglob("*.py"))
    }
    found = house.constants_by_kind(trees)
    assert found[house.DECIDES] == []
    assert {kind for kind, places in found.items() if places} == set(house.KINDS)


def test_numbers_inside_functions_are_seen_but_for_those_that_formulas_are_full_of(house):
    text = "A = 0.3\ndef f(x=0.2):\n    return 0.7 * x + 3 + 64 + 1e-9 + 0.5\ndef g():\n    return 3.5, 2.0\n"
    assert list(house.numbers_inside(ast.parse(text))) == [(0.7, 3), (3.5, 5)]
