"""Two traces: where they diverge, and which event of one is which of the other."""
