"""Which depth is believed, and which of it is the subject."""
