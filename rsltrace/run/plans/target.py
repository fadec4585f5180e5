"""What a job names as ``module:attribute``."""

from __future__ import annotations

import importlib
from typing import Any

from rsltrace.adapters.rclpy.hints import cannot_import, import_raised
from rsltrace.errors import JobError, RsltraceError, did_you_mean
from rsltrace.simulation.middleware.events.failure import text_of


def load_target(target: str, *, where: str) -> Any:
    """Import ``module:attribute``.

    :raises JobError: if there is no such module or attribute, or it cannot be called.
    """
    module_name, _, attribute = target.partition(":")
    try:
        value: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and (module_name + ".").startswith(error.name + "."):
            raise JobError(
                f"there is no module {module_name!r} (looked in search_path and in Python's own "
                "path); check the name, or add its folder to search_path",
                where=where,
            ) from error
        raise JobError(cannot_import(module_name, error), where=where) from error
    except RsltraceError:
        raise
    except (Exception, SystemExit) as error:
        raise JobError(import_raised(module_name, error, text_of(error)), where=where) from error
    for part in attribute.split("."):
        try:
            value = getattr(value, part)
        except AttributeError as error:
            hint = did_you_mean(part, (n for n in dir(value) if not n.startswith("_")))
            raise JobError(
                f"module {module_name!r} has no {attribute!r}{hint}", where=where
            ) from error
    if not callable(value):
        raise JobError(f"{target} is a {type(value).__qualname__}, not callable", where=where)
    return value
