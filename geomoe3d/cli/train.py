"""``geomoe3d train``: train a network, or go on where a run was interrupted."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, refuse_bare_settings, renamed, traceback_option
from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.training.config import TrainConfig


@click.command(cls=Verb, context_settings=HELP, short_help="Train a network.")
@click.argument("config", type=click.Path())
@click.argument("bare", nargs=-1, metavar="")
@click.option("--set", "assignments", metavar="KEY=VALUE", multiple=True, help="One setting; repeatable.")
@click.option("--output", metavar="FOLDER", help="Run folder. [runs/ and the name of CONFIG]")
@click.option("--new", is_flag=True, help="Refuse to continue a run that is there.")
@click.option("--overfit", is_flag=True, help="Overfit one batch (sanity check); writes nothing.")
@click.option("--show", is_flag=True, help="Print the complete configuration and stop.")
@click.option("--quiet", is_flag=True, help="Print nothing but the summary.")
@renamed("--out", "--output")
@renamed("--fresh", "--new")
@traceback_option
@click.pass_context
def command(
    context: click.Context,
    config: str,
    bare: tuple[str, ...],
    assignments: tuple[str, ...],
    output: str | None,
    new: bool,
    overfit: bool,
    show: bool,
    quiet: bool,
) -> None:
    """Train the network that CONFIG (a YAML file, see configs/train) describes.

    --set changes a setting, e.g. --set steps=2000 --set data.train=SHARDS. Started again with the same
    folder, a run continues from its last checkpoint, exactly. Under torchrun it uses every process.
    The folder gets logs (CSV, TensorBoard), checkpoints, weights.safetensors with its card, curves.png.
    """
    from geomoe3d.config import yaml_text
    from geomoe3d.training.config import load_train_config

    refuse_bare_settings(bare)
    settings = load_train_config(config, list(assignments))
    if show:
        click.echo(yaml_text(settings), nl=False)
    elif overfit:
        context.exit(_overfit(settings, quiet))
    else:
        context.exit(
            _train(settings, Path(output) if output else Path("runs") / Path(config).stem, new, quiet)
        )


def _train(settings: TrainConfig, folder: Path, new: bool, quiet: bool) -> int:
    from geomoe3d.cli.train_display import Display
    from geomoe3d.training.distributed import leave
    from geomoe3d.training.trainer import TrainingRun

    try:
        run = TrainingRun(settings, folder, fresh=new)
        if run.process.world == 1:
            _stop_gently(run)
        with Display(quiet or not run.process.is_first) as display:
            summary = run.train(display)
    finally:
        leave()
    if not run.process.is_first:
        return 0
    if not summary.finished:
        click.echo(f"stopped at step {summary.step}; the same command goes on from there", err=True)
        return ExitCode.INTERRUPTED
    best = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in summary.best.items())
    click.echo(
        f"{counted(summary.step, 'step')}, {summary.pairs_per_s:.1f} pairs/s, {summary.skipped} skipped"
    )
    click.echo(f"best at step {summary.best_step}: {best}")
    click.echo(f"weights: {summary.weights}\ncurves:  {folder / 'curves.png'}")
    return 0


def _overfit(settings: TrainConfig, quiet: bool) -> int:
    from geomoe3d.training.config import RULES
    from geomoe3d.training.overfit import overfit_one_batch

    def report(step: int, measures: dict[str, float]) -> None:
        if not quiet and step % 10 == 0:
            click.echo(f"step {step:4d}  loss {measures['loss']:.4f}  F1 {measures['f1']:.4f}", err=True)

    steps, f1 = overfit_one_batch(settings, report=report)
    reached = f1 > RULES.learnt_f1
    click.echo(
        f"F1 {f1:.4f} after {steps} steps on one batch of {counted(settings.batch_size, 'pair')}", err=False
    )
    if not reached:
        click.echo(f"did not reach {RULES.learnt_f1}: network, losses or data are at fault", err=True)
    return 0 if reached else ExitCode.NOT_SURE


def _stop_gently(run: Any) -> None:
    """The first interrupt ends the run after its step, with a checkpoint; the second one at once."""

    def stop(number: int, frame: object) -> None:
        if run.stop:
            sys.exit(ExitCode.INTERRUPTED)
        run.stop = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
