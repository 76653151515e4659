"""The measures of one pair: a stored answer against the truth, nothing else.

Pure functions, to be run again over the same predictions whenever a measure changes. Errors are those of
PointDSC (rotation and translation error), the RMSE is that of the benchmark's gt.info. Place: between the
records and the summaries of whole runs. Cost: about 0.2 ms per pair with 1,000 correspondences.
"""

from __future__ import annotations

import math

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.records import EvaluationPair, Labels, PairScore, Prediction
from geomoe3d.geometry.se3 import is_motion, project_to_so3, rotation_error_deg, translation_error
from geomoe3d.types import BoolArray, FloatArray

_Triple = tuple[float, float, float] | tuple[None, None, None]


def score_pair(pair: EvaluationPair, prediction: Prediction, *, raw_truth: bool = False) -> PairScore:
    """The measures of one pair from its stored answer.

    The published rotations of redkitchen are not orthonormal (entries off by up to 5e-4, determinant 0.9993
    to 1.0005). Put into PointDSC's formula, acos((trace - 1) / 2), they give even a perfect answer a
    rotation error of up to 1.4 degrees. So the truth here is the nearest rotation, and the
    error comes from a formula that is accurate near 0 and near 180 degrees. ``raw_truth`` takes both as
    PointDSC does, for comparison with published tables; recall hardly changes, rotation errors do.

    Args:
        pair: the two scans and their true relation.
        prediction: the answer to the same pair.
        raw_truth: True takes the truth as published (`EvaluationPair.raw_T_target_source`, where it has one)
            and the rotation error from the clamped arc cosine of the trace.

    Returns:
        Errors are infinite where there is no motion: none given, one with a NaN, or a matrix that is no rigid
        motion (rotation off by more than 0.01). Without a truth (unrelated scans) whatever needs one is None
        and nothing is right. An error equal to its limit within 1e-9 is not below it.

    Raises:
        InputError: the prediction is of another pair.
    """
    if prediction.pair != pair.id:
        raise InputError(f"the prediction is of pair '{prediction.pair}', not of '{pair.id}'")
    rotation: float | None = None
    translation: float | None = None
    rmse: float | None = None
    right = right_20 = any_right = False
    truth = pair.T_target_source
    if raw_truth and pair.raw_T_target_source is not None:
        truth = pair.raw_T_target_source
    labels = prediction.labels
    kept: _Triple = (None, None, None)
    verified = kept
    if truth is not None:
        rotation, translation = motion_errors(prediction.T_target_source, truth, raw=raw_truth)
        right = is_right(rotation, translation)
        right_20 = is_right(rotation, translation, RULES.rotation_limit_20_deg)
        any_right = right or any(
            is_right(*motion_errors(T, truth, raw=raw_truth)) for T in prediction.hypotheses
        )
        if pair.information is not None and not pair.consecutive:
            rmse = benchmark_rmse(prediction.T_target_source, truth, pair.information)
        if labels is not None:
            kept = precision_recall_f1(labels.kept, labels.true) if labels.kept is not None else kept
            verified = precision_recall_f1(labels.verified, labels.true)
    confidence = prediction.confidence
    return PairScore(
        pair=pair.id,
        scene=pair.scene,
        overlap=pair.overlap,
        inlier_ratio=None if labels is None or truth is None else inlier_ratio(labels),
        rotation_error_deg=rotation,
        translation_error=translation,
        right=right,
        right_20=right_20,
        rmse=rmse,
        any_right=any_right,
        precision=kept[0],
        recall=kept[1],
        f1=kept[2],
        verified_precision=verified[0],
        verified_recall=verified[1],
        verified_f1=verified[2],
        confidence=None if confidence is None or math.isnan(confidence) else float(confidence),
        status=prediction.status,
        seconds=prediction.seconds,
        stages=dict(prediction.stages),
        peak_memory=prediction.peak_memory,
        error=prediction.error,
    )


