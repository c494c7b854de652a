"""Avoidance methods to compare with."""
