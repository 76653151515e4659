"""Confidences of a batch: each for the share of its pairs that belong together."""

import json

import numpy as np
import pytest

from geomoe3d import register_pairs
from geomoe3d.batch.mix import share_that_belongs, shared_out
from geomoe3d.batch.run import BatchReport
from geomoe3d.batch.store import BatchStore
from geomoe3d.cli.batch import table
from geomoe3d.config import expert, load_config
from geomoe3d.data.sample import make_sample_pair


def record(name: str, confidence: float, status: str = "ok") -> dict:
    result = {"confidence": confidence, "status": status, "reasons": [], "evidence": {"overlap": 0.5}}
    return {"id": name, "fingerprint": "0", "error": None, "result": result, "seconds": {}}


def drawn(share: float, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Confidences of pairs of which so many belong together, each calibrated for the mix of the fit."""
    rng = np.random.default_rng(seed)
    fitted = expert().confidence.fitted_prior
    right = rng.random(count) < share
    evidence = rng.normal(np.where(right, 2.0, -2.0), 2.0)  # of log likelihood ratio exactly that
    return 1 / (1 + np.exp(-(evidence + np.log(fitted / (1 - fitted))))), right


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_the_share_that_belongs_together_is_found(share: float) -> None:
    confidences, right = drawn(share, 3000)
    assert share_that_belongs(confidences) == pytest.approx(right.mean(), abs=0.04)


def test_confidences_of_a_batch_hold_for_its_mix() -> None:
    confidences, right = drawn(0.15, 4000)
    records = [record(str(k), value) for k, value in enumerate(confidences)]
    found, share = shared_out(records, load_config(None, []))
    made = np.array([found[str(k)]["result"]["confidence"] for k in range(len(records))])
    assert share == pytest.approx(0.15, abs=0.03)
    for low, high in ((0.3, 0.6), (0.6, 0.9), (0.9, 1.0)):
        inside, before = ((low <= x) & (x < high) for x in (made, confidences))
        assert right[inside].mean() == pytest.approx(made[inside].mean(), abs=0.08)
        assert right[before].mean() < confidences[before].mean() - 0.2  # each alone promised too much


def test_an_ok_that_falls_below_the_limit_says_why_and_keeps_what_it_was() -> None:
    records = [record("sure", 0.9999), record("near", 0.97)] + [
        record(f"no {k}", 0.05, "low_confidence") for k in range(200)
    ]
    found, share = shared_out(records, load_config(None, []))
    assert share is not None and share < 0.15
    near, sure = found["near"]["result"], found["sure"]["result"]
    assert near["status"] == "low_confidence" and near["confidence"] < 0.7
    assert near["evidence"]["confidence_alone"] == 0.97 and near["evidence"]["overlap"] == 0.5
    assert near["reasons"][0].startswith(
        f"about {100 * share:.0f} % of the pairs of this batch belong together"
    )
    assert "(0.970 by itself), below 0.95" in near["reasons"][0]
    assert sure["status"] == "ok" and 0.95 < sure["confidence"] < 0.9999 and sure["reasons"] == []
    assert records[1]["result"]["status"] == "ok"  # the journal's own stays as it is


def test_nothing_changes_where_pairs_belong_together_or_a_prior_is_given() -> None:
    together = [record(str(k), 0.99) for k in range(40)]
    few = [record("a", 0.96), record("b", 0.99)]
    apart = [record(str(k), 0.1, "low_confidence") for k in range(40)]
    for records, settings in ((together, []), (few, []), (apart, ["decision.prior=0.3"])):
        found, share = shared_out(records, load_config(None, settings))
        assert share is None and list(found.values()) == records


def test_pairs_without_a_result_stay_as_they_are() -> None:
    broken = {"id": "x", "fingerprint": "0", "error": "no such file", "result": None, "seconds": {}}
    assert shared_out([broken], load_config(None, []))[0] == {"x": broken}
    found, share = shared_out([broken, *(record(str(k), 0.1) for k in range(40))], load_config(None, []))
    assert share is not None and found["x"] == broken


def test_results_of_a_batch_are_for_its_mix_and_its_journal_is_not(tmp_path, monkeypatch, capsys) -> None:
    source, target, _ = make_sample_pair(seed=0)
    names = []
    for name, cloud in (("source", source), ("target", target)):
        names.append(tmp_path / f"{name}.npy")
        np.save(names[-1], cloud.file_points)
    out = tmp_path / "out"
    alone = register_pairs([names], out, cache="")
    assert alone.ok and alone.share is None
    line = json.loads((out / "journal.jsonl").read_text())
    strangers = [{**line, "id": f"no {k}", "fingerprint": str(k)} for k in range(300)]
    for stranger in strangers:
        stranger["result"] = {**line["result"], "confidence": 0.02, "status": "low_confidence"}
    records = {r["id"]: r for r in [line, *strangers]}
    monkeypatch.setattr("geomoe3d.batch.run.work", lambda *given, **more: (records, len(records)))
    monkeypatch.setattr("geomoe3d.batch.run.as_rows", lambda pairs: [Row(name) for name in records])
    report = register_pairs([names], out, cache="")
    assert report.share is not None and report.share < 0.1
    kept = json.loads((out / "results.jsonl").read_text().splitlines()[0])["result"]
    assert kept["confidence"] == report.outcomes[0].confidence < line["result"]["confidence"]
    assert kept["evidence"]["confidence_alone"] == line["result"]["confidence"]
    assert (out / "results.csv").read_text().splitlines()[1].split(",")[1] == report.outcomes[0].status
    assert json.loads((out / "journal.jsonl").read_text()) == line
    said = table(report)
    assert f"About {100 * report.share:.0f} % of these pairs seem to belong together" in said


class Row:
    """What `register_pairs` asks of a row where nothing is left to do."""

    def __init__(self, name: str) -> None:
        self.id = name


def test_the_table_says_nothing_of_a_mix_that_changed_nothing(tmp_path) -> None:
    report = BatchReport(
        tmp_path,
        (
            BatchStore(tmp_path / "b", load_config(None, [])).outcome(
                {"id": "x", "error": "no such file", "result": None}
            ),
        ),
        1,
        0,
    )
    assert "belong together" not in table(report)


def test_ids_made_of_long_paths_are_shown_as_names_of_files(tmp_path) -> None:
    store = BatchStore(tmp_path / "b", load_config(None, []))
    folder = "/somewhere/far/down/in/a/tree/of/folders/with/long/names"
    made = {"id": f"{folder}/a.ply+{folder}/b.ply", "error": "no such file", "result": None}
    said = table(BatchReport(tmp_path, (store.outcome(made), store.outcome({**made, "id": "mine"})), 2, 0))
    assert "  a.ply+b.ply  0.00  error           no such file" in said
    assert "  mine         0.00" in said
