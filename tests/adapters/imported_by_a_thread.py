"""Imported by threads of test_line_switches.py."""

TOTAL = 0
for number in range(3):
    TOTAL += number
