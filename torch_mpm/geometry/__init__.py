"""Shapes, points within them, and per-scene arrays of coordinates."""
