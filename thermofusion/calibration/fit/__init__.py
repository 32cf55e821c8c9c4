"""Cameras and rig from detected boards."""
