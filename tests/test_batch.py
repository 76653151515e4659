"""Many pairs: the folder that survives kills, what is its own, the command and its page."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dying_tasks import die_always
from headless_browser import browse
from small_scans import SETTINGS, everything, write_table

from geomoe3d import register_pairs
from geomoe3d.batch.folder import JOURNAL_FILE, RESULTS_FILE
from geomoe3d.batch.run import BatchReport
from geomoe3d.batch.store import Outcome
from geomoe3d.batch.table import MATRIX_COLUMNS
from geomoe3d.cli.batch import table as summary
from geomoe3d.clouds.transform_files import load_transform, save_transform
from geomoe3d.config import load_config
from geomoe3d.errors import (
    CheckpointError,
    ConfigError,
    DependencyError,
    FormatError,
    InputError,
    OutputError,
)
from geomoe3d.geometry.se3 import inverse
from geomoe3d.registration import Registrar

CONFIG = load_config(None, SETTINGS)
OPTIONS = [part for setting in SETTINGS for part in ("--set", setting)]
ROOT = Path(__file__).parents[1]


pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def finished(scans, tmp_path_factory):
    """The table, done in this process."""
    out = tmp_path_factory.mktemp("out") / "batch"
    return register_pairs(scans[0] / "pairs.csv", out, config=CONFIG, transforms=True, page=True), out


def run_cli(*arguments, check=None, **named):
    done = subprocess.run(
        [sys.executable, "-m", "geomoe3d", "batch", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=ROOT,
        check=False,
        **named,
    )
    if check is not None:
        assert done.returncode == check, done.stderr
    return done


# ---- results ----------------------------------------------------------------------------------------


def test_a_transform_reads_back_bit_for_bit_from_every_format(tmp_path, finished):
    result = finished[0].outcomes[0].result
    (tmp_path / "t.json").write_text(result.to_json())
    for suffix in (".txt", ".npy"):
        save_transform(tmp_path / f"t{suffix}", result.T_target_source, ["hello"])
    for suffix in (".txt", ".npy", ".json"):
        assert load_transform(tmp_path / f"t{suffix}").tobytes() == result.T_target_source.tobytes()
    (tmp_path / "short.txt").write_text("1 2\n3 4\n")
    (tmp_path / "t.xml").write_text("<T/>")
    for name, kind in (("none.txt", InputError), ("short.txt", FormatError), ("t.xml", FormatError)):
        with pytest.raises(kind):
            load_transform(tmp_path / name)


def test_every_pair_has_its_answer_and_a_broken_file_fails_its_own_pair_alone(scans, finished):
    _, poses = scans
    report, _ = finished
    assert [outcome.id for outcome in report.outcomes] == ["ab", "ac", "bc", "bad", "gone"]
    for outcome in report.outcomes[:3]:
        source, target = outcome.id
        assert outcome.status == "ok"
        T = inverse(poses[target]) @ poses[source]
        assert np.abs(outcome.result.T_target_source - T).max() < 0.03
    assert "broken.ply" in report.outcomes[3].error
    assert "missing.ply" in report.outcomes[4].error
    assert report.counts() == {"ok": 3, "error": 2}
    assert not report.ok
    assert (report.made, report.kept) == (5, 0)


def test_results_are_a_table_too(finished):
    report, out = finished
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["id"] for row in rows] == [outcome.id for outcome in report.outcomes]
    assert [row["status"] for row in rows] == ["ok"] * 3 + ["error"] * 2
    for row, outcome in zip(rows[:3], report.outcomes[:3], strict=True):
        T = np.array([float(row[name]) for name in MATRIX_COLUMNS]).reshape(4, 4)
        assert T.tobytes() == outcome.result.T_target_source.tobytes()
        assert float(row["confidence"]) == outcome.result.confidence
    assert "broken.ply" in rows[3]["reasons"] and rows[3]["T00"] == ""


def test_a_result_is_what_register_gives(scans, finished):
    folder, _ = scans
    one = Registrar(CONFIG).register(folder / "a.npy", folder / "b.npy")
    other = finished[0].outcomes[0].result
    assert json.loads(one.to_json()) | {"seconds": 0} == json.loads(other.to_json()) | {"seconds": 0}


def test_transforms_and_page_are_written(finished):
    report, out = finished
    assert sorted(path.name for path in (out / "transforms").iterdir()) == ["ab.txt", "ac.txt", "bc.txt"]
    T = load_transform(out / "transforms" / "ab.txt")
    assert T.tobytes() == report.outcomes[0].result.T_target_source.tobytes()
    page = (out / "page.html").read_text()
    assert page.count('src="data:image/png;base64,iVBOR') == 3
    assert "http" not in page.replace("http-equiv", "")
    order = [name for name in re.findall(r"<small>(\w+)</small>", page) if len(name) < 5]
    sure = {outcome.id: outcome.confidence for outcome in report.outcomes}
    assert [sure[name] for name in order] == sorted(sure.values())


# Uses the page as a person would and notes which pairs are shown, in their order.
CHOOSE = """
(() => {
  const form = document.getElementById("choose"), log = {};
  const note = (name) => {
    form.dispatchEvent(new Event("input"));
    const shown = [...document.querySelectorAll("#pairs li")].filter((pair) => !pair.hidden);
    log[name] = shown.map((pair) => pair.dataset.id);
  };
  note("start");
  form.elements.sort.value = "id"; note("by id");
  form.elements.sort.value = "-confidence"; note("surest first");
  form.elements.confidence.value = "0.0"; note("unsure");
  form.elements.confidence.value = "1"; form.elements.find.value = "C.NPY"; note("found");
  form.elements.find.value = "";
  document.querySelector('[name="status"][value="error"]').checked = false; note("registered");
  log.early = document.querySelectorAll("img[src]").length;
  setTimeout(() => {
    const shown = [...document.querySelectorAll("img[src]")];
    log.late = shown.filter((picture) => picture.complete && picture.naturalWidth).length;
    document.body.dataset.log = JSON.stringify(log);
  }, 500);
})();
"""


def test_the_page_sorts_and_filters(finished, tmp_path):
    report, out = finished
    seen = browse(tmp_path, (out / "page.html").read_text(), script=CHOOSE, webgl=False)
    log, sure = json.loads(seen["log"]), {outcome.id: outcome.confidence for outcome in report.outcomes}
    failed = {outcome.id for outcome in report.outcomes if outcome.result is None}
    assert sorted(log["start"]) == sorted(sure) and [sure[k] for k in log["start"]] == sorted(sure.values())
    assert log["by id"] == sorted(sure)
    assert [sure[k] for k in log["surest first"]] == sorted(sure.values(), reverse=True)
    assert set(log["unsure"]) == {k for k, value in sure.items() if value == 0} == failed
    assert {"ac", "bc"} <= set(log["found"]) and "ab" not in log["found"]
    assert set(log["registered"]) == set(sure) - failed
    assert (log["early"], log["late"]) == (0, 3)  # pictures are decoded as they come into view


def test_pages_of_the_pairs_and_of_those_that_left_the_table(scans, copied, tmp_path):
    table = scans[0] / "two.csv"
    write_table(table, [("a/b", "a", "b"), ("bc", "b", "c")])
    register_pairs(table, copied, config=CONFIG, page=True, pages=True)
    pages = copied / "pages"
    assert sorted(path.name for path in pages.iterdir()) == ["a%2Fb.html", "bc.html"]
    text = (copied / "page.html").read_text()
    assert 'href="pages/a%252Fb.html"' in text and 'data-id="ac"' not in text
    assert "source_points" in text or "a.npy" in (pages / "a%2Fb.html").read_text()
    (pages / "mine.html").write_text((pages / "bc.html").read_text())
    write_table(table, [("a/b", "a", "b")])
    register_pairs(table, copied, config=CONFIG)  # without a word of pages
    assert 'data-id="bc"' not in (copied / "page.html").read_text()
    register_pairs(table, copied, config=CONFIG, pages=True)
    assert sorted(path.name for path in pages.iterdir()) == ["a%2Fb.html", "mine.html"]
    (pages / "bc.html").write_text("mine")
    write_table(table, [("bc", "b", "c")])
    with pytest.raises(InputError, match=r"bc\.html' is not of a batch.*leave the pages out"):
        register_pairs(table, copied, config=CONFIG, pages=True)
    register_pairs(table, copied, config=CONFIG, fresh=True)
    assert sorted(path.name for path in pages.iterdir()) == ["bc.html", "mine.html"]


def test_called_again_nothing_is_done_again(scans, finished):
    _, out = finished
    files = everything(out)
    again = register_pairs(scans[0] / "pairs.csv", out, config=CONFIG, transforms=True, page=True)
    assert (again.made, again.kept) == (0, 5)
    assert everything(out) == files
    retried = register_pairs(scans[0] / "pairs.csv", out, config=CONFIG, retry=True)
    assert (retried.made, retried.kept) == (2, 3)


def test_copies_elsewhere_are_the_same_input_and_other_content_is_another(scans, copied, tmp_path):
    folder = shutil.copytree(scans[0], tmp_path / "there")
    table, b = tmp_path / "there" / "pairs.csv", tmp_path / "there" / "b.npy"
    write_table(table, [("ab", "a", "b"), ("other id", "a", "c"), ("bc", "b", "c")])
    again = register_pairs(table, copied, config=CONFIG)
    assert (again.made, again.kept) == (0, 3)
    assert [outcome.id for outcome in again.outcomes] == ["ab", "other id", "bc"]
    points, status = np.load(b), b.stat()
    np.save(b, points[::-1])
    os.utime(b, ns=(status.st_atime_ns, status.st_mtime_ns))  # neither size nor time tell
    assert b.stat().st_size == status.st_size
    again = register_pairs(folder / "pairs.csv", copied, config=CONFIG)
    assert (again.made, again.kept) == (2, 1)


def test_two_processes_give_the_same_bytes(scans, finished, tmp_path):
    _, out = finished
    register_pairs(scans[0] / "pairs.csv", tmp_path / "two", config=CONFIG, workers=2, cache="")
    assert (tmp_path / "two" / RESULTS_FILE).read_bytes() == (out / RESULTS_FILE).read_bytes()


def test_another_configuration_never_mixes(scans, finished):
    _, out = finished
    other = load_config(None, [*SETTINGS, "seed=1"])
    with pytest.raises(InputError, match=r"seed \(0 there, 1 now\)"):
        register_pairs(scans[0] / "pairs.csv", out, config=other)


# ---- what is the batch's own in its folder --------------------------------------------------------


@pytest.fixture
def copied(finished, tmp_path):
    """A finished batch of the test's own."""
    shutil.copytree(finished[1], tmp_path / "copied")
    return tmp_path / "copied"