def has_motion(T: FloatArray | None) -> bool:
    """Whether an answer (4, 4) is a rigid motion: finite, last row 0 0 0 1, rotation within 0.01 of SO(3)."""
    return T is not None and is_motion(T, 1e-2)


def motion_errors(T: FloatArray | None, T_truth: FloatArray, *, raw: bool = False) -> tuple[float, float]:
    """Rotation error in degrees and translation error in metres of an answer.

    Args:
        T: (4, 4) estimated T_target_source, or None.
        T_truth: (4, 4) true T_target_source.
        raw: PointDSC's acos of the clamped trace, which does not forgive a rotation that is none.

    Returns:
        (inf, inf) where there is no motion, see `has_motion`.
    """
    if T is None or not has_motion(T):
        return math.inf, math.inf
    if raw:
        cosine = (float(np.trace(T[:3, :3].T @ T_truth[:3, :3])) - 1.0) / 2.0
        rotation = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    else:
        rotation = rotation_error_deg(T, T_truth)
    return rotation, translation_error(T, T_truth)


def is_right(
    rotation_error: float, translation_error: float, rotation_limit: float = RULES.rotation_limit_deg
) -> bool:
    """Whether both errors (degrees, metres) are below their limits; one equal to its limit is not.

    Errors are compared after rounding to 1e-9, so that a last bit does not decide.
    """
    return (
        round(rotation_error, 9) < rotation_limit and round(translation_error, 9) < RULES.translation_limit
        if math.isfinite(rotation_error) and math.isfinite(translation_error)
        else False
    )


def benchmark_rmse(T: FloatArray | None, T_truth: FloatArray, information: FloatArray) -> float | None:
    """The error of the 3DMatch benchmark in metres: sqrt(e^T I e / I_11).

    gt.info goes with motions from fragment j (here the target) into fragment i (the source), so it is the
    inverse of our motion that it weighs: with X = T_source_target, Delta = X_true^-1 X_estimated =
    T_target_source,true T_target_source,estimated^-1, and e = (t_Delta, q_xyz), q the unit quaternion of
    R_Delta with non-negative real part.

    It is not quite a root mean square of displacements: with I = sum G^T G, G = [1, -[x]x], a rotation
    vector would belong in e, and q_xyz is half of one. A pure rotation counts exactly half of the true value
    at every angle. Kept as it is, because published recalls are made so.

    Args:
        T: (4, 4) estimated T_target_source, or None.
        T_truth: (4, 4) true T_target_source; its rotation need not be orthonormal.
        information: (6, 6) of gt.info.

    Returns:
        inf where there is no motion; None where the matrix weighs no point (I_11 not above 0 or not finite).
    """
    from scipy.spatial.transform import Rotation

    if not np.isfinite(information).all() or information[0, 0] <= 0:
        return None
    if T is None or not has_motion(T):
        return math.inf
    delta = T_truth @ np.linalg.inv(T)
    # The nearest rotation first: what scipy takes of a matrix that is none depends on its version.
    turn = Rotation.from_matrix(project_to_so3(delta[:3, :3])).as_quat(canonical=True)
    error = np.concatenate([delta[:3, 3], turn[:3]])
    squared = float(error @ information @ error) / float(information[0, 0])
    return math.sqrt(max(squared, 0.0))


def precision_recall_f1(labels: BoolArray, truth: BoolArray) -> tuple[float, float, float]:
    """Precision, recall and their harmonic mean in [0, 1] of a labelling (N,); 0 where undefined."""
    both = int(np.count_nonzero(labels & truth))
    if both == 0:
        return 0.0, 0.0, 0.0
    kept, true = int(np.count_nonzero(labels)), int(np.count_nonzero(truth))
    return both / kept, both / true, 2.0 * both / (kept + true)


def inlier_ratio(labels: Labels) -> float:
    """Share of true correspondences in [0, 1]; 0 where there are none at all."""
    return float(np.mean(labels.true)) if labels.true.size else 0.0
