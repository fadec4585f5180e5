"""Everything random in a simulation, reproducible to the bit: streams, distributions, links.

No function whose last bit differs between platforms, neither numpy's nor those of ``math``: uniform
numbers come from a counter-based stream, and everything else from them by additions,
multiplications, divisions and square roots, which IEEE 754 rounds the same way everywhere
(``exact.py`` has logarithm and exponential made of these).
"""
