"""One widget per file; each draws what ``rsltrace_viewer.model`` computed."""
