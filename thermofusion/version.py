"""The version, apart from the package: whatever writes it into a file may import it."""

__version__ = "0.1.0"
