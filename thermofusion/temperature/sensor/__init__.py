"""What the sensor itself adds to its pictures: a smooth field, fixed and drifting patterns, and what asks for them."""
