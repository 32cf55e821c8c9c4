"""Boards to print, and what was seen of them."""
