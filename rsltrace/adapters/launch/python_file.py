"""Reads Python launch files with rsltrace's own part of ``launch``: for a process of its own.

A Python launch file is a program, and may do to its process whatever it likes (see ``expand``).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from rsltrace.adapters.launch.api.actions import MissingModuleError
from rsltrace.adapters.launch.api.basics import (
    LaunchContext,
    LaunchDescription,
    as_job_error,
    shown,
)
from rsltrace.adapters.launch.api.description_sources import (
    get_launch_description_from_python_launch_file,
)
from rsltrace.adapters.launch.api.packages import missing_packages_allowed
from rsltrace.adapters.launch.api.ros_modules import own_launch
from rsltrace.adapters.launch.model import LaunchResult
from rsltrace.adapters.launch.reader import LaunchFileReader
from rsltrace.errors import JobError


def read_launch_file(path: Path, arguments: Mapping[str, str]) -> LaunchResult:
    """Return what a launch file starts, given ``name:=value`` arguments.

    :raises JobError: with file and line, if something in it is wrong, missing or not known here.
    """
    reader = LaunchFileReader(arguments, _load)
    with own_launch(), missing_packages_allowed(reader.context):
        return reader.read(path)


def _load(context: LaunchContext, file: Path) -> LaunchDescription:
    os.environ.update(context.environment)
    here = str(file)
    try:
        description = get_launch_description_from_python_launch_file(here)
    except JobError:
        raise
    except ModuleNotFoundError as error:
        where = as_job_error(error, shown(here)).where
        raise MissingModuleError(
            f"it imports the Python module {error.name!r}, which is not installed for "
            f"{sys.executable}: install it, or add the folder of its sources to search_path",
            where=where,
        ) from error
    except SystemExit as error:
        raise JobError(f"the launch file ends Python ({error.code})", where=shown(here)) from error
    except Exception as error:
        raise as_job_error(error, shown(here)) from error
    if not isinstance(description, LaunchDescription):
        raise JobError(
            f"generate_launch_description() returned {type(description).__name__}, not a "
            "LaunchDescription",
            where=shown(here),
        )
    return description
