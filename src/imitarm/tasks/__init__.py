"""Whole scenes with a success test."""
