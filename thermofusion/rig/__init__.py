"""The thermal camera's place and clock, refined on the scan itself: `align.align_thermal`."""
