"""The gallery of failures: the worst first, both clouds under both motions, turned in a browser."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from headless_browser import HAND, browse, check_card_without_ink, check_hand, turned_by_hand
from report_runs import NASTY, Document, report
from scipy.spatial.transform import Rotation

from geomoe3d.evaluation import report_page
from geomoe3d.evaluation.records import Measure, PairScore
from geomoe3d.evaluation.report_page import choose_run, make_card, worst_failures
from geomoe3d.geometry.se3 import transform_points


def score_of(pair: str, **changes: object) -> PairScore:
    values = dict.fromkeys(PairScore.__dataclass_fields__)
    values |= {"pair": pair, "scene": "s", "right": False, "right_20": False, "any_right": False}
    values |= {"rotation_error_deg": 90.0, "translation_error": 2.0, "seconds": 1.0, "stages": {}}
    return PairScore(**{**values, **changes})


def test_worst_failures_first(two_runs):
    scores = (
        score_of("right", confidence=1.0, overlap=0.9, right=True),
        score_of("silent", overlap=0.8),
        score_of("doubtful", confidence=0.2, overlap=0.9),
        score_of("sure, little overlap", confidence=0.9, overlap=0.1),
        score_of("sure, much overlap", confidence=0.9, overlap=0.5),
        score_of("not a number", confidence=math.nan, overlap=math.nan),
    )
    score = replace(two_runs[0][0], pairs=scores)
    order = [failure.pair for failure in worst_failures(score, 99)]
    assert order == ["sure, much overlap", "sure, little overlap", "doubtful", "silent", "not a number"]
    assert [failure.pair for failure in worst_failures(score, 2)] == order[:2]


def test_run_of_the_gallery(two_runs):
    confident, mute = two_runs[0][0], two_runs[1][0]
    assert choose_run([]) is None
    assert choose_run([mute, confident]) is confident
    best = Measure(99.0, "%", 12, (98.0, 100.0), (math.nan, math.nan))
    better = replace(mute, measures={**mute.measures, "recall_15": best})
    assert choose_run([mute, better]) is better
    unknown = replace(mute, measures={})
    assert choose_run([unknown, mute]) is mute


def unpack(cloud: dict) -> np.ndarray:
    levels = np.frombuffer(base64.b64decode(cloud["points"]), dtype="<i2").reshape(-1, 3)
    return levels * cloud["scale"]


def test_card_shows_both_clouds_under_both_motions(two_runs):
    score, pairs, predictions = two_runs[0]
    failure = next(p for p in score.pairs if p.pair == pairs[3].id)
    card = make_card(5, failure, pairs[3], predictions[3], 2000)
    clouds = card.clouds
    source, target = unpack(clouds["source"]), unpack(clouds["target"])
    assert 1500 < len(source) <= 2000
    assert 1500 < len(target) <= 2000
    truth, estimate = (np.reshape(clouds["motions"][name], (4, 4)) for name in ("truth", "estimate"))
    moved = transform_points(truth, source)  # the floor of the room: both lie on it, centred alike
    assert np.abs(moved[:, 2].min() - target[:, 2].min()) < 0.005
    assert np.abs(np.percentile(moved[:, 1], [0, 100]) - np.percentile(target[:, 1], [0, 100])).max() < 0.005
    assert np.abs(moved[:, 0].min() + 1.5 - target[:, 0].min()) < 0.01
    turned = Rotation.from_matrix(estimate[:3, :3] @ truth[:3, :3].T).magnitude()
    assert abs(math.degrees(turned) - 40.0) < 1e-3
    for name, T in (("truth", truth), ("estimate", estimate)):
        fit = clouds["fits"][name]
        shown = np.concatenate([target, transform_points(T, source)])
        inside = np.linalg.norm(shown - fit["center"], axis=1) <= fit["radius"] * 1.001
        assert 0.97 < inside.mean() < 1.0
    axes = np.array(clouds["axes"])
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-5)
    for word in ("40.0°", "45.0%", "0.80", "16.0%", "ok", pairs[3].id):
        assert word in [card.name, *(value for _, value in card.facts)]
    json.dumps(clouds, allow_nan=False)


def test_card_without_an_answer(two_runs):
    score, pairs, predictions = two_runs[0]
    card = make_card(0, score.pairs[11], pairs[11], predictions[11], 500)
    assert card.clouds["motions"].keys() == {"truth"}
    assert {"no answer", NASTY} <= {value for _, value in card.facts}
    alone = replace(pairs[11], T_target_source=None)
    assert make_card(0, score.pairs[11], alone, predictions[11], 500).clouds is None
    assert make_card(0, score.pairs[11], pairs[11], None, 500).clouds is not None


def test_many_failures_share_the_points(two_runs, monkeypatch):
    monkeypatch.setattr("geomoe3d.evaluation.report_page.MAX_TOTAL_POINTS", 5000)
    data = Document(report(two_runs[0], num_failures=5)).data
    assert len(data) == 5
    assert (
        3500 < sum(len(unpack(card[name])) for card in data.values() for name in ("source", "target")) <= 5000
    )
    assert report_page.MAX_TOTAL_POINTS * 8 < 4e6


# ---------------------------------------------------------------- in a browser
USE = r"""
(async () => {
  const body = document.body, log = {};
  const note = async (name) => { await settle(); log[name] = { ...body.dataset }; };
  await note("start");
  const card = document.querySelector("#card-0"), stage = card.querySelector(".stage");
  const { key, pointer } = handOn(stage);
  pointer("down", 1, 100); pointer("move", 1, 150); pointer("up", 1, 150); await note("turned");
  key("+"); await note("zoomed");
  card.querySelector('input[value="truth"]').click(); await note("truth");
  card.querySelector('[data-side="top"]').click(); await note("top");
  const pixels = stage.querySelector("canvas").getContext("2d").getImageData(0, 0, 300, 200).data;
  const tint = (_, i) => pixels.slice(4 * i, 4 * i + 3).join();
  log.tints = new Set(Array.from({ length: pixels.length / 4 }, tint)).size;
  const marks = [...document.querySelectorAll("#group-0 figure .r0")];
  const shown = () => marks.filter((mark) => mark.getClientRects().length).length;
  log.shown = [shown()];
  document.querySelector('button[data-run="0"]').click(); log.shown.push(shown());
  document.querySelector('button[data-run="0"]').click(); log.shown.push(shown());
  body.dataset.log = JSON.stringify(log);
})();
"""


@pytest.mark.parametrize("webgl", [True, False])
def test_gallery_turns_in_a_browser(two_runs, tmp_path, webgl):
    text = report(*two_runs, num_failures=2)
    found = browse(tmp_path, text, script=HAND + USE, webgl=webgl, window="500,700")
    assert "error" not in found
    assert (found["ready"], found["cards"], found["drawn"]) == ("true", "2", "2")
    assert found["renderer"] == ("webgl2" if webgl else "canvas2d")
    assert 0.02 < float(found["covered"]) < 0.9
    log = json.loads(found["log"])
    state = {name: entry["first"].split() for name, entry in log.items() if isinstance(entry, dict)}
    assert [state[name][0] for name in ("start", "zoomed", "truth")] == ["estimate", "estimate", "truth"]
    assert float(state["turned"][1]) == pytest.approx(float(state["start"][1]) - 50 * 0.009, abs=1e-3)
    assert float(state["zoomed"][3]) == pytest.approx(0.87 * float(state["turned"][3]), rel=1e-3)
    assert float(state["top"][2]) == pytest.approx(math.pi / 2, abs=1e-3)
    assert log["tints"] > 10
    assert log["shown"][0] > 5
    assert log["shown"] == [log["shown"][0], 0, log["shown"][0]]


@pytest.mark.parametrize("webgl", [True, False])
def test_gallery_obeys_the_hand(two_runs, tmp_path, webgl):
    text = report(*two_runs, num_failures=2)
    card = Document(text).data["0"]
    radius = card["fits"]["estimate"]["radius"]
    views = turned_by_hand(tmp_path, text, webgl=webgl)["views"]
    # Digits are the page's own, and so is the wheel until a view is chosen.
    own = {"digits": False, "wheel_always": False}
    check_hand(views, card["axes"], radius, pitch=0.5, per_pixel=0.009, limits=(0.05, 20.0), **own)


def test_gallery_draws_without_a_card_that_draws_nothing(two_runs, tmp_path):
    check_card_without_ink(tmp_path, report(*two_runs, num_failures=2))
