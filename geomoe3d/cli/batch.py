"""``geomoe3d batch``: a table of pairs in, a folder of results out, gone on with after any interruption."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, traceback_option, use_instead
from geomoe3d.cli.files import part_option
from geomoe3d.cli.parts import cache_options, configuration_options, scale_option, worker_options
from geomoe3d.runtime.words import counted, of_all

if TYPE_CHECKING:
    from geomoe3d.batch.run import BatchReport

_COLORS = {"ok": "green", "low_confidence": "yellow", "ambiguous": "yellow", "failed": "red", "error": "red"}


@click.command(
    cls=Verb, context_settings=HELP, short_help="Register a table of pairs, on one machine or a cluster."
)
@click.argument("pairs", metavar="PAIRS.csv")
@click.argument("out", metavar="OUT")
@worker_options
@configuration_options
@scale_option
@click.option("--transforms", is_flag=True, help="Write OUT/transforms/<id>.txt for every pair.")
@click.option("--page/--no-page", default=False, help="Write OUT/page.html with a picture of every pair.")
@click.option(
    "--pages",
    is_flag=True,
    help="Write OUT/pages/<id>.html, in which the clouds can be turned, for every pair.",
)
@click.option("--fresh", is_flag=True, help="Delete the results of an earlier batch in OUT first.")
@click.option("--retry", is_flag=True, help="Try the pairs again that could not be registered.")
@cache_options
@click.option("--quiet", is_flag=True, help="No progress and no table.")
@part_option("reader")
@traceback_option
@click.pass_context
def command(context: click.Context, /, pairs: str, out: str, quiet: bool, **given: Any) -> None:
    """Register every pair listed in PAIRS.csv and write the results to the folder OUT.

    The table needs the columns source and target. Optional columns: id, and an initial transform, either
    as a file (initial) or as 16 numbers (T00 to T33). Relative paths start at the folder of the table. An
    interrupted batch continues when it is started again. A file that cannot be read affects its own pairs
    only. Exit code 0 if every pair is ok, 3 if not, 2 for unusable input.
    """
    if pairs.lower().endswith((".ply", ".pcd", ".las", ".laz", ".e57", ".ptx", ".pts", ".npy", ".npz")):
        raise use_instead(
            f"'{pairs}' is a cloud, not a table of pairs; two clouds are registered by `register`",
            pairs,
            out,
            verb="register",
        )
    if Path(out).is_file() and not Path(pairs).is_file():
        raise use_instead("the table of pairs comes first, the folder for the results last", out, pairs)
    from geomoe3d.batch.run import register_pairs
    from geomoe3d.cli.progress import stdout_to_stderr

    with stdout_to_stderr():
        report = register_pairs(
            pairs,
            out,
            progress=False if quiet else None,
            say=lambda text: None if quiet else click.echo(text, err=True),
            **given,
        )
    if not quiet:
        click.echo(table(report), color=False if os.environ.get("NO_COLOR") else None)
    context.exit(0 if report.ok else ExitCode.NOT_SURE)


def table(report: BatchReport) -> str:
    """Counts by status, then the pairs that are not ok, the least sure first."""
    total = len(report.outcomes)
    before = f", {report.kept:,} of them before" if report.kept else ""
    lines = [f"{counted(total, 'pair')}{before}; results in {report.folder / 'results.jsonl'}", ""]
    for status, count in report.counts().items():
        word = status.replace("_", " ") if status != "error" else "not registered"
        lines.append(f"  {click.style(word, fg=_COLORS[status]):24} {count:>7,}  {count / total:6.1%}")
    if report.share is not None:
        lines += [
            "",
            f"  Only {of_all(report.share)} of these pairs seem to belong together, where nine in ten are usual. So "
            "every answer is believed",
            "  less than by itself; the reasons are those of the pair by itself. If you know the share, give it:",
            "  --set decision.prior=0.5 --fresh",
        ]
    doubtful = sorted((o for o in report.outcomes if o.status != "ok"), key=lambda o: (o.confidence, o.id))
    if doubtful:
        lines.append("")
    shown = doubtful[:20]
    names = [_short(outcome.id) for outcome in shown]
    width = min(40, max(map(len, names), default=0))
    for outcome, name in zip(shown, names, strict=True):
        reason = outcome.error if outcome.result is None else "; ".join(outcome.result.reasons[:1])
        lines.append(f"  {name:{width}}  {outcome.confidence:.2f}  {outcome.status:14}  {reason}")
    if len(doubtful) > len(shown):
        lines.append(f"  and {len(doubtful) - len(shown):,} more that are not ok")
    return "\n".join(lines)


def _short(name: str) -> str:
    """An id made of long paths, as their last parts."""
    return name if len(name) <= 60 else "+".join(Path(part).name for part in name.split("+"))
