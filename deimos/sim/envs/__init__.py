"""One file, one environment: it holds a frozen dataclass ``Config`` (see ``deimos.sim.env.EnvConfig``)."""
