"""``rsltrace view``: view a trace, or two side by side, in the terminal."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.options import job_folder_option, trust_option
from rsltrace.cli.output.text_file import write_text
from rsltrace.diff.file_kind import is_recording
from rsltrace.errors import OutputError, SetupError, TraceError, did_you_mean
from rsltrace.terminal import tell

if TYPE_CHECKING:
    from rsltrace_viewer.session import Session
    from rsltrace_viewer.terminal.app import ViewerApp
    from rsltrace_viewer.terminal.follow import RerunFollower
    from rsltrace_viewer.terminal.recordings import RecordingApp
    from rsltrace_viewer.terminal.screenshot import Shown

    from rsltrace.job.values.times import TimeInRun

_SIZE = re.compile(r"(\d{1,3})[xX×](\d{1,3})")
_PORT = 8321


@click.command()
@click.argument("traces", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--at",
    metavar="EVENT|TIME",
    help="Start at an event (1200) or a time of the run (1.5s). @1.5s is a simulated time.",
)
@click.option(
    "--filter",
    "filter_text",
    default="",
    metavar="TEXT",
    help="Show only matching events (docs/view.md).",
)
@click.option("--light", is_flag=True, help="Use a light theme.")
@click.option("--follow", is_flag=True, help="Follow a trace that is still being recorded.")
@click.option(
    "--live", is_flag=True, help="Run the job of TRACE again as you step, forwards and backwards."
)
@job_folder_option
@trust_option
@click.option(
    "--rerun", is_flag=True, help="Also open Rerun's viewer, which follows the selection."
)
@click.option(
    "--export",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write one screen to a file (.svg or .txt). This needs no terminal.",
)
@click.option(
    "--size",
    default="120x36",
    show_default=True,
    help="With --export: size of the screen, columns x rows.",
)
@click.option(
    "--keys", default="", help="With --export: press these keys first, such as 'n down z'."
)
@click.option("--serve", is_flag=True, help="Open the viewer in a browser on this machine.")
@click.option("--port", default=_PORT, show_default=True, help="With --serve: port of the server.")
def view(
    traces: tuple[Path, ...],
    at: str | None,
    filter_text: str,
    light: bool,
    follow: bool,
    live: bool,
    job_folder: Path | None,
    trust: bool,
    rerun: bool,
    export: Path | None,
    size: str,
    keys: str,
    serve: bool,
    port: int,
) -> None:
    """View TRACE, or compare two traces: step through events, follow causes, read messages.

    Bags and native recordings (a folder, .mcap or .db3) also open, with their topics, rates,
    messages and plots.

    With --live, the job in TRACE runs again as you step. Each event is verified, and shown with its
    changes to the node and with the source of its callback. --live runs the code that TRACE
    names; like "rsltrace replay", it asks first. --job-folder and --trust need --live.

    Without TRACE, choose among the traces and bags in the working directory. One trace opens with
    an overview (press Esc for the events), two open where they diverge. Press ? for all keys and q
    to quit.
    """
    _check_installed("textual")
    if keys and export is None:
        raise click.UsageError("--keys needs --export")
    if len(traces) > 2:
        raise click.UsageError("view shows one trace or compares two; `rsltrace diff` takes more")
    if follow and len(traces) > 1:
        raise click.UsageError("--follow needs one trace")
    if live and (len(traces) != 1 or follow):
        raise click.UsageError("--live needs one trace and no --follow")
    if not live and (trust or job_folder is not None):
        raise click.UsageError("--trust and --job-folder need --live")
    if rerun:
        _check_rerun(follow=follow, exporting=export is not None)
    if serve:
        _serve(port)
        return
    chosen = traces or _choose(exporting=export is not None, light=light)
    if not chosen:
        return
    if any(is_recording(path) for path in chosen):
        if follow or live or rerun:
            raise click.UsageError("--follow, --live and --rerun need traces, not recordings")
        _show(_recordings(chosen, at, filter_text, light=light), export, size, keys)
        return
    with ExitStack() as stack:
        session, made = _opened(stack, chosen, live=live, job_folder=job_folder, trust=trust)
        app = made(
            start=None if at is None else _place(session, at),
            light=light,
            follow=follow,
            filter_text=_checked_filter(filter_text, session.parse),
            rerun=_follower(stack, chosen) if rerun else None,
            overview=len(chosen) == 1 and at is None and not (filter_text or follow or live),
        )
        _show(app, export, size, keys)


def _show(app: Shown, export: Path | None, size: str, keys: str) -> None:
    if export is not None:
        _export(app, export, _parse_size(size), keys.split())
    else:
        _run(app)


def _recordings(
    paths: tuple[Path, ...], at: str | None, filter_text: str, *, light: bool
) -> RecordingApp:
    """Return the app for bags and native recordings, or one of them beside a trace."""
    from rsltrace_viewer.model.recordings.filter import read_filter
    from rsltrace_viewer.terminal.recordings import RecordingApp, open_recordings

    from rsltrace.job.values.times import START

    session = open_recordings(paths)
    start = None
    if at is not None:
        start = (int(at), START) if at.isdecimal() else (None, _time(at, "a message"))
    return RecordingApp(
        session,
        light=light,
        start=start,
        filter_text=_checked_filter(
            filter_text, lambda text: read_filter(text, session.recordings)
        ),
    )


def _opened(
    stack: ExitStack,
    traces: tuple[Path, ...],
    *,
    live: bool,
    job_folder: Path | None,
    trust: bool,
) -> tuple[Session, Callable[..., ViewerApp]]:
    """Open the traces; return the session and the constructor of its app."""
    from rsltrace_viewer.terminal.app import ViewerApp, open_session

    if not live:
        session = open_session(*traces)
        stack.callback(session.close)
        return session, partial(ViewerApp, session)
    from rsltrace_viewer.live.app import LiveApp
    from rsltrace_viewer.live.execution import Execution, LiveSession
    from rsltrace_viewer.model.run import Run

    from rsltrace.cli.output.search_progress import working
    from rsltrace.cli.replay import agree
    from rsltrace.debug.client import DebugSession
    from rsltrace.replay.preparation import prepare_replay

    with prepare_replay(traces[0], job_folder) as plan:
        agree(plan, trust=trust)
    run = Run.open(traces[0])
    stack.callback(run.close)
    with working("starting the run"):
        debugged = stack.enter_context(DebugSession(traces[0], job_folder=job_folder, trust=True))
    shown = LiveSession(run)
    return shown, partial(LiveApp, shown, Execution(debugged, run))


def _check_rerun(*, follow: bool, exporting: bool) -> None:
    """Check that Rerun's viewer can be used, before anything is opened."""
    if follow or exporting:
        raise click.UsageError("--rerun cannot be combined with --follow or --export")
    from rsltrace_viewer.rerun_export import sdk, show

    sdk.require_control()
    show.check_display("leave out --rerun, or set DISPLAY")


