"""Where the depth camera was: `track.track` goes from a scan to a trajectory."""
