"""Nondeterministic one-liners, as users write them: held by the guard, or reported."""
