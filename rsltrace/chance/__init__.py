"""Everything random in a simulation, reproducible to the bit: streams, distributions, links.

No numpy and no ``math`` functions whose last bit differs between platforms: uniform numbers come
from a counter-based stream, and everything else from them by additions, multiplications, divisions
and square roots, which IEEE 754 rounds the same way everywhere (``exact.py`` has logarithm and
exponential made of these).
"""
