"""The thesis's mapping method and the three baselines M1 to M3, with what only they need."""
