"""Recordings of robots' and sensors' own programs: bags, dumps, streams."""
