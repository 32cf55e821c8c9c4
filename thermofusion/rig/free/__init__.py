"""A thermal camera that is not on the rig: every view's own place, from the subject itself: `place.place_views`."""
