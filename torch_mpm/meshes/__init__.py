"""Closed triangle meshes: reading and repair, which places are inside, the nearest triangle, terrain."""
