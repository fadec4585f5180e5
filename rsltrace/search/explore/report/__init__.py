"""Reports of a search.

exploration   its results: failures by cause, effects of settings, commands
formats       JSON, JUnit, annotations for GitHub, a Parquet table of all runs
"""
