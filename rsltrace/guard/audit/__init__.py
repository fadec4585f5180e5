"""A static look at the sources of nodes for what could make runs differ. Nothing is executed."""
