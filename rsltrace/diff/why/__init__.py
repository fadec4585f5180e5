"""Why two traces diverge: causes, verdicts, evidence, settings."""
