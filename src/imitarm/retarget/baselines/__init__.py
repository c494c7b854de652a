"""Retargeting methods for comparison: the thesis's method, and the thesis's baselines M1 to M3."""
