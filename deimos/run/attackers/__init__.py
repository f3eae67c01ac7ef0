"""Attackers of a policy in its evaluation: one file, one attacker; see ``deimos.run.attack``."""
