"""Closed triangle meshes: reading and repair, points inside, nearest triangle, terrain."""
