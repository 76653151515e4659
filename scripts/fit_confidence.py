"""Fits the confidence: P(the answer is right) as a logistic function of what the clouds say of it.

    python scripts/fit_confidence.py FOLDER... [--pairs 500] [--unrelated 250] [--set scoring.scorers=[surfaces]]
        [--set preparation.viewpoint=centroid] [--second-look | --repeat] [--out runs/confidence.jsonl]

FOLDER: posed fragments that are not those of a benchmark, nor of the network's training (generated rooms,
recordings of one's own). Pairs are drawn by overlap as the two benchmarks mix them, unrelated ones from
different scenes and, every second, from far parts of one. Every pair is registered twice, without a second
look and always with one, since the confidence decides about it; the outcomes go to OUT, and what is there is
not done again: give another OUT for other weights or code. Prints coefficients for
`geomoe3d/decision/confidence.py`, cross-validated over scenes. With --second-look every pair is registered as users
do, twice as many pairs of little overlap are drawn, and the fit is that of answers which the surface network was asked
about: of what the fit of the evidence says and of the network's margin. With --repeat it is that of answers which came
out again on a shifted grid, of the mean of both logits. Needs scikit-learn, which the package itself
does not.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.config import expert, load_config
from geomoe3d.data.collection import PosedPair, load_fragment, open_collection
from geomoe3d.decision.confidence import (
    CONFIDENCE_INPUTS,
    confidence_inputs,
    confidence_score,
    margin_inputs,
)
from geomoe3d.decision.information import Information
from geomoe3d.decision.repeat import logit
from geomoe3d.evaluation.calibration import calibration_error_of
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.geometry.se3 import inverse
from geomoe3d.registration import Registrar
from geomoe3d.result import RegistrationResult
from geomoe3d.scoring.surfaces import Evidence
from geomoe3d.types import FloatArray

BANDS = ((0.10, 0.30, 1044), (0.30, 0.60, 420), (0.60, 1.01, 423))
"""Overlap from, to, and share: 3DLoMatch's pairs, and 3DMatch's halved at 60 %."""
UNRELATED_WEIGHT = 0.25
ONCE = "second_look.repeat_below=0"
LOOKS = (
    ["second_look.descriptor=none", "second_look.grids=[]", "second_look.max_correspondences=0", ONCE],
    ["second_look.below=1.0", "decision.min_confidence=1.0", ONCE],
)
"""Settings by which a pair gets one look, and always two."""
AS_USERS_DO: tuple[list[str], ...] = ([ONCE],)
"""The same for --second-look: a second look where the first one is in doubt."""
REPEATED: tuple[list[str], ...] = (["second_look.repeat_below=0.985"],)
"""The same for --repeat: twice from the start where the answer is not sure."""
LOW_BANDS = ((0.10, 0.30, 3), (0.30, 1.01, 1))
"""Overlap from, to, and share of the pairs for --second-look."""
REPEAT_NAMES = ("confidence_first", "confidence_second", "answers_agree")
Drawn = tuple[str, str, str, list[Any] | None, bool]


def draw(
    folders: list[str], count: int, unrelated: int, bands: tuple[tuple[float, float, int], ...] = BANDS
) -> list[Drawn]:
    """(scene, source, target, true motion or None, whether related), the same for the same folders and counts.

    Of the unrelated ones every second is of one scene, two fragments that no list says to overlap: furniture that
    stands twice and walls at right angles imitate each other more than two buildings do.
    """
    rng = np.random.default_rng(0)
    by_scene: dict[str, list[PosedPair]] = {}
    for folder in folders:
        for pair in open_collection(folder).pairs:
            by_scene.setdefault(f"{folder}/{pair.scene}", []).append(pair)
    everything = [(scene, pair) for scene, pairs in sorted(by_scene.items()) for pair in pairs]
    total = sum(share for _, _, share in bands)
    chosen: list[Drawn] = []
    for low, high, share in bands:
        band = [e for e in everything if e[1].overlap is not None and low <= e[1].overlap < high]
        for k in rng.permutation(len(band))[: round(count * share / total)]:
            scene, pair = band[k]
            chosen.append((scene, str(pair.source), str(pair.target), pair.T_target_source.tolist(), True))
    names = sorted(by_scene)
    apart = [pair for scene in names for pair in unlisted(scene, by_scene[scene])]
    for k in rng.permutation(len(apart))[: unrelated // 2]:
        chosen.append((*apart[k], False))
    for _ in range(unrelated - unrelated // 2):
        a, b = rng.choice(len(names), 2, replace=False)
        source, target = (by_scene[names[k]][rng.integers(len(by_scene[names[k]]))].source for k in (a, b))
        chosen.append((f"{names[a]} {names[b]}", str(source), str(target), None, False))
    return [chosen[k] for k in rng.permutation(len(chosen))]


def unlisted(scene: str, pairs: list[PosedPair]) -> list[tuple[str, str, str, list[Any]]]:
    """(scene, source, target, true motion) of every two fragments of a scene that no list says to overlap, as far as
    the lists lead from one to the other. They may share a little all the same, and be registered rightly."""
    poses = {pairs[0].source: np.eye(4)}
    for _ in pairs:
        for pair in pairs:
            if pair.target in poses:
                poses.setdefault(pair.source, poses[pair.target] @ pair.T_target_source)
            elif pair.source in poses:
                poses[pair.target] = poses[pair.source] @ inverse(pair.T_target_source)
    listed = {frozenset((pair.source, pair.target)) for pair in pairs}
    return [
        (scene, str(a), str(b), (inverse(poses[b]) @ poses[a]).tolist())
        for a, b in combinations(sorted(poses), 2)
        if frozenset((a, b)) not in listed
    ]


def measure(
    pairs: list[Drawn], out: Path, assignments: list[str], looks: tuple[list[str], ...] = LOOKS
) -> list[dict[str, Any]]:
    """One record per pair and look; those in the file are kept."""
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = out.read_text().splitlines() if out.exists() else []
    known = {
        (r["source"], r["target"], r["look"]): r
        for r in map(json.loads, lines)
        if r["assignments"] == assignments and "looseness" in r  # not of an earlier version
    }
    registrars = [Registrar(load_config(None, [*assignments, *look])) for look in looks]
    with out.open("a") as file:
        for number, (scene, source, target, T, related) in enumerate(pairs):
            for look, registrar in enumerate(registrars):
                if (source, target, look) in known:
                    continue
                result = registrar.register(load_fragment(Path(source)), load_fragment(Path(target)))
                found = result.T_target_source
                right = T is not None and is_right(*motion_errors(found, np.array(T)))
                names = [f.name for f in fields(Evidence) if f.name in result.evidence]
                record = {
                    "scene": scene,
                    "source": source,
                    "target": target,
                    "look": look,
                    "assignments": assignments,
                    "related": related,
                    "right": right,
                    "status": result.status,
                    "lead": lead_of(result),
                    "margin": result.evidence.get("margin"),
                    "repeat": [result.evidence.get(name) for name in REPEAT_NAMES],
                    "heard": "verdict" in result.evidence,
                    "support": result.num_inliers / max(result.num_correspondences, 1),
                    "observability": result.evidence.get("observability", 0.0),
                    "looseness": result.evidence.get("looseness", 1000.0),
                    "evidence": {name: result.evidence[name] for name in names} if result.evidence else None,
                }
                known[(source, target, look)] = record
                file.write(json.dumps(record) + "\n")
                file.flush()
                if number % 25 == 0:
                    print(f"{number} of {len(pairs)}", flush=True)
    return [known[(source, target, look)] for _, source, target, *_ in pairs for look in range(len(looks))]


def lead_of(result: RegistrationResult) -> float:
    """The answer's lead, as the judge saw it."""
    if result.alternative is None:
        return expert().confidence.unrivalled_lead
    score = result.alternative.relative_score
    return 1 / score if score > 0 else float("inf")


