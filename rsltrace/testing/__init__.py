"""For a team's own tests: run a job, and assert that it still does what it did.

>>> from rsltrace.testing import assert_matches_golden, run_job
>>> def test_robot(tmp_path):                                              # doctest: +SKIP
...     result = run_job("robot/job.yaml", tmp_path)
...     assert_matches_golden(result, "tests/golden/robot.mcap")

``assert_node_unchanged("drive.mcap", "/ekf")`` runs one node alone, fed from a recording.

With pytest, the fixture ``rsltrace_golden`` does both, and ``pytest --rsltrace-update`` rewrites
golden traces after an intended change; ``rsltrace_node`` is the fixture for one node. Importing
this package loads neither rclpy nor numpy.
"""

from rsltrace.testing.golden import (
    GoldenMismatch,
    NodeChanged,
    assert_matches_golden,
    assert_node_unchanged,
    run_job,
)

__all__ = [
    "GoldenMismatch",
    "NodeChanged",
    "assert_matches_golden",
    "assert_node_unchanged",
    "run_job",
]
