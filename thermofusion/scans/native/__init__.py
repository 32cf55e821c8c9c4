"""The project's own recording: scan.json, rig.json, frames.csv and images, read and written."""
