"""Fuzz programs: misuse of every interface, each case in a child process; every program is bounded and seeded."""
