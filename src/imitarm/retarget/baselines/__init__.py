"""The thesis's method and the baselines M1 to M3, with the modules that only these methods use."""
