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