@pytest.mark.parametrize("new", [False, True], ids=["begun anew", "new"])
@pytest.mark.parametrize(
    ("named", "kind", "message"),
    [
        ({"workers": 1000}, InputError, "1,000 workers would take"),
        ({"workers": 1, "scheduler": "tcp://127.0.0.1:1"}, InputError, "either workers or a scheduler"),
        ({"scheduler": "tcp://127.0.0.1:1"}, DependencyError, "needs Dask"),
        ({"cache": __file__}, OutputError, "is a file; the cache of features is a folder"),
        ({"cache": f"{__file__}/deeper"}, OutputError, "is a file"),
        ({"config": ["filter.name=nothing"]}, ConfigError, "unknown filter"),
        ({"config": ["scoring.weights=nowhere"]}, CheckpointError, "nowhere"),
    ],
)
def test_what_is_refused_is_before_anything_is_removed_or_written(
    scans, copied, monkeypatch, new, named, kind, message
):
    import geomoe3d.runtime.optional as optional

    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(optional, "import_module", absent)
    monkeypatch.setattr("geomoe3d.runtime.machine.Machine.memory", lambda self: (8 << 30, 16 << 30))
    folder = copied.with_name("new") if new else copied
    before = everything(folder)
    named = {**named, "config": load_config(None, [*SETTINGS, *named.get("config", [])])}
    with pytest.raises(kind, match=message):
        register_pairs(scans[0] / "pairs.csv", folder, fresh=not new, **named)
    assert everything(folder) == before
    assert folder.exists() != new


