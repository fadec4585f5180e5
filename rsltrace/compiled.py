"""The compiled module ``rsltrace._core``, built where a compiler is (``hatch_build.py``).

It replaces the hottest classes by equal ones: same bytes, same errors. ``RSLTRACE_COMPILED=0`` in
the environment switches it off. Others get a base class from it, whose struct holds the attributes
that compiled code reads; such an attribute must not be one of a class, too.
"""

from __future__ import annotations

import os
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING


def _is_older_than_its_source(module: ModuleType) -> bool:
    """Return whether a checkout has got another source since it was built."""
    built_s = os.stat(str(module.__file__)).st_mtime
    with os.scandir(os.path.dirname(__file__)) as files:  # an installed package has no sources
        return any(
            file.stat().st_mtime > built_s for file in files if file.name[-2:] in (".c", ".h")
        )


core: ModuleType | None = None

if os.environ.get("RSLTRACE_COMPILED") != "0":
    try:
        core = import_module("rsltrace._core")
        if _is_older_than_its_source(core):
            core = None
    except (ImportError, OSError):
        core = None  # not built

LoopFields = object
EventFields = object
EntityFields = object
LinkFields = object
PublisherFields = object
SubscriptionFields = object
SitesFields = object
TimerFields = object
TimerStateFields = object
TimerQueueFields = object
if core is not None and not TYPE_CHECKING:
    LoopFields, EventFields = core.LoopFields, core.EventFields
    EntityFields, PublisherFields = core.EntityFields, core.PublisherFields
    SubscriptionFields, SitesFields = core.SubscriptionFields, core.SitesFields
    LinkFields, TimerFields = core.LinkFields, core.TimerFields
    TimerStateFields, TimerQueueFields = core.TimerStateFields, core.TimerQueueFields
