"""``ros2 rsltrace …``: the whole command as an extension of ROS's own command line.

ros2cli finds it by the entry point group ``ros2cli.command``; nothing else imports this module, so
rsltrace does without ros2cli.
"""

from __future__ import annotations

import argparse
from typing import Any

from ros2cli.command import CommandExtension

from rsltrace.cli.main import main


class RsltraceCommand(CommandExtension):  # type: ignore[misc]
    """Record, compare and debug deterministic runs of ROS 2 nodes."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        """Pass all arguments to rsltrace, ``--help`` included."""
        parser.add_argument(
            "words",
            nargs=argparse.REMAINDER,
            metavar="COMMAND ...",
            help=f"the arguments of 'rsltrace'; see '{cli_name} record --help' and so on",
        )

    def main(self, *, parser: Any, args: Any) -> int:
        main(args.words, prog_name="ros2 rsltrace")
