"""Thermal files by themselves, without a depth recording beside them."""
