"""Words for the events, entities and outputs of a trace, used by ``cat``, reports, viewer and
Rerun."""
