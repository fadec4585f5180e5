"""Everything about one event, or a pair of events of two runs, as lines of a tree."""
