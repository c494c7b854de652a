"""The thesis's method and the baselines M1 to M3, with everything that only they need."""
