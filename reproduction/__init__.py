"""The reproduction of the thesis: its claims, presets and plans, on top of ``deimos.study``."""
