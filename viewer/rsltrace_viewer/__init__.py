"""Looking at traces: the terminal viewer (Textual) on the read-only ``Trace`` facade.

``model`` computes what there is to see as plain values and knows no terminal; ``widgets`` draw it.
"""