def test_a_worker_that_dies_as_it_begins_costs_no_results(scans, copied, monkeypatch):
    monkeypatch.setattr("geomoe3d.batch.run.make_ready", die_always)
    monkeypatch.setattr("geomoe3d.batch.run.Settings.of", lambda *given: 2)
    before = everything(copied)
    with pytest.raises(OutputError, match="a worker died as it began"):
        register_pairs(scans[0] / "pairs.csv", copied, config=CONFIG, fresh=True, workers=1)
    assert everything(copied) == before


def test_beginning_anew_removes_what_the_batch_left_and_nothing_else(scans, copied):
    mine = [copied / "notes.md", copied / "transforms" / "ab.npy", copied / "transforms" / "mine.txt"]
    for path in mine:
        path.write_text("mine")
    renamed = copied / "transforms" / "ab before.txt"
    renamed.write_bytes((copied / "transforms" / "ab.txt").read_bytes())
    one = copied.with_name("one.csv")
    write_table(one, [("1", scans[0] / "a", scans[0] / "b")])
    other = load_config(None, [*SETTINGS, "seed=1"])
    register_pairs(one, copied, config=other, fresh=True)
    left = {path.relative_to(copied).as_posix() for path in everything(copied)}
    kept = {"notes.md", "transforms/ab.npy", "transforms/mine.txt", "transforms/ab before.txt"}
    assert left == {"run.json", JOURNAL_FILE, RESULTS_FILE, "results.csv", "files.json", *kept}
    for path in (*mine, renamed):
        path.unlink()
    (copied / "page.html").write_text("<html>mine</html>")
    register_pairs(one, copied, config=other, transforms=True)
    register_pairs(one, copied, config=other, fresh=True)
    assert not (copied / "transforms").exists()
    assert (copied / "page.html").read_text() == "<html>mine</html>"


