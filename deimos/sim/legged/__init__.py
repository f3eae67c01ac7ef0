"""Legged robots: the task, the engines that step them, the robots, the ground."""
