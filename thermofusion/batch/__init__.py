"""Many scans with one recipe: found, fused by several workers, gathered on one page. A scan is a task."""
