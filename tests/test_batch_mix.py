"""Confidences of a batch: each for the share of its pairs that belong together."""

import json

import numpy as np
import pytest

from geomoe3d import RegistrationResult, register_pairs
from geomoe3d.batch.mix import share_that_belongs, shared_out
from geomoe3d.batch.run import BatchReport
from geomoe3d.batch.store import BatchStore
from geomoe3d.cli.batch import table
from geomoe3d.config import expert, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.scale import UNITS_DIFFER
from geomoe3d.runtime.words import of_all


def record(name: str, confidence: float, status: str = "ok") -> dict:
    result = {"confidence": confidence, "status": status, "reasons": ["a note"], "evidence": {"overlap": 0.5}}
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
        f"only {of_all(share)} of the pairs of this batch seem to belong together"
    )
    assert near["reasons"][1:] == ["a note"]  # the cause comes first
    assert "(0.970 by itself), below 0.95" in near["reasons"][0]
    assert sure["status"] == "ok" and 0.95 < sure["confidence"] < 0.9999 and sure["reasons"] == ["a note"]
    assert records[1]["result"]["status"] == "ok"  # the journal's own stays as it is


def test_what_a_rule_held_down_says_nothing_of_the_mix() -> None:
    """Corridors, copies of rooms and clouds in other units belong together for all that is known of them."""
    together = [record(str(k), 0.97) for k in range(4)]
    limits = expert().confidence
    slid = [record(f"slid {k}", limits.most_sliding, "ambiguous") for k in range(60)]
    like = [record(f"like {k}", limits.most_doubted, "ambiguous") for k in range(60)]
    twice = [record(f"twice {k}", 0.23, "ambiguous") for k in range(60)]  # of two answers that were held down
    feet = [record(f"feet {k}", 0.0, "failed") for k in range(60)]
    for line in twice:
        line["result"]["evidence"] |= {"confidence_first": limits.most_sliding, "confidence_second": 0.2}
    for line in feet:
        line["result"] |= {"reasons": [f"{UNITS_DIFFER}: lengths in 'a' are 3.281 times"], "evidence": {}}
    for held in (slid, like, twice, feet):
        found, share = shared_out([*together, *held], load_config(None, []))
        assert share is None and found["0"]["result"]["status"] == "ok"
    # Beside pairs that do not belong together they are less sure, too.
    strangers = [record(f"no {k}", 0.02, "low_confidence") for k in range(60)]
    found, share = shared_out([*together, *slid, *strangers], load_config(None, []))
    alone, _ = shared_out([*together, *strangers], load_config(None, []))
    assert share is not None and found["0"] == alone["0"] and found["0"]["result"]["status"] != "ok"
    assert found["slid 0"]["result"]["confidence"] < limits.most_sliding


def test_nothing_changes_where_pairs_belong_together_or_a_prior_is_given() -> None:
    together = [record(str(k), 0.99) for k in range(40)]
    few = [record("a", 0.96), record("b", 0.99)]
    apart = [record(str(k), 0.1, "low_confidence") for k in range(40)]
    cases = ((together, []), (few, []), (apart[:1], []), (apart, ["decision.prior=0.3"]))
    for records, settings in cases:
        found, share = shared_out(records, load_config(None, settings))
        assert share is None and list(found.values()) == records


def test_the_order_in_which_pairs_were_finished_changes_no_digit() -> None:
    confidences, _ = drawn(0.3, 300)
    records = [record(str(k), value) for k, value in enumerate(confidences)]
    expected = shared_out(records, load_config(None, []))
    for seed in range(10):
        order = np.random.default_rng(seed).permutation(len(records))
        assert shared_out([records[k] for k in order], load_config(None, [])) == expected


def test_the_share_that_is_said_is_that_of_the_pairs_themselves() -> None:
    """Those of the usual mix that are counted in are not theirs."""
    records = [record(str(k), 0.001, "low_confidence") for k in range(5)]
    _, share = shared_out(records, load_config(None, []))
    assert share is not None and of_all(share) == "under 1 %" and of_all(0.014) == "about 1 %"


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
    assert (
        f"Only {of_all(report.share)} of these pairs seem to belong together, where nine in ten are usual"
        in said
    )
    whole = RegistrationResult.from_json(report.outcomes[0].result.to_json())
    assert whole.evidence == kept["evidence"] and whole.confidence == kept["confidence"]


def test_transforms_and_pages_that_are_there_follow_the_mix_of_a_later_call(tmp_path) -> None:
    """A pair's status and confidence are the same in all that the folder holds, whatever the call asked for."""
    source, target, _ = make_sample_pair(seed=0)
    rng = np.random.default_rng(0)
    clouds = {"source": source.file_points, "target": target.file_points}
    clouds |= {f"noise{k}": rng.random((40, 3)) for k in range(4)}
    for name, points in clouds.items():
        np.save(tmp_path / f"{name}.npy", points)
    table_of_pairs, out = tmp_path / "pairs.csv", tmp_path / "out"
    table_of_pairs.write_text("id,source,target\nit,source.npy,target.npy\n")
    assert register_pairs(table_of_pairs, out, cache="", transforms=True, page=True, pages=True).share is None
    before = (out / "transforms" / "it.txt").read_text()
    with table_of_pairs.open("a") as stream:
        stream.writelines(f"no{k},noise{k}.npy,target.npy\n" for k in range(4))
    report = register_pairs(table_of_pairs, out, cache="")
    assert report.share is not None and report.kept == 1
    now = report.outcomes[0]
    written = (out / "transforms" / "it.txt").read_text()
    assert written != before and f"# status {now.status}, confidence {now.confidence:.4f}" in written
    assert f'data-confidence="{now.confidence!r}"' in (out / "page.html").read_text()
    assert repr(now.confidence) in (out / "results.csv").read_text()
    assert f"confidence {now.confidence:.2f}" in (out / "pages" / "it.html").read_text()
    register_pairs([(tmp_path / "noise0.npy", tmp_path / "target.npy")], out, cache="", fresh=True)
    assert not (out / "transforms").exists() and not (out / "pages").exists()


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
