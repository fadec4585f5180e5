"""What a search tries next.

strategy     the interface
named        random orders, PCT, orders near those that have shown something new, other settings
systematic   all orders that could matter, each once
faults       random faults
"""
