"""Random streams, distributions and link models, reproducible to the bit.

No function whose last bit differs between platforms, neither numpy's nor those of ``math``: uniform
numbers come from a counter-based stream, and everything else from operations that IEEE 754 rounds
the same way everywhere (``stream`` has logarithm and exponential made of these).
"""
