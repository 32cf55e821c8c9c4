"""Thermal views onto the surface: what each vertex was seen to radiate."""
