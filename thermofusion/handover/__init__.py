"""What hospital systems take of a result."""