def held(record: dict[str, Any]) -> Information:
    """What a record says of how firmly the answer is held."""
    unknown = np.full((6, 6), np.nan)
    return Information(unknown, unknown[0, :3], record["observability"], 0, record["looseness"])


def inputs_of(record: dict[str, Any], fit: str) -> FloatArray:
    """(7,), (2,) or (1,) what the fit is a function of."""
    if fit == "repeat":
        return np.array([np.mean([logit(confidence) for confidence in record["repeat"][:2]])])
    evidence, lead, support = Evidence(**record["evidence"]), record["lead"], record["support"]
    if fit == "evidence":
        return confidence_inputs(evidence, lead, support, held(record))
    said = confidence_score(evidence, lead, support, held(record), heard=record["heard"])
    return margin_inputs(float(np.log(said) - np.log1p(-said)), record["margin"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", nargs="+")
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--unrelated", type=int, default=250)
    parser.add_argument("--set", dest="assignments", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", default="runs/confidence.jsonl")
    parser.add_argument("--second-look", action="store_true", help="the fit of answers of a second look")
    parser.add_argument("--repeat", action="store_true", help="the fit of answers that came out twice")
    parser.add_argument("--measured", action="store_true", help="fit on what OUT holds; register nothing")
    given = parser.parse_args()
    fit = "second_look" if given.second_look else "repeat" if given.repeat else "evidence"
    looks = {"evidence": LOOKS, "second_look": AS_USERS_DO, "repeat": REPEATED}[fit]
    bands = BANDS if fit == "evidence" else LOW_BANDS
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import log_loss, roc_auc_score
    from sklearn.model_selection import GroupKFold, cross_val_predict
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    if given.measured:
        records = [json.loads(line) for line in Path(given.out).read_text().splitlines()]
        records = [r for r in records if r["assignments"] == given.assignments and "looseness" in r]
    else:
        pairs = draw(given.folders, given.pairs, given.unrelated, bands)
        records = measure(pairs, Path(given.out), given.assignments, looks)
    records = [r for r in records if r["evidence"] is not None]
    if given.second_look:
        records = [r for r in records if r["margin"] is not None]
    if fit == "repeat":
        records = [r for r in records if r["repeat"][2]]
    X = np.array([inputs_of(r, fit) for r in records])
    y = np.array([r["right"] for r in records])
    related = np.array([r["related"] for r in records])
    weight = np.where(related, 1.0, UNRELATED_WEIGHT)
    print(f"{related.sum()} related pairs, {y[related].mean():.1%} right; {(~related).sum()} unrelated")
    # On inputs of equal spread the penalty is the same for each. It matters: fitted almost without one, the
    # coefficients follow the generated rooms too closely.
    model = make_pipeline(StandardScaler(), LogisticRegression())
    p = cross_val_predict(
        model,
        X,
        y,
        groups=[r["scene"] for r in records],
        cv=GroupKFold(5),
        method="predict_proba",
        params={"logisticregression__sample_weight": weight},
    )[:, 1]
    print(
        f"log loss {log_loss(y[related], p[related]):.4f}, AUROC {roc_auc_score(y[related], p[related]):.4f}"
    )
    error = calibration_error_of(p[related], y[related])(np.ones((1, related.sum())))[0]
    print(f"calibration error {error:.4f}")
    for least in (0.8, 0.85, 0.9, 0.95, 0.97):
        above = related & (p > least)
        print(
            f"above {least}: {above.sum() / related.sum():.1%} of the related, {y[above].mean():.2%} right; "
            f"{(p[~related] > least).mean():.2%} of the unrelated"
        )
    model.fit(X, y, logisticregression__sample_weight=weight)
    scaler, logistic = model[0], model[1]
    slopes = logistic.coef_[0] / scaler.scale_
    offset = float(logistic.intercept_[0] - slopes @ scaler.mean_)
    names = {"evidence": CONFIDENCE_INPUTS, "second_look": ("evidence", "margin"), "repeat": ("mean",)}[fit]
    print(f"{', '.join(names)}: {np.round(slopes, 3).tolist()}")
    print(f"offset: {offset:.3f}")


if __name__ == "__main__":
    main()
