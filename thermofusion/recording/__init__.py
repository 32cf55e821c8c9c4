"""Making recordings: depth and thermal cameras over USB, written so that nothing but the last moment can be lost.

`devices` speak to cameras, one file a camera, all through the interface of `device`. Nothing here was tried on real
hardware unless docs/recording.md says so.
"""
