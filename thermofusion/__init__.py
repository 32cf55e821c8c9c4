"""thermofusion: 3D models of the human body whose every point carries its true skin temperature."""

__version__ = "0.1.0"
