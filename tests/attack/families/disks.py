"""."""
from tests.attack.families.common import Family
FAMILY = Family("disks", {"x": lambda *a: None}, rounds=0)