def _follower(stack: ExitStack, traces: tuple[Path, ...]) -> RerunFollower:
    from rsltrace_viewer.terminal.follow import RerunFollower

    follower = RerunFollower(traces)
    stack.callback(follower.close)
    return follower


def _check_installed(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise SetupError(
            f"the viewer needs {package}, which is not installed; install it with "
            "pip install 'rsltrace[view]'"
        )


def _choose(*, exporting: bool, light: bool) -> tuple[Path, ...]:
    """Offer the traces and recordings of the current folder."""
    from rsltrace_viewer.model.folder import found_in
    from rsltrace_viewer.terminal.choose import ChooseApp

    found = found_in(Path())
    if not found:
        raise TraceError(
            "the working directory has no trace and no bag; name one, or record a trace with "
            "`rsltrace record`"
        )
    if exporting or not _has_terminal():
        names = ", ".join(entry.name for entry in found[:8])
        raise TraceError(f"name a trace or a bag; the working directory has {names}")
    chosen = ChooseApp(found, light=light).run()
    return tuple(chosen or ())


def _place(session: Any, at: str) -> int:
    from rsltrace_viewer.terminal.choose import question_of

    time = None if at.isdecimal() else _time(at, "an event")
    if session.empty:
        return 0
    try:
        question_of("index" if time is None else "time", session).check(at)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--at") from None
    return int(session.view.place_of(int(at)) if time is None else session.place_at_time(time))


def _time(at: str, what: str) -> TimeInRun:
    from rsltrace.job.values.times import parse_time_in_run

    try:
        return parse_time_in_run(at)
    except ValueError as error:
        raise click.BadParameter(f"{error}; or the number of {what}", param_hint="--at") from None


def _checked_filter(text: str, read: Callable[[str], object]) -> str:
    from rsltrace_viewer.model.query.tokens import QueryError

    try:
        read(text)
    except QueryError as error:
        message = f"{error}\n  {text}\n  {' ' * error.start}{'^' * max(error.end - error.start, 1)}"
        raise click.BadParameter(message, param_hint="--filter") from None
    return text


def _parse_size(text: str) -> tuple[int, int]:
    found = _SIZE.fullmatch(text)
    if found is None or not (20 <= int(found[1]) <= 500 and 5 <= int(found[2]) <= 300):
        raise click.BadParameter(
            f"{text!r} is not a size from 20x5 to 500x300, such as 120x36", param_hint="--size"
        )
    return int(found[1]), int(found[2])


def _export(app: Shown, path: Path, size: tuple[int, int], keys: list[str]) -> None:
    if path.suffix not in (".svg", ".txt"):
        raise click.BadParameter(f"{path} should end in .svg or .txt", param_hint="--export")
    from rsltrace_viewer.terminal.keys import key_names
    from rsltrace_viewer.terminal.screenshot import screen_of

    known = key_names()
    for key in keys:
        name = key.rpartition("+")[2]
        if len(name) > 1 and name not in known:
            hint = did_you_mean(name, known, "keys are named like down, pagedown, slash, ctrl+p")
            raise click.BadParameter(f"there is no key {key!r}; {hint}", param_hint="--keys")
    picture = screen_of(app, size, keys, svg=path.suffix == ".svg")
    write_text(path, picture)


def _has_terminal() -> bool:
    """Whether the viewer has a terminal, or a browser that started it."""
    return "TEXTUAL_DRIVER" in os.environ or (sys.stdin.isatty() and sys.stdout.isatty())


def _run(app: Shown) -> None:
    if not _has_terminal():
        raise SetupError(
            "the viewer needs a terminal; use --export to write a screen to a file, or `rsltrace "
            "cat`"
        )
    if sys.stdout.isatty():
        for name in ("COLUMNS", "LINES"):
            os.environ.pop(name, None)  # some shells export them; they would freeze the size
    app.run()
    if app.return_code:
        sys.exit(app.return_code)


def _serve(port: int) -> None:
    """Serve this command, without --serve, to a browser on this machine."""
    _check_installed("textual_serve")
    from rsltrace_viewer.terminal.serve import LocalServer

    from rsltrace.child_processes import rsltrace_command

    arguments = [argument for argument in sys.argv[1:] if argument != "--serve"]
    # A viewer does not notice that its server is gone, and would spin for ever.
    server = LocalServer(shlex.join(rsltrace_command(arguments)), port)
    tell(f"rsltrace view: {server.address} (Ctrl-C ends it)")
    try:
        server.serve()
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"port {port} cannot be used: {reason}; try --port") from error
