"""A real scheduler with two workers on the loopback; one of them is killed in the middle."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from small_scans import SETTINGS, cut, scene

from geomoe3d import register_pairs
from geomoe3d.batch.folder import JOURNAL_FILE, RESULTS_FILE
from geomoe3d.config import load_config
from geomoe3d.errors import DependencyError, InputError
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.workers import DaskPool

pytest.importorskip("distributed", reason="Dask is not installed: pip install dask distributed")

CONFIG = load_config(None, SETTINGS)
ROOT = Path(__file__).parents[1]


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a scheduler and the process ids of its two workers."""
    folder = tmp_path_factory.mktemp("dask")
    environment = {
        **os.environ,
        "GEOMOE3D_CACHE": str(folder / "cache"),
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    address = f"tcp://127.0.0.1:{free_port()}"
    start = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard"]
    commands = [[*start, "--port", address.rsplit(":", 1)[1]]]
    for _ in range(2):
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-nanny"]
        commands.append([*worker, "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard"])
    log = (folder / "log").open("w")
    processes = [
        subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=folder) for command in commands
    ]
    try:
        from distributed import Client

        with Client(address, timeout=60) as client:
            client.wait_for_workers(2, timeout=120)
        yield address, [process.pid for process in processes[1:]]
    finally:
        for process in processes:
            process.kill()
            process.wait()
        log.close()


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    points = scene()
    for number, (name, low, high) in enumerate((("a", 0.0, 3.0), ("b", 0.8, 3.6), ("c", 0.4, 3.2))):
        np.save(folder / f"{name}.npy", cut(points, low, high, seed=number)[0])
    pairs = [(s, t) for s in "abc" for t in "abc" if s != t]
    lines = [f"{k}-{s}{t},{s}.npy,{t}.npy" for k in range(3) for s, t in pairs]
    (folder / "pairs.csv").write_text("\n".join(["id,source,target", *lines, "bad,a.npy,none.npy"]) + "\n")
    return folder / "pairs.csv"


def test_a_worker_killed_in_the_middle_costs_nothing_and_the_bytes_are_those_of_one_process(
    cluster, table, tmp_path
):
    address, workers = cluster
    alone = register_pairs(table, tmp_path / "alone", config=CONFIG, cache=str(tmp_path / "cache"))
    journal = tmp_path / "dask" / JOURNAL_FILE
    killed_at = []

    def kill_one():
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            done = journal.read_bytes().count(b"\n") if journal.exists() else 0
            if done >= 4:
                os.kill(workers[0], signal.SIGKILL)
                killed_at.append(done)
                return
            time.sleep(0.02)

    said: list[str] = []
    killer = threading.Thread(target=kill_one)
    killer.start()
    report = register_pairs(table, tmp_path / "dask", config=CONFIG, scheduler=address, say=said.append)
    killer.join()
    assert killed_at, "the batch was over before the kill"
    assert killed_at[0] < 19
    assert said[0].startswith("2 workers of the scheduler")
    assert report.made == 19
    assert sorted(r["id"] for r in read_journal(journal)) == sorted(o.id for o in report.outcomes)
    assert (tmp_path / "dask" / RESULTS_FILE).read_bytes() == (tmp_path / "alone" / RESULTS_FILE).read_bytes()
    assert report.counts() == alone.counts()


def test_workers_of_other_versions_are_refused_before_anything_is_removed(
    cluster, table, tmp_path, monkeypatch
):
    (table.parent / "one.csv").write_text("source,target\na.npy,b.npy\n")
    register_pairs(table.parent / "one.csv", tmp_path, config=CONFIG, cache="")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr("geomoe3d.batch.task.library_versions", lambda: {"numpy": "0"})
    with pytest.raises(DependencyError, match="a worker runs other versions"):
        register_pairs(table.parent / "one.csv", tmp_path, config=CONFIG, scheduler=cluster[0], fresh=True)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_scheduler_that_is_not_there_is_named():
    with pytest.raises(InputError, match="no Dask scheduler answers at 'tcp://127"):
        DaskPool(f"tcp://127.0.0.1:{free_port()}", wait_seconds=1.0)
