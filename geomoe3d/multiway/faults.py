"""What is wrong with a scan as a whole: mirrored axes, another unit. Several of its pairs must say so.

Place: after grouping. Walls and floors of a mirrored scan lie on those of the others, and then many doubtful pairs
agree on a place for it; but none of them is sure. So parts of the model that nothing sure ties to the rest are looked
at again, by a few of their pairs, and asked what one pair alone is asked: whether they fit clearly better mirrored, or
in another unit. Cost: three pairs for each such part, more where it is not placed, up to a limit in all; none in a
model that sure pairs hold together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence

from geomoe3d.batch.folder import remove_batch
from geomoe3d.batch.store import Outcome
from geomoe3d.config import RegistrationConfig, build_config, expert
from geomoe3d.decision.causes import MIRRORED
from geomoe3d.decision.scale import UNITS_DIFFER
from geomoe3d.errors import GeoMoE3DError
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.proposals import most_similar
from geomoe3d.multiway.rules import Group
from geomoe3d.multiway.settling import connected_parts
from geomoe3d.multiway.survey import PairKey, Survey, key_of
from geomoe3d.runtime.words import counted

CHECKS_FOLDER = "checks"


def find_faults(survey: Survey, groups: Sequence[Group], edges: Sequence[Edge]) -> dict[int, str]:
    """Number of a scan -> what is wrong with it as a whole.

    Args:
        survey: the scans and their pairs.
        groups: as they stand in the end.
        edges: of all registered pairs, with what triangles say of them.
    """
    parts = loose_parts(range(len(survey.scans)), groups)
    known = expert().many_pairs
    placed = {scan for group in groups if len(group.poses) > 1 for scan in group.poses}
    unplaced = {part for part in parts[1:] if placed.isdisjoint(part)}
    asked = {
        part: _asked(survey, part, edges, known.checked_unplaced if part in unplaced else known.checked)
        for part in parts[1:]
    }
    most = known.most_checked
    wanted, left = shared_out(asked, most)
    if left:
        names = ", ".join(survey.scans[part[0]].name for part in left[:5])
        survey.say(
            f"not asked about mirrored axes and units: {counted(len(left), 'part')} of the {len(asked)} that nothing "
            f"sure ties to the rest, those of {names}{', ...' * (len(left) > 5)}; {counted(most, 'pair')} in all "
            "are looked at again (expert.many_pairs.most_checked)"
        )
    try:
        checks = survey.register_apart(sorted(wanted), of_checks(survey.config), CHECKS_FOLDER)
    except GeoMoE3DError as error:  # then nobody knows
        told = (
            f"not asked about mirrored axes and units, since its pairs could not be looked at again: {error}"
        )
        return {scan: told for part in asked if part not in left for scan in part}
    found = mirrored_scans(asked, checks, unplaced)
    kept = {id(edge.T_target_source) for group in groups for edge in group.edges}
    holding = [e for e in edges if id(e.T_target_source) in kept]
    return {**found, **scans_of_other_units({**survey.outcomes, **checks}, holding)}


def forget_checks(survey: Survey) -> None:
    """Delete the pairs that an earlier model looked at again; where that cannot be, it is said."""
    try:
        remove_batch(survey.store.folder / CHECKS_FOLDER)
    except GeoMoE3DError as error:
        survey.say(f"pairs that an earlier model looked at again could not be deleted: {error}")


def shared_out(
    asked: Mapping[tuple[int, ...], Sequence[PairKey]], most: int
) -> tuple[set[PairKey], list[tuple[int, ...]]]:
    """So many pairs at most: of every part as many as a verdict needs, two or its only one, then the others.

    Args:
        asked: pairs by part.
        most: of all pairs.

    Returns:
        The pairs, and the parts that get too few for a verdict.
    """
    wanted: set[PairKey] = set()
    left = []
    for part, pairs in asked.items():
        more = wanted | set(pairs[:2])
        if len(more) > most:
            left.append(part)
        else:
            wanted = more
    for part, pairs in asked.items():
        for pair in pairs[2:] if part not in left else ():
            if len(wanted) < most:
                wanted.add(pair)
    return wanted, left


def of_checks(config: RegistrationConfig) -> RegistrationConfig:
    """The configuration of a pair that is looked at again: as for one pair alone, on the grid that suits it."""
    tree = config.model_dump()
    tree["second_look"]["mirror"] = True
    return build_config(RegistrationConfig, {**tree, "voxel_size": None})


def loose_parts(scans: Iterable[int], groups: Sequence[Group]) -> list[tuple[int, ...]]:
    """The scans in parts that pairs tie which are too sure to be asked about mirrored axes, the largest first."""
    sure = [e for group in groups for e in group.edges if e.confidence > expert().causes.sure]
    return [tuple(part) for part in connected_parts(scans, sure)]


def _asked(survey: Survey, part: tuple[int, ...], edges: Sequence[Edge], count: int) -> list[PairKey]:
    """The pairs of a part with others that are looked at again: the surest, then those that look alike."""
    across = [e for e in edges if (e.source in part) != (e.target in part) and not e.of_maps]
    likely = [key_of(e.source, e.target) for e in sorted(across, key=lambda e: -e.worth)]
    others = [k for k in survey.usable() if k not in part]
    alike = [key_of(k, other) for k in part for other in most_similar(survey.similarity, k, others, count)]
    alike = [pair for pair in alike if survey.similarity[pair] > 0]
    return list(dict.fromkeys([*likely, *alike]))[:count]


def mirrored_scans(
    asked: Mapping[tuple[int, ...], Sequence[PairKey]],
    checks: Mapping[PairKey, Outcome],
    unplaced: Container[tuple[int, ...]] = (),
) -> dict[int, str]:
    """Scans of the parts of which two pairs at least, and more than are sure, fit clearly better mirrored; one, where a
    part has no other or is not placed.

    Args:
        asked: pairs by part.
        checks: what became of them.
        unplaced: parts of scans that are in no group.
    """
    found: dict[int, str] = {}
    left = dict(asked)
    while left:
        # Both scans of a pair are said to be mirrored. The worst part is named first; its pairs accuse no other then.
        worst, most, text = None, 0, ""
        for part, pairs in left.items():
            clean = [pair for pair in pairs if pair in checks and found.keys().isdisjoint({*pair} - {*part})]
            said = sum(bool(_said(checks[pair], MIRRORED)) for pair in clean)
            against = sum(checks[pair].status == "ok" for pair in clean)
            alone = len(pairs) == 1 or (part in unplaced and len(clean) > 1)
            if said > max(against, 0 if alone else 1) and said - against > most:
                worst, most = part, said - against
                text = (
                    f"{MIRRORED}: {said} of {counted(len(clean), 'pair')} {'fit' if said > 1 else 'fits'} clearly "
                    "better with one of the two scans mirrored; if the axes of this one are left-handed (often two are "
                    "exchanged), bring them to right-handed ones"
                )
        if worst is None:
            break
        found |= dict.fromkeys(worst, text)
        del left[worst]
    return found


def scans_of_other_units(outcomes: Mapping[PairKey, Outcome], holding: Sequence[Edge]) -> dict[int, str]:
    """Scans that more pairs say to be of another unit than hold them in the model, those already named left aside.

    Args:
        outcomes: of all pairs.
        holding: edges near the final poses.
    """
    said = {
        pair: sentence for pair, outcome in outcomes.items() if (sentence := _said(outcome, UNITS_DIFFER))
    }
    found: dict[int, str] = {}
    while said:
        # Both scans of a pair are said to differ. The worst is named first, and what it said of others then goes.
        told = Counter(scan for pair in said for scan in pair)
        held = Counter(scan for edge in holding for scan in (edge.source, edge.target))
        most = max(told[scan] - held[scan] for scan in told)
        if most <= 0:
            break
        worst = {scan for scan in told if told[scan] - held[scan] == most}  # alike: nothing tells which it is
        found |= {scan: next(text for pair, text in said.items() if scan in pair) for scan in worst}
        said = {pair: text for pair, text in said.items() if not worst & set(pair)}
        holding = [edge for edge in holding if not worst & {edge.source, edge.target}]
    return found


def _said(outcome: Outcome, words: str) -> str:
    """The reason of a pair that begins with some words, else empty."""
    reasons = () if outcome.result is None else outcome.result.reasons
    return next((reason for reason in reasons if reason.startswith(words)), "")
