"""Engines that step legged robots: one file, one engine."""
