"""What the package promises around its code: names, quiet imports, files that agree with each other."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import yaml

import geomoe3d
from geomoe3d.config import RegistrationConfig, Section, load_config
from geomoe3d.errors import ConfigError
from geomoe3d.runtime.config_text import commented_yaml

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "geomoe3d"
HEAVY = {"open3d", "torch", "matplotlib", "scipy", "trimesh", "small_gicp", "laspy", "pye57"}
CONFIGS = sorted((ROOT / "configs").glob("**/*.yaml"))


def in_a_fresh_python(code):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )


# ---- the public names ----------------------------------------------------------------------------


def test_importing_is_quiet_and_loads_nothing_heavy():
    done = in_a_fresh_python(
        "import sys, geomoe3d; print(sorted({name.split('.')[0] for name in sys.modules}))"
    )
    assert done.stderr == ""
    loaded = set(ast.literal_eval(done.stdout))
    assert "geomoe3d" in loaded
    assert not loaded & (HEAVY | {"numpy", "pydantic"})


def test_importing_takes_less_time_than_importing_numpy():
    """Beside each other in one test: how long either takes is the machine's affair."""

    def seconds(module):
        code = (
            f"import time; start = time.perf_counter(); import {module}; print(time.perf_counter() - start)"
        )
        return min(float(in_a_fresh_python(code).stdout) for _ in range(3))

    assert seconds("geomoe3d") < seconds("numpy")


def test_light_names_stay_light():
    """Errors, nouns and the configuration come without the libraries that compute."""
    done = in_a_fresh_python(
        "import sys, geomoe3d as g; g.PointCloud, g.InputError, g.RegistrationConfig, g.load_config\n"
        "g.RegistrationResult; print(sorted({name.split('.')[0] for name in sys.modules}))"
    )
    assert not set(ast.literal_eval(done.stdout)) & HEAVY


def test_importing_the_entry_point_loads_nothing_heavy():
    done = in_a_fresh_python("import sys, geomoe3d.registration; print(*sys.modules)")
    assert not {name.split(".")[0] for name in done.stdout.split()} & HEAVY


def test_every_public_name_is_there_and_documented():
    assert set(geomoe3d.__all__) <= set(dir(geomoe3d))
    for name in geomoe3d.__all__:
        value = getattr(geomoe3d, name)
        if name != "__version__":
            assert value.__name__ == name
            assert value.__doc__
    inventory = "register Registrar RegistrationResult RegistrationConfig load_config load_points save_points"
    assert {*inventory.split(), "PointCloud", "Correspondences", "InputError"} <= set(geomoe3d.__all__)


def test_every_error_class_is_public():
    import geomoe3d.errors as errors

    classes = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert classes <= set(geomoe3d.__all__)


def test_type_checkers_see_the_same_names_as_python():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert {*seen, "__version__"} == set(geomoe3d.__all__)
    for name, module in seen.items():
        assert f"geomoe3d.{geomoe3d._HOME.get(name, 'errors')}" == module


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(AttributeError, match="did you mean 'register'"):
        geomoe3d.regster  # noqa: B018
    with pytest.raises(AttributeError, match="public names: "):
        geomoe3d.qqqqqqqq  # noqa: B018
    assert not hasattr(geomoe3d, "__wrapped__")
    with pytest.raises(ImportError):
        from geomoe3d import regster  # noqa: F401


# ---- versions and files that must agree --------------------------------------------------------------


def pyproject():
    return (ROOT / "pyproject.toml").read_text()


def test_version_is_that_of_the_metadata():
    assert f'\nversion = "{geomoe3d.__version__}"\n' in pyproject()


def test_the_package_says_that_it_is_typed():
    assert (PACKAGE / "py.typed").is_file()
    assert "Typing :: Typed" in pyproject()


def test_precommit_uses_the_pinned_tools():
    pinned = dict(re.findall(r'"(ruff|mypy)==([\d.]+)"', pyproject()))
    assert set(pinned) == {"ruff", "mypy"}
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    hooks = {hook["id"]: hook for repo in config["repos"] for hook in repo["hooks"]}
    assert {"ruff-check", "ruff-format", "mypy"} <= set(hooks)
    for name in ("ruff-check", "ruff-format"):
        assert hooks[name]["additional_dependencies"] == [f"ruff=={pinned['ruff']}"]
    # mypy runs in the environment that the dev extra fills, hence with the pinned version.
    assert hooks["mypy"]["language"] == "system"
    assert hooks["mypy"]["name"] == f"mypy {pinned['mypy']}"


