"""The command ``rsltrace``: one module per command, loaded when it is asked for."""
