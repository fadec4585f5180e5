"""The terminal application: what is drawn, and what keys do."""
