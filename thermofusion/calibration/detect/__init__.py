"""Finding boards in pictures."""
