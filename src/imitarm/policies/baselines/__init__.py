"""Avoidance methods for comparison."""
