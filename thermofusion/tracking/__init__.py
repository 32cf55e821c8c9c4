"""Where the depth camera was: `track.locate` goes from a scan to a trajectory."""
