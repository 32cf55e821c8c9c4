"""Observations become the true temperature of every vertex, with its uncertainty."""
