"""The thermal camera by itself: curve, field, noise, clock."""
