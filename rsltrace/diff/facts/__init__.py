"""What the comparison of two runs finds out, as frozen values: no text that a person reads.

    evidence    what differs: settings, events, fields, messages, calls, states
    causes      what a divergence is (``DivergenceKind``) and where it comes from (``CauseKind``)
    remarks     what else to know of a comparison (``Remark``), and its answer (``Outcome``)

Whatever decides reads these: alignment and causes make them, ``rsltrace.diff.sentences`` puts them
in words, once, and reports lay them out. JSON carries them as they are: ``fact`` is the class of a
value, in snake case. Nothing in ``rsltrace.diff`` reads a sentence: see
``tests/diff/test_facts.py``.
"""
