"""Text in messages is found by their bytes wherever decoding all of them finds it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rsltrace_viewer.model.query.conditions import mask_of
from rsltrace_viewer.model.query.fields import MessageText
from rsltrace_viewer.model.run import Run

from rsltrace.errors import TraceError
from rsltrace.trace.decode import to_plain

SAMPLES = Path(__file__).parents[2] / "sample_traces"


def _texts(run: Run) -> list[list[str]]:
    """Return by event the decoded texts of its input and of its outputs."""
    texts = []
    for index in range(run.count):
        found = run.input_of(run.event(index))
        here = []
        for output in [*run.outputs(index), *([found] if found is not None else [])]:
            payload, channel = run.trace.payload(output), run.trace.channel_of(output)
            if payload is not None and channel is not None:
                try:
                    plain = to_plain(run.trace.decode(channel, payload[2]))
                except TraceError:
                    continue
                here.append(str(plain).casefold())
        texts.append(here)
    return texts


@pytest.mark.parametrize("name", ["delayed_input/a.mcap", "nondeterministic_callback/a.mcap"])
def test_bytes_and_decoded_messages_say_the_same(name: str) -> None:
    run = Run.open(SAMPLES / name)
    texts = _texts(run)
    words = {word for here in texts for text in here for word in text.replace("'", " ").split()}
    odd = ["e", "0.", "qzx", "map", "too far", ": ", "é", "linear", "theta", "ange", "stamp", "sec"]
    chosen = [*sorted(words)[:: max(len(words) // 40, 1)], *odd]
    hits = 0
    for word in chosen:
        condition = MessageText(word)
        masks = [mask_of(run, condition, number)[1] for number in range(len(run.segments))]
        expected = [any(word in text for text in here) for here in texts]
        assert np.concatenate(masks).tolist() == expected, word
        hits += any(expected)
    assert hits > len(chosen) // 2
    run.close()
