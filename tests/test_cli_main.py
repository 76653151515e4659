"""The verbs and their help: names, versions, wrong words, and how soon it answers."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from command_line import ROOT, call

from geomoe3d import __version__
from geomoe3d.cli.main import VERBS, geomoe3d, register_main


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("option", ["--help", "-h"])
def test_help_of_every_verb(verb, option, capsys):
    assert call(verb, option) == 0
    assert f"Usage: geomoe3d {verb}" in capsys.readouterr().out


def all_commands(command, words=()):
    found = [words]
    for name in getattr(command, "commands", None) or (() if words else VERBS):
        inner = command.get_command(None, name)
        found += [] if inner.hidden else all_commands(inner, (*words, name))
    return found


@pytest.mark.parametrize("words", all_commands(geomoe3d), ids=" ".join)
def test_no_help_shows_the_kinds_of_values_that_a_programmer_knows(words, capsys):
    assert call(*words, "--help") == 0
    text = capsys.readouterr().out
    assert not re.findall(r"\b(?:INTEGER|FLOAT|RANGE|TEXT|BOOLEAN|PATH|DIRECTORY)\b|[0-9x][<>]=?", text)


def test_help_lists_every_verb_with_its_purpose(capsys):
    assert call("--help") == 0
    text = capsys.readouterr().out
    for verb in VERBS:
        assert re.search(rf"^  {verb} +[A-Z]", text, re.MULTILINE)


def test_version(capsys):
    assert call("--version") == 0
    assert __version__ in capsys.readouterr().out


def test_register_is_a_command_of_its_own(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["register", "--help"])
    with pytest.raises(SystemExit) as stop:
        register_main()
    assert stop.value.code == 0
    alone = capsys.readouterr().out
    assert call("register", "--help") == 0
    assert capsys.readouterr().out.replace("geomoe3d register", "register") == alone


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["regster"], "register"),
        (["register", "a", "b", "--voxelsize", "1"], "--voxel-size"),
        (["register", "a", "b", "--set", "estimator.nmae=ransac"], "estimator.name"),
        (["register", "a", "b", "--set", "voxel_sizes=1"], "voxel_size"),
        (["register", "a", "b", "--estimator", "ransack"], "'ransac'"),
        (["register", "a", "b", "--set", "seed"], "key=value"),
        (["register", "a", "b", "--voxel-size", "0"], "greater than 0"),
        (["register", "a", "b", "--voxel-size", "-1"], "greater than 0"),
        (["register", "a", "b", "--voxel-size", "big"], "--voxel-size"),
        (["register", "a", "b", "--seed", "-1"], "seed"),
        (["register", "a", "b", "--voxel-size", "inf"], "finite"),
        (["register", "a", "b", "--config", "/there/is/none.yaml"], "/there/is/none.yaml"),
        (
            ["multiway", "a", "b", "--neighbors", "0"],
            "'0' is not allowed here; give a whole number, at least 1",
        ),
        (
            ["multiway", "a", "b", "--rounds", "1.5"],
            "'1.5' is not allowed here; give a whole number, at least 0",
        ),
        (["locate", "a", "b", "--within", "nan"], "'nan' is not allowed here; give a number, greater than 0"),
        (
            ["pose", "a", "b", "--threshold", "inf"],
            "'inf' is not allowed here; give a number, greater than 0",
        ),
        (["pose", "a", "b", "--keypoints", "7"], "a whole number, at least 8 and at most 100000"),
        (["data", "features", "a", "b", "--min-overlap", "1.01"], "a number, at least 0 and at most 1"),
        (["register", "a", "b", "--reader", "mine"], "'mine' names no code of yours"),
        (["register", "a", "b", "--reader", "mine.py:"], "write file.py:NAME or module:NAME"),
        (["register", "a"], "TARGET"),
        (["register", "", "b"], "an empty name is given for SOURCE"),
        (["multiway", "a", "b", ""], "an empty name is given for SCANS... OUT"),
        (["index", "", "b.map"], "an empty name is given for CLOUDS... OUT.map"),
        (["register", "a", "b", "c"], "(c); the file to write is given by --output"),
        (
            ["multiway", "a", "b", "--output", "c"],
            "OUT is the last argument, as in 'geomoe3d multiway SCANS... OUT'",
        ),
        (
            ["index", "a", "--output=c"],
            "OUT.map is the last argument, as in 'geomoe3d index CLOUDS... OUT.map'",
        ),
        (["data", "synthesize", "-o", "c"], "-o is not an option here: OUT is the last argument"),
        (["evaluate", "compare", "--output", "c"], "No such option"),
        (["qqqq"], "register"),
    ],
)
def test_a_wrong_word_ends_with_2_and_the_right_one(arguments, hint, fake_registrar, capsys):
    assert call(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert hint in printed.err
    assert "Traceback" not in printed.err
    assert fake_registrar.asked == []


def test_help_loads_no_library():
    """What makes it quick; how long it takes is the machine's affair."""
    code = (
        "import sys\n"
        "from geomoe3d.cli.main import geomoe3d; from geomoe3d.cli.errors import run\n"
        "code = run(geomoe3d, 'geomoe3d', ['--help'])\n"
        "heavy = {'numpy', 'open3d', 'torch', 'matplotlib', 'scipy', 'rich', 'pydantic'} & set(sys.modules)\n"
        "print(code, sorted(heavy))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "0 []"


def test_the_help_sets_options_for_experts_apart(capsys):
    assert call("register", "--help") == 0
    usual, expert = capsys.readouterr().out.split("Options for experts:")
    for option in ("--output", "--aligned", "--voxel-size", "--report"):
        assert option in usual.split("Options:")[1]
    for option in ("--descriptor", "--scorer", "--set", "--seed", "--traceback"):
        assert f"\n  {option} " in expert


def test_no_purpose_in_the_help_is_cut_short(capsys):
    for verb in ((), ("data",), ("evaluate",)):
        assert call(*verb, "--help") == 0
        assert "..." not in capsys.readouterr().out.split("Commands:")[1]
