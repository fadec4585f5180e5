"""The header of an MCAP message as numpy sees it: ``records.MESSAGE_HEAD`` is the same."""

from __future__ import annotations

import numpy as np

MESSAGE_HEADER_DTYPE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("message_sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""``message_sequence`` is what MCAP calls ``sequence``: messages have fields of
that name, too, and may stand in one layout with it."""
