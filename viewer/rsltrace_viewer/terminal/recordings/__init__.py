"""The screen of bags and native recordings."""
