"""``rsltrace verify``: is a job deterministic? Tried, not believed."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

import click

from rsltrace.run.perturb import Recorded
from rsltrace.run.verify import Verified
from rsltrace.run.verify import verify as verify_job


@click.command()
@click.argument("job", type=click.Path(path_type=Path))
@click.option("--runs", type=click.IntRange(min=2), default=10, show_default=True, metavar="N")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    metavar="W",
    help="How many runs at a time.",
)
@click.option("--seed", type=int, default=0, help="Choose other perturbations.")
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Keep the traces of two runs that differ there.",
)
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="As for record.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def verify(
    job: Path,
    runs: int,
    jobs: int,
    seed: int,
    keep: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> None:
    """Record JOB several times in separate processes and compare the digests.

    Each run has another hash seed, working directory, locale, time zone, heap, address space, CPU
    load, thread counts and BLAS core type. The first two runs that differ are shown as a diff, with
    the perturbation that provoked it. The exit status is 0 if all runs are the same, 1 if not, 2 if
    the job cannot be run.
    """
    job = job.resolve()
    arguments = [part for override in overrides for part in ("--set", override)]
    show = sys.stderr.isatty() and not as_json

    def on_run(recorded: Recorded) -> None:
        if show:
            number = recorded.surroundings.number
            click.echo(f"run {number}: digest {recorded.digest}", err=True)

    with tempfile.TemporaryDirectory(prefix="rsltrace-verify-") as folder:
        result = verify_job(
            job,
            Path(folder),
            runs=runs,
            workers=jobs,
            seed=seed,
            arguments=arguments,
            on_run=on_run,
        )
        kept = _keep(result, keep) if keep is not None else ()
        click.echo(json.dumps(_as_json(result)) if as_json else _as_text(result, kept))
    sys.exit(0 if result.agrees else 1)


def _as_text(result: Verified, kept: tuple[Path, ...]) -> str:
    first, other = result.first, result.other
    tried = f"{result.runs} runs, {len(result.kinds)} perturbations"
    kinds = f"perturbed: {', '.join(result.kinds) or 'nothing'}"
    if other is None:
        ended = f" (each ended with exit status {first.exit_code})" if first.exit_code else ""
        return f"{tried}, one digest: {first.digest}{ended}\n{kinds}"
    from rsltrace.diff import diff_files
    from rsltrace.diff.report import render

    lines = [
        f"not deterministic: {tried}, run {other.surroundings.number} differs from run 0",
        f"  run 0: digest {first.digest}, exit status {first.exit_code}, nothing perturbed",
        f"  run {other.surroundings.number}: digest {other.digest or '(none)'}, "
        f"exit status {other.exit_code}, with {other.surroundings}",
    ]
    if result.by_itself:
        lines.append("provoked by nothing: a second run without perturbations differs, too")
    elif result.provoked_by:
        lines.append(f"provoked by: {', '.join(result.provoked_by)} (each alone is enough)")
    else:
        lines.append("provoked by: several of them together, or chance")
    if other.digest:
        paths = kept or (first.path, other.path)
        lines += ["", render(diff_files(str(paths[0]), str(paths[1]))).rstrip()]
    else:
        lines += ["", other.errors.strip()]
    if not kept:
        lines += ["", "the traces are gone; --keep FOLDER keeps them"]
    return "\n".join(lines)


def _as_json(result: Verified) -> dict[str, object]:
    other = result.other
    return {
        "agrees": result.agrees,
        "runs": result.runs,
        "perturbations": list(result.kinds),
        "digests": sorted(result.digests),
        "provoked_by": list(result.provoked_by),
        "by_itself": result.by_itself,
        "surroundings": dict(other.surroundings.values) if other is not None else None,
    }


def _keep(result: Verified, folder: Path) -> tuple[Path, ...]:
    if result.other is None:
        return ()
    folder.mkdir(parents=True, exist_ok=True)
    kept = []
    for name, recorded in (("a.mcap", result.first), ("b.mcap", result.other)):
        if recorded.path.exists():
            shutil.copyfile(recorded.path, folder / name)
            kept.append(folder / name)
    return tuple(kept) if len(kept) == 2 else ()
