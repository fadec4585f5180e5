"""What a search tries next.

strategy     the interface, and the strategies by their names
walks        random orders, and PCT
feedback     orders near those that have shown something new
systematic   all orders that could matter, each once
"""