def constraints():
    """Tested version of each dependency on this Python."""
    from packaging.requirements import Requirement

    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    here = [pin for pin in pins if pin.marker is None or pin.marker.evaluate()]
    assert len({pin.name.lower() for pin in here}) == len(here)
    return {pin.name.lower(): str(pin.specifier).removeprefix("==") for pin in here}


def test_set_up_installs_the_torch_that_the_doctor_recommends():
    from geomoe3d.doctor import TORCH

    assert f"torch=={constraints()['torch']}" == TORCH


def test_every_declared_dependency_has_a_tested_version_within_its_range():
    from packaging.requirements import Requirement

    tables = pyproject().split("dependencies = [", 1)[1].split("[project.scripts]")[0]
    requirements = [Requirement(text) for text in re.findall(r'"([^"]+)"(?:,|\]|\n)', tables)]
    assert len(requirements) > 15
    tested = constraints()
    for requirement in requirements:
        exact = any(specifier.operator == "==" for specifier in requirement.specifier)
        if not exact and requirement.name != "pre-commit":
            assert tested[requirement.name.lower()] in requirement.specifier, requirement


def test_the_readme_has_two_commands_of_set_up_and_links_that_exist():
    text = (ROOT / "README.md").read_text()
    shell = "".join(re.findall(r"```(?:bash|sh|console)\n(.*?)```", text, re.DOTALL))
    commands = re.findall(r"^bash (\S+)", shell, re.MULTILINE)
    assert commands == ["scripts/quickstart.sh", "scripts/test.sh"]
    assert not re.search(r"apt-get|pip install|venv -m|conda", shell)
    for script in commands:
        assert (ROOT / script).is_file()
    calls = re.findall(r"^bash (scripts/\S+)$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert calls == commands
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert (ROOT / link).exists(), link


def test_verbs_and_options_in_the_readme_exist():
    from geomoe3d.cli.main import VERBS
    from geomoe3d.cli.register import command

    text = (ROOT / "README.md").read_text()
    quickstart = (ROOT / "docs" / "quickstart.md").read_text()
    for verb in VERBS:
        assert f"| `{verb}` | " in quickstart
    assert len(re.findall(r"^\|[-|]+\|$", text, re.MULTILINE)) == 1  # one table
    text += quickstart
    options = {option for parameter in command.params for option in parameter.opts}
    used = set(re.findall(r"(?<![\w-])(--[a-z][a-z-]*)", text))
    assert used <= options | {"--help"}


@pytest.mark.parametrize("script", ["quickstart.sh", "test.sh", "environment.sh", "../.ci/run"])
def test_shell_scripts_parse(script):
    subprocess.run(["bash", "-n", str(ROOT / "scripts" / script)], check=True)


# ---- configuration ------------------------------------------------------------------------------------


def test_there_are_configurations():
    assert ROOT / "configs" / "default.yaml" in CONFIGS


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_configuration_loads(path):
    """Those for training and for making data lie in folders of their own."""
    parts = path.relative_to(ROOT).parts
    if "train" in parts:
        from geomoe3d.training.config import load_train_config

        load_train_config(path, [])
    elif "data" in parts:
        from geomoe3d.config import build_config, read_yaml
        from geomoe3d.data.settings import SynthesisSettings

        build_config(SynthesisSettings, read_yaml(path))
    else:
        load_config(path)


def test_default_yaml_is_the_defaults_word_for_word():
    path = ROOT / "configs" / "default.yaml"
    assert load_config(path) == RegistrationConfig()
    expected = commented_yaml(RegistrationConfig())
    assert path.read_text() == expected, "run: geomoe3d config --output configs/default.yaml --force"


def test_commented_yaml_reads_back_whatever_the_values(tmp_path):
    changes = ["voxel_size=0.1", "seed=7", "estimator.name=ransac", "filter.name='no'"]
    config = load_config(None, [*changes, "decision.min_confidence=1e-3"])
    path = tmp_path / "config.yaml"
    path.write_text(commented_yaml(config))
    assert load_config(path) == config
    assert len(list(tmp_path.iterdir())) == 1


def test_commented_yaml_names_every_key_with_its_choices_and_limits():
    text = commented_yaml(RegistrationConfig(), expert=True)
    assert yaml.safe_load(text) == RegistrationConfig().model_dump(mode="json")
    assert re.search(r"one of auto, origin, guess, centroid\n  viewpoint: auto\n", text)
    assert re.search(r"# .*above 0\nvoxel_size: null\n", text)


def test_every_key_says_what_it_means():
    def silent(section, prefix=""):
        for name, info in section.model_fields.items():
            if isinstance(info.annotation, type) and issubclass(info.annotation, Section):
                assert info.annotation.__doc__
                yield from silent(info.annotation, f"{prefix}{name}.")
            elif not info.description:
                yield prefix + name

    assert list(silent(RegistrationConfig)) == []


def test_an_unknown_key_names_the_nearest(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("estimator:\n  inlier_treshold: 1\n")
    with pytest.raises(ConfigError, match=r"bad\.yaml.*estimator\.inlier_threshold"):
        load_config(path)


# ---- the order of imports -----------------------------------------------------------------------------

ORDER = [
    {"errors", "types", "config"},
    {"runtime"},
    {"parts", "doctor", "geometry"},
    {"clouds"},
    {"visual"},
    {"result"},
    {"features", "matching"},
    {"estimators", "networks"},
    {"filters", "scoring", "data"},
    {"refinement"},
    {"decision"},
    {"pipeline"},
    {"maps"},
    {"correspondence_registration"},
    {"line"},
    {"registration"},
    {"evaluation", "batch", "multiway"},
    {"images", "training"},
    {"cli", "__main__"},
]
"""Each may import from its own level and those above it in this list."""


def level_of(module):
    part = module.split(".")[1] if "." in module else ""
    for level, names in enumerate(ORDER):
        if part in names:
            return level
    raise AssertionError(f"'{module}' has no place in ORDER; give it one")


def imports_of(path):
    """Modules of the package that a file imports, also inside functions; not those for type checkers."""
    tree = ast.parse(path.read_text(), str(path))
    unread = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
        for statement in node.body
        for inner in ast.walk(statement)
    }
    for node in ast.walk(tree):
        if id(node) in unread:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("geomoe3d."))
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "geomoe3d":
                yield from (
                    f"geomoe3d.{a.name}"
                    for a in node.names
                    if (PACKAGE / a.name).is_dir() or (PACKAGE / f"{a.name}.py").is_file()
                )
            elif (node.module or "").startswith("geomoe3d."):
                yield node.module


