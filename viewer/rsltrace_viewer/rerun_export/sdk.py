"""The one place that knows whether Rerun is installed, and in which version.

Rerun changes its Python interface with every minor version, so the extra pins one; another version
is refused here with a sentence instead of failing somewhere inside with a traceback.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import sys
from pathlib import Path

from rsltrace.errors import SetupError

VERSION = "0.41" if sys.version_info >= (3, 11) else "0.39"
"""The last one for Python 3.10 is 0.39; what is used here is the same in both."""
INSTALL = "pip install 'rsltrace[rerun]'"
APPLICATION_ID = "rsltrace"
LOOPBACK = "127.0.0.1"
"""What a viewer listens at: whoever is on the network gets to see nothing of a trace."""


def installed() -> str:
    """Return the version of Rerun's SDK, without loading it.

    :raises SetupError: it is not the one that this was written for, or not there.
    """
    try:
        found = importlib.metadata.version("rerun-sdk")
    except importlib.metadata.PackageNotFoundError:
        raise SetupError(f"Rerun is not installed; install it with: {INSTALL}") from None
    if not found.startswith(f"{VERSION}."):
        raise SetupError(
            f"rerun-sdk {found} is installed, this rsltrace works with {VERSION}; "
            f"install that with: {INSTALL}"
        )
    return found


def require_control() -> None:
    """Raise SetupError unless Rerun's viewer can be told what to show."""
    if installed().startswith("0.39."):
        raise SetupError(
            "Rerun's viewer can be told what to show from Rerun 0.41 on, which needs Python 3.11"
        )


def require() -> None:
    """Raise SetupError unless Rerun's SDK is installed in the version this was written for.

    Also turns off Rerun's usage statistics, unless ``RERUN_ANALYTICS_ENABLED`` says otherwise:
    looking at a trace should not open a connection to anybody. And its log, unless ``RUST_LOG``
    says otherwise: names from the trace would reach the terminal as they are.
    """
    found = installed()
    os.environ.setdefault("RERUN_ANALYTICS_ENABLED", "0")
    os.environ.setdefault("RUST_LOG", "off")
    try:
        import rerun  # noqa: F401 - whether it loads is the question
    except ImportError as error:
        raise SetupError(
            f"rerun-sdk {found} is installed, but it cannot be loaded ({error}); "
            f"install it again with: {INSTALL}"
        ) from error


def viewer() -> Path:
    """Return the viewer's program. Raises SetupError if it is not there.

    The ``rerun`` on the PATH is a script that starts this one; ending the script would leave the
    viewer behind.
    """
    override = os.environ.get("RERUN_CLI_PATH")  # Rerun's own variable
    spec = importlib.util.find_spec("rerun_cli")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
    names = ["rerun.exe" if sys.platform == "win32" else "rerun"]
    if sys.platform == "darwin":
        names.insert(0, "Rerun.app/Contents/MacOS/Rerun")
    for program in [Path(override)] if override else [folder / name for name in names]:
        if program.is_file():
            return program
    raise SetupError(
        f"Rerun's viewer is not at {override or folder}; install it again with: {INSTALL}"
    )
