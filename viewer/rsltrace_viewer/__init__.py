"""Looking at traces: the terminal viewer (Textual), pages for the browser, and Rerun.

``model`` computes what there is to see as plain values and knows no terminal; the others draw it.
"""
