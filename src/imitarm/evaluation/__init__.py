"""Measures on what was done: motion, tracking, limits, torque, clearance, and the intervals of rates and means."""
