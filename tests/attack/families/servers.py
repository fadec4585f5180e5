"""."""
from tests.attack.families.common import Family
FAMILY = Family("servers", {"x": lambda *a: None}, rounds=0)
