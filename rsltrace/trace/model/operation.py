"""Small outputs of an event (a timer was changed, a task made): what a trace has the hash of."""

from __future__ import annotations

import struct

TIMER_CANCEL = 1
TIMER_RESET = 2
TIMER_PERIOD = 3

pack_operation = struct.Struct("<Bq").pack
"""Packs what was done and a value in ns: of a timer its next deadline, or its new period."""
