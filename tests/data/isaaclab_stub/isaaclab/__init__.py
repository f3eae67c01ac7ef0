"""A stub of what a command term of Isaac Lab 2.3.2 sees, written after its source: names, calls and their order."""
