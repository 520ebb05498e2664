"""Time of a step and of its parts, compared with the copy bandwidth of the device and with other programs."""
