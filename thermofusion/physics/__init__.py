"""Pure physics: Planck in a band, emissivity, the measurement equation. Neither Open3D nor files."""
