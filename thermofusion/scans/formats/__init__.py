"""Recordings of other makers, one format a file."""
