"""Running events and recording them: who is called, what caused it, how the run has gone."""
