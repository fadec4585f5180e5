"""The standing attack: generators of hostile input, and one oracle for what rsltrace makes of it.

    python -m campaigns.attack --minutes 60            what ``make attack`` does
    python -m campaigns.attack --family traces --seed 1234    one case again, by its seed

``families`` are the generators: each makes a case (files, commands, what must hold) from a seed
alone. ``execution`` runs the commands under limits, ``oracle`` judges, ``campaign`` counts and
keeps what gave way. Only what users have is attacked: the command and the names of ``rsltrace``.
"""
