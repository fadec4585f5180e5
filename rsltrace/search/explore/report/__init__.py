"""Reports of a search.

exploration   its results: failures by cause, effects of settings, commands
charts        charts as SVG
page          a self-contained page of HTML
formats       JSON, JUnit, annotations for GitHub, a Parquet table of all runs
"""
