"""What a search has found, for people and for machines.

exploration   the results of a search, put in order: causes, settings, commands
effects       which setting matters
charts        small pictures, as SVG
page          a page of HTML that needs nothing beside it
formats       JSON, JUnit, annotations for GitHub
parquet       a table of all runs
"""
