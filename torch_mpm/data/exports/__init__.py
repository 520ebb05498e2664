"""Data sets in the formats of other projects; every export is a folder that appears when it is complete."""
