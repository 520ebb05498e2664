"""Scenes, laws and comparisons that several test modules share, by subject."""
