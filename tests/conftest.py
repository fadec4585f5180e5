"""How hypothesis looks for counterexamples: the same ones every time, with all the time it needs.

A loaded machine must not fail a test, nor may a test pass today and fail tomorrow. To look for new
counterexamples: ``HYPOTHESIS_PROFILE=explore python -m pytest …``.
"""

import os
import signal

from hypothesis import HealthCheck, settings

settings.register_profile(
    "same", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile(
    "explore", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# A shell that starts us in the background has us ignore Ctrl-C, and so would all that we start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
