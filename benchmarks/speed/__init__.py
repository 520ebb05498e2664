"""Time of a step and of its parts, beside the copy bandwidth of the device and beside other programs."""
