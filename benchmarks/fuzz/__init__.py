"""Programs that try what nobody should do, each case in a child process; every program is bounded and seeded."""
