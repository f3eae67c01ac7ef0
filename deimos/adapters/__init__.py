"""Environments in other people's training loops: thin wrappers over ``Env``, one file per library."""
