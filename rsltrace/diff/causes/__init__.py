"""Why two traces diverge: roots and consequences, verdicts, and the evidence for them."""
