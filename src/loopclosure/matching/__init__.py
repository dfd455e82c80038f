"""Descriptors to scores to candidates."""
