"""Depth frames with poses become one surface: `surface.fuse_surface`."""
