"""Pages for the browser, each a file of its own: a comparison, a run, a search."""