def test_transforms_of_pairs_that_have_none_any_more_are_removed(scans, copied, tmp_path):
    folder = copied / "transforms"
    mine = folder / "mine.txt"
    head = "# maps SOURCE (a) into TARGET (b): p_target = R p_source + t\n# status ok, confidence 1.0"
    mine.write_text(f"{head}, geomoe3d 0.1.0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")  # of one registration
    (folder / "earlier.txt").write_text(f"{head}\n1 0 0 0\n")  # of a batch that did not name its pair yet
    lines = (scans[0] / "pairs.csv").read_text().replace("ac,a.npy,c.npy", "ac,a.npy,missing.npy")
    table = scans[0] / "changed.csv"
    table.write_text("".join(line for line in lines.splitlines(True) if not line.startswith("bc")))
    register_pairs(table, copied, config=CONFIG, transforms=True)
    assert sorted(path.name for path in folder.iterdir()) == ["ab.txt", "mine.txt"]


def test_two_batches_in_one_folder_are_refused(scans, finished):
    _, out = finished
    from geomoe3d.runtime.journal import Journal

    before = (out / JOURNAL_FILE).read_bytes()
    for fresh in (False, True):  # beginning anew must not pull the journal from under the other's feet
        with Journal(out / JOURNAL_FILE), pytest.raises(OutputError, match="another process"):
            register_pairs(scans[0] / "pairs.csv", out, config=CONFIG, fresh=fresh)
    assert (out / JOURNAL_FILE).read_bytes() == before


# ---- the command ------------------------------------------------------------------------------------


def test_the_command_says_what_it_will_take_and_exits_with_three(scans, finished, tmp_path):
    done = run_cli(scans[0] / "pairs.csv", tmp_path / "o", *OPTIONS, "--workers", "1", check=3)
    assert re.search(r"1 worker of about 0\.\d GiB, each held to [\d.]+ GiB", done.stderr)
    assert re.search(r"ok +3 +60\.0%", done.stdout)
    assert "broken.ply" in done.stdout
    assert (tmp_path / "o" / RESULTS_FILE).read_bytes() == (finished[1] / RESULTS_FILE).read_bytes()


def test_exit_codes_of_a_good_and_of_an_unusable_table(scans, finished, tmp_path):
    good = tmp_path / "good.csv"
    good.write_text(f"id,source,target\nab,{scans[0] / 'a.npy'},{scans[0] / 'b.npy'}\n")
    done = run_cli(good, finished[1], *OPTIONS, "--quiet", check=0)  # done there already
    assert done.stdout == done.stderr == ""
    said = run_cli(tmp_path / "none.csv", tmp_path / "x", check=2).stderr
    assert said == f"error: cannot read '{tmp_path / 'none.csv'}': No such file or directory\n"
    assert not (tmp_path / "x").exists()


def test_too_many_workers_with_fresh_leave_the_results(scans, copied):
    before = everything(copied)
    done = run_cli(scans[0] / "pairs.csv", copied, *OPTIONS, "--workers", "1000000", "--fresh", check=2)
    assert "use at most --workers" in done.stderr
    assert everything(copied) == before


def test_a_cache_that_is_a_file_is_refused(scans, finished, tmp_path):
    arguments = (scans[0] / "pairs.csv", tmp_path / "o", *OPTIONS)
    broken = scans[0] / "broken.ply"
    environments = ({}, {"env": {**os.environ, "GEOMOE3D_CACHE": str(broken)}})
    for options, named in zip((("--cache", broken), ()), environments, strict=True):
        done = run_cli(*arguments, *options, check=2, **named)
        assert done.stderr == (
            f"error: '{broken}' is a file; the cache of features is a folder: give one, or none\n"
        )
    assert not (tmp_path / "o").exists()


def test_the_first_reason_of_a_pair_is_told(finished):
    report, folder = finished
    result = replace(report.outcomes[0].result, status="low_confidence", reasons=("what decides", "a remark"))
    told = summary(BatchReport(folder, (Outcome("ab", result, None),), 1, 0)).splitlines()[-1]
    assert told.endswith("low_confidence  what decides")


def test_without_dask_a_scheduler_says_what_to_install(scans, tmp_path, monkeypatch):
    import geomoe3d.runtime.optional as optional

    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(optional, "import_module", absent)
    with pytest.raises(DependencyError, match=r"needs Dask, which is not installed: pip install .*d"):
        register_pairs(scans[0] / "pairs.csv", tmp_path / "o", config=CONFIG, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(InputError, match="either workers or a scheduler"):
        register_pairs(
            scans[0] / "pairs.csv", tmp_path / "o", config=CONFIG, workers=1, scheduler="tcp://127.0.0.1:1"
        )