FILES = sorted(path for path in PACKAGE.glob("**/*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_file_imports_upward(path):
    own = ".".join(("geomoe3d", *path.relative_to(PACKAGE).with_suffix("").parts))
    for module in imports_of(path):
        assert level_of(module) <= level_of(own), f"{own} imports {module}, which stands above it"


def circle(wanted):
    """Names that import each other, over whatever detour; empty where there is none."""
    try:
        TopologicalSorter(wanted).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_no_rooms_import_each_other():
    """Not even those of one level, and over no detour."""
    wanted = {}
    for path in FILES:
        own = path.relative_to(PACKAGE).with_suffix("").parts[0]
        others = {module.split(".")[1] for module in imports_of(path)} - {own}
        wanted.setdefault(own, set()).update(others)
    assert circle(wanted) == []


def test_no_files_import_each_other():
    """Not even inside functions."""

    def name_of(path):
        return ".".join(("geomoe3d", *path.relative_to(PACKAGE).with_suffix("").parts))

    assert circle({name_of(path): set(imports_of(path)) for path in FILES}) == []


def test_the_root_of_the_package_holds_few_files():
    assert len(list(PACKAGE.glob("*.py"))) <= 12


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_file_imports_heavy_libraries_when_it_is_imported(path):
    """torch alone may be, by the files of networks, fits, images and training, which load when used."""
    tree = ast.parse(path.read_text(), str(path))
    rooms = {"networks", "filters", "scoring", "training", "geometry", "images"}
    allowed = {"scipy", "torch"} if rooms & set(path.relative_to(PACKAGE).parts) else {"scipy"}
    found = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    assert not (found & HEAVY) - allowed


def test_the_order_of_imports_catches_an_upward_import(tmp_path):
    path = tmp_path / "low.py"
    path.write_text("def f():\n    from geomoe3d.registration import register\n    return register\n")
    (module,) = imports_of(path)
    assert level_of(module) > level_of("geomoe3d.clouds.io")
