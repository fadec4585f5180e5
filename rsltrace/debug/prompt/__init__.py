"""The prompt of ``rsltrace debug``: a client of a session like any other."""
